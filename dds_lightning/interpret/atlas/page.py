"""The skill atlas as one HTML file: pictures inside it, no script, nothing from a network, light and dark."""

from __future__ import annotations

import base64
import math
from collections.abc import Iterable, Sequence
from html import escape
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd

from dds_lightning.interpret.atlas.build import Atlas
from dds_lightning.interpret.atlas.pictures import Picture
from dds_lightning.interpret.draw.palette import ink, skill_colour
from dds_lightning.interpret.draw.png import small_png
from dds_lightning.interpret.measure.recovery import RoundTrip
from dds_lightning.interpret.views import view_of
from dds_lightning.saving.files import written_whole
from dds_lightning.tasks import Task


class Measure(NamedTuple):
    """A number of a code as the page tells it.

    Attributes:
        name: column of the atlas' table.
        heading: short words.
        unit: behind the number; "" for none.
        form: of the number.
        factor: to the unit.
        words: what it is, in a sentence.
        card: whether a skill's card has it too; the table has them all.
    """

    name: str
    heading: str
    unit: str
    form: str = ".2f"
    factor: float = 1.0
    words: str = ""
    card: bool = True


def measures(task: Task) -> list[Measure]:
    """The columns of the table, with units as they are for a task; in the page's order."""
    view = view_of(task)
    far, fast = view.units
    goal = task.measures_success and not task.subtasks
    return [
        Measure("share", "share of the data", "%", ".1f", 100, "Segments of the data to which the encoder gives it."),
        Measure("chosen", "chosen", "%", ".1f", 100, "How likely the policy chooses it, over the states of the data."),
        Measure("again", "found again", "%", ".0f", 100, "Its replays, where the data use it, that are it again."),
        Measure("recovered", "recovered", "%", ".0f", 100, "Its replays, from any state, that are it again.", False),
        Measure("alone", "alone", "%" if goal else "points", ".0f", 1, _alone_words(goal)),
        Measure("distance", "displacement", far, ".2f", 1, f"How far a segment moves {view.mover}, on average."),
        Measure("dx", "along x", "m", "+.2f", 1, "Mean displacement along x."),
        Measure("dy", "along y", "m", "+.2f", 1, "Mean displacement along y."),
        Measure("dz", "along z", "m", "+.2f", 1, "Mean displacement along z."),
        Measure("ahead", "ahead", "m", "+.2f", 1, "Mean displacement along the way it faces when a segment begins."),
        Measure("left", "to its left", "m", "+.2f", 1, "Mean displacement across that way."),
        Measure("speed", "speed", fast, ".2f", 1, "Mean speed along the way."),
        Measure("turn", view.turn, "°", "+.1f", 1, f"How far {view.turns}, on average."),
        Measure("turning", "turning", "°", ".1f", 1, "The size of it, left or right.", False),
        Measure("reward", "reward", "", ".3g", 1, "Of a segment, not discounted, in the task's own unit."),
        Measure("value", "value", "", ".3g", 1, "The critic's V where segments with this code begin."),
        Measure("action", "size of actions", "%", ".0f", 100, "Of an entry; 100 is the edge of the box.", False),
        Measure("change", "change of actions", "%", ".0f", 100, "Between one step and the next, in half boxes.", False),
        Measure("bound", "actions at a bound", "%", ".0f", 100, "Entries at the edge of their box.", False),
        Measure("spread", "spread over noise", "%", ".1f", 100, "Of an action in one state; the decoder's diversity."),
        Measure("apart", "apart from others", "%", ".1f", 100, "Mean action from that of all codes.", False),
    ]


def _alone_words(goal: bool) -> str:
    what = "Episodes that reach the goal" if goal else "Normalised score"
    return f"{what} when nothing but this skill is played."


def page(atlas: Atlas, about: Sequence[tuple[str, str]] = (), command: str = "") -> str:
    """The whole page.

    Args:
        atlas: what it tells.
        about: facts for its head: (name, words).
        command: that makes it again.
    """
    title = f"Skill atlas: {atlas.task.name}"
    sections = [section for section in _sections(atlas) if section]
    links = "".join(f'<a href="#{name}">{escape(name)}</a>' for name, _, _ in sections)
    body = "".join(
        f'<section id="{name}"><h2>{escape(words)}</h2>{content}</section>' for name, words, content in sections
    )
    facts = "".join(f"<div><dt>{escape(name)}</dt><dd>{escape(words)}</dd></div>" for name, words in about)
    again = f"<p>Made by <code>{escape(command)}</code>.</p>" if command else ""
    style = files("dds_lightning.interpret").joinpath("atlas.css").read_text(encoding="utf-8")
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        '<meta name="color-scheme" content="light dark">\n'
        f"<title>{escape(title)}</title>\n<style>\n{style}</style>\n</head>\n<body>\n"
        f"<header><h1>{escape(title)}</h1>{_tiles(atlas)}<dl class='about'>{facts}</dl></header>\n"
        f"<nav>{links}</nav>\n<main>{body}</main>\n<footer>{again}{_notes(atlas)}</footer>\n</body>\n</html>\n"
    )


# ---------------------------------------------------------------------- parts


def _sections(atlas: Atlas) -> Iterable[tuple[str, str, str] | None]:
    """(anchor, heading, content) of each section that has something to tell."""

    def pictures(name: str, words: str, wanted: Sequence[str], before: str = "", after: str = "") -> Any:
        shown = "".join(_figure(atlas.pictures[one]) for one in wanted if one in atlas.pictures)
        return (name, words, f'{before}<div class="figures">{shown}</div>{after}') if shown or after else None

    yield pictures("replays", "What each skill does", ("strobe", "rendered", "starts_by_skill", "skills_by_start"))
    yield pictures("episodes", "How the policy strings them together", ("stitching", "trajectories"))
    yield pictures("values", "What the critic believes", ("values",))
    yield "skills", "The skills one by one", _cards(atlas)
    told = ("trip", "recovery", "effects", "comparison")
    yield pictures("recovery", "Is a skill told by what it does?", told, _recovery_words(atlas))
    yield pictures("places", "Where they are used", ("where",))
    yield pictures("relations", "What lies between them", ("transitions", "distances", "diversity"))
    yield "numbers", "All numbers", _table(atlas)


def _tiles(atlas: Atlas) -> str:
    found, trip, table = atlas.recovery, atlas.trip, atlas.table
    tiles = [
        (f"{len(found.codes)} of {len(table)}", "codes in use"),
        (f"{100 * trip.accuracy:.0f} %", f"of replays tell their code again ({_control(trip)})"),
        (f"{found.information_in_state:.2f} bits", f"about where a skill leads, of {found.most:.2g} at most"),
    ]
    if "alone" in table:
        best = table.loc[table["alone"].idxmax()]
        goal = atlas.task.measures_success and not atlas.task.subtasks
        number = f"{best['alone']:.0f}" + (" %" if goal else "")
        words = f"{'success' if goal else 'score'} of the best single skill, number {best['code']:.0f}"
        if goal and best["alone"] == 0:
            words = "success of every single skill alone"
        tiles.append((number, words))
    inner = "".join(f"<div><strong>{escape(number)}</strong><span>{escape(w)}</span></div>" for number, w in tiles)
    return f'<div class="tiles">{inner}</div>'


def _control(trip: RoundTrip) -> str:
    control = "" if math.isnan(trip.control) else f", another code held {100 * trip.control:.0f} %"
    return f"chance {100 * trip.chance:.0f} %{control}"


def _recovery_words(atlas: Atlas) -> str:
    trip, found = atlas.trip, atlas.recovery
    first = (
        "Segments of the data were encoded, and the code held from the state in which each begins. What happened then "
        f"is given the same code in {100 * trip.accuracy:.1f} % (± {100 * trip.error:.1f}); guessing would be right in "
        f"{100 * trip.chance:.1f} %."
    )
    if not math.isnan(trip.control):
        first += (
            f" With another code held in the same state it is still given the first one in {100 * trip.control:.1f} %: "
            "so far the state alone gives the code away, and the rest is what the code does."
        )
    error = "" if math.isnan(found.error) else f" (± {100 * found.error:.1f})"
    second = (
        f"Held from the same {found.states} states anywhere in the data, also where the data never use it, a code is "
        f"recovered in {100 * found.accuracy:.1f} %{error}; chance is {100 * found.chance:.1f} %. Knowing the code "
        f"takes away {found.information_in_state:.2f} bits of the uncertainty about where the body is after "
        f"{found.steps} steps from a given state, of {found.most:.2f} that are possible; over all states together, "
        f"where the body's own speed counts too, {found.information:.2f} bits."
    )
    return f"<p>{escape(first)}</p><p>{escape(second)}</p>"


def _figure(picture: Picture) -> str:
    caption = f"<figcaption>{escape(picture.caption)}</figcaption>" if picture.caption else ""
    return f'<figure><div tabindex="0">{_image(picture)}</div>{caption}</figure>'


def _image(picture: Picture) -> str:
    width, height = picture.size
    data = base64.b64encode(picture.data).decode("ascii")
    return (
        f'<img src="data:{picture.mime};base64,{data}" alt="{escape(picture.alt, quote=True)}" width="{width}" '
        f'height="{height}">'
    )


def _badge(code: int, link: bool = False) -> str:
    colour = skill_colour(code)
    style = f"background:{colour};color:{ink(colour)}"
    tag, goes = ("a", f' href="#skill-{code}"') if link else ("span", "")
    return f'<{tag}{goes} class="badge" style="{style}">{code}</{tag}>'


def _cards(atlas: Atlas) -> str:
    """A card for each code in use, the commonest first."""
    shown = [measure for measure in measures(atlas.task) if measure.name in atlas.table]
    most = max(float(atlas.table["share"].max()), 1e-9)
    order = atlas.table.sort_values("share", ascending=False, kind="stable")
    cards, unused = [], []
    for row in order.to_dict(orient="records"):
        code = int(row["code"])
        if code not in atlas.clips:
            unused.append(code)
            continue
        lines = "".join(
            f'<div title="{escape(measure.words, quote=True)}"><dt>{escape(measure.heading)}</dt>'
            f"<dd>{_told(row[measure.name], measure)}</dd></div>"
            for measure in shown
            if measure.card and measure.name != "share" and not _missing(row[measure.name])
        )
        nearest = int(row["nearest"])
        near = f"<div><dt>nearest</dt><dd>{_badge(nearest, link=nearest in atlas.clips)}</dd></div>"
        bar = f"background:{skill_colour(code)};width:{100 * row['share'] / most:.1f}%"
        cards.append(
            f'<article id="skill-{code}"><h3>{_badge(code)} skill {code}</h3>{_image(atlas.clips[code])}'
            f'<p class="share"><span style="{bar}"></span>{100 * row["share"]:.1f} % of the data</p>'
            f"<dl>{lines}{near}</dl></article>"
        )
    rest = ""
    if unused:
        names = ", ".join(map(str, sorted(unused)))
        rest = f"<p>Hardly used in the data, and therefore not replayed: {names}.</p>"
    return f'<div class="cards">{"".join(cards)}</div>{rest}'


def _table(atlas: Atlas) -> str:
    shown = [measure for measure in measures(atlas.task) if measure.name in atlas.table]
    heads = "".join(
        f'<th scope="col" title="{escape(m.words, quote=True)}">{escape(m.heading)}'
        + (f"<small>{escape(m.unit)}</small>" if m.unit else "")
        + "</th>"
        for m in shown
    )
    rows = ""
    for row in atlas.table.to_dict(orient="records"):
        cells = "".join(f"<td>{_number(row[m.name], m)}</td>" for m in shown)
        rows += f'<tr><th scope="row">{_badge(int(row["code"]))}</th>{cells}<td>{_badge(int(row["nearest"]))}</td></tr>'
    table = f'<table><thead><tr><th scope="col">skill</th>{heads}<th scope="col">nearest</th></tr></thead>'
    words = "".join(f"<li><b>{escape(m.heading)}</b>: {escape(m.words)}</li>" for m in shown)
    return (
        f'<div class="scroll" tabindex="0">{table}<tbody>{rows}</tbody></table></div>'
        f"<details><summary>What the columns mean</summary><ul>{words}</ul></details>{_compared(atlas.comparison)}"
    )


def _compared(comparison: pd.DataFrame | None) -> str:
    if comparison is None:
        return ""
    rows = "".join(
        f"<tr><th scope='row'>{escape(str(row.model))}</th><td>{row.seed}</td><td>{escape(str(row.kind))}</td>"
        f"<td>{row.codes}</td><td>{100 * row.own_accuracy:.1f}</td><td>{100 * row.own_control:.1f}</td>"
        f"<td>{100 * row.accuracy:.1f}</td><td>{100 * row.chance:.1f}</td>"
        f"<td>{row.information_in_state:.2f}</td><td>{row.information:.2f}</td><td>{row.most:.2f}</td>"
        f"<td>{row.decoded:.3g}</td><td>{'–' if _missing(row.decoded_own) else f'{row.decoded_own:.3g}'}</td></tr>"
        for row in comparison.itertuples()
    )
    names = (
        "model",
        "seed",
        "skills",
        "codes",
        "found again %",
        "another held %",
        "recovered %",
        "chance %",
        "bits in a state",
        "bits over all",
        "at most",
        "decoding error",
        "with own vectors",
    )
    heads = "".join(f'<th scope="col">{name}</th>' for name in names)
    return (
        '<h3>Compared</h3><div class="scroll" tabindex="0"><table><thead><tr>'
        f"{heads}</tr></thead><tbody>{rows}</tbody></table></div>"
    )


def _notes(atlas: Atlas) -> str:
    return (
        f"<p>Numbers of the data are means over {atlas.segments:,} segments of {atlas.horizon} steps that do not "
        "overlap. A colour is a code everywhere, and its number stands beside it because no sixteen colours are safe "
        "for everybody.</p>"
    )


def _missing(value: Any) -> bool:
    return value is None or pd.isna(value)


def _number(value: Any, measure: Measure) -> str:
    return "–" if _missing(value) else format(measure.factor * float(value), measure.form)


def _told(value: Any, measure: Measure) -> str:
    space = "" if measure.unit == "°" else " "
    return _number(value, measure) + (f"{space}{escape(measure.unit)}" if measure.unit else "")


def write_atlas(atlas: Atlas, path: str | Path, about: Sequence[tuple[str, str]] = (), command: str = "") -> Path:
    """Write the page: one HTML file that needs nothing else.

    Args:
        atlas: what `make_atlas` made.
        path: the file.
        about: facts for its head, such as the checkpoint and the data: (name, words).
        command: that makes the page again.
    """
    path = Path(path)
    with written_whole(path) as part:
        part.write_text(page(atlas, about, command), encoding="utf-8")
    return path


def write_pictures(atlas: Atlas, folder: str | Path, prefix: str) -> list[Path]:
    """Write each picture of the page as a small PNG file, `PREFIX-PICTURE.png`, for papers, slides and READMEs.

    Args:
        atlas: what `make_atlas` made.
        folder: where to; made if it is not there.
        prefix: how the files' names begin.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for name, picture in atlas.pictures.items():
        paths.append(folder / f"{prefix}-{name.replace('_', '-')}.png")
        with written_whole(paths[-1]) as part:
            part.write_bytes(small_png(picture.data))
    return paths
