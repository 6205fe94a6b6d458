"""The skill atlas as one HTML file with embedded pictures, without scripts or network access, in light and dark.

The page itself is the template `page.html.jinja`; here are its tables of columns and sections.
"""

from __future__ import annotations

import base64
from collections.abc import Callable, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd

from dds_lightning.interpret.atlas.build import Atlas
from dds_lightning.interpret.draw.palette import ink, skill_colour
from dds_lightning.interpret.draw.png import small_png
from dds_lightning.interpret.views import view_of
from dds_lightning.saving.files import written_whole
from dds_lightning.saving.templates import render
from dds_lightning.tasks import Task


class Measure(NamedTuple):
    """A number about a code, and how the page shows it.

    Attributes:
        name: Column of the atlas' table.
        heading: Short name.
        unit: Unit after the number; "" for none.
        form: Format of the number.
        factor: Factor that converts the column to the unit.
        meaning: What the number is, in a sentence.
        card: Whether a skill's card shows it too; the table shows all.
    """

    name: str
    heading: str
    unit: str
    form: str = ".2f"
    factor: float = 1.0
    meaning: str = ""
    card: bool = True


def measures(task: Task) -> list[Measure]:
    """The columns of the table in the page's order, with the units of a task."""
    view = view_of(task)
    far, fast = view.units
    goal = task.measures_success and not task.subtasks
    return [
        Measure("share", "share of the data", "%", ".1f", 100, "Segments of the data that the encoder gives it."),
        Measure("chosen", "chosen", "%", ".1f", 100, "Probability that the policy chooses it, over all states."),
        Measure("again", "found again", "%", ".0f", 100, "Replays in the code's own states that get it again."),
        Measure("recovered", "recovered", "%", ".0f", 100, "Replays from any state that get it again.", False),
        Measure("alone", "alone", "%" if goal else "points", ".0f", 1, _alone_meaning(goal)),
        Measure("distance", "displacement", far, ".2f", 1, f"How far a segment moves {view.mover}, on average."),
        Measure("dx", "along x", "m", "+.2f", 1, "Mean displacement along x."),
        Measure("dy", "along y", "m", "+.2f", 1, "Mean displacement along y."),
        Measure("dz", "along z", "m", "+.2f", 1, "Mean displacement along z."),
        Measure("ahead", "ahead", "m", "+.2f", 1, "Mean displacement in the direction it faces at first."),
        Measure("left", "to its left", "m", "+.2f", 1, "Mean displacement to the left of that direction."),
        Measure("speed", "speed", fast, ".2f", 1, "Mean speed along the path."),
        Measure("turn", view.turn, "°", "+.1f", 1, f"How far {view.turns}, on average."),
        Measure("turning", "turning", "°", ".1f", 1, "Its absolute value, left or right.", False),
        Measure("reward", "reward", "", ".3g", 1, "Reward of a segment, undiscounted, in the task's unit."),
        Measure("value", "value", "", ".3g", 1, "The critic's V where segments with this code begin."),
        Measure("action", "size of actions", "%", ".0f", 100, "Size of an entry; 100 is the edge of the box.", False),
        Measure("change", "change of actions", "%", ".0f", 100, "Between one step and the next, in half boxes.", False),
        Measure("bound", "actions at a bound", "%", ".0f", 100, "Entries at the edge of their box.", False),
        Measure("spread", "spread over noise", "%", ".1f", 100, "Spread of an action in one state."),
        Measure(
            "apart", "apart from others", "%", ".1f", 100, "Distance of its mean action from that of all codes.", False
        ),
    ]


def _alone_meaning(goal: bool) -> str:
    what = "Episodes that reach the goal" if goal else "Normalised score"
    return f"{what} when only this skill is played."


class Section(NamedTuple):
    """A section of the page; it is left out if none of its pictures exist.

    Attributes:
        anchor: The section's id, and its name in the navigation.
        heading: Its heading.
        pictures: Names of the atlas' pictures, in order.
    """

    anchor: str
    heading: str
    pictures: tuple[str, ...] = ()


SECTIONS = (
    Section("replays", "What each skill does", ("strobe", "rendered", "starts_by_skill", "skills_by_start")),
    Section("episodes", "How the policy combines them", ("stitching", "trajectories")),
    Section("values", "What the critic believes", ("values",)),
    Section("skills", "The skills one by one"),
    Section("recovery", "Can a skill be recognised from its behaviour?", ("trip", "recovery", "effects", "comparison")),
    Section("places", "Where they are used", ("where",)),
    Section("relations", "How they relate", ("transitions", "distances", "diversity")),
    Section("numbers", "All numbers"),
)


def page(atlas: Atlas, about: Sequence[tuple[str, str]] = (), command: str = "") -> str:
    """Render the whole page.

    Args:
        atlas: What the page shows.
        about: Facts for the page's header, as (name, text).
        command: The command that recreates the page.
    """
    table = atlas.table.astype({"code": int, "nearest": int})
    ranked = table.sort_values("share", ascending=False, kind="stable").to_dict(orient="records")
    values = {
        "atlas": atlas,
        "about": about,
        "command": command,
        "style": files("dds_lightning.interpret").joinpath("atlas.css").read_text(encoding="utf-8"),
        "sections": [one for one in SECTIONS if not one.pictures or not atlas.pictures.keys().isdisjoint(one.pictures)],
        "shown": [measure for measure in measures(atlas.task) if measure.name in table],
        "rows": table.to_dict(orient="records"),
        "ranked": ranked,
        "unused": sorted(row["code"] for row in ranked if row["code"] not in atlas.clips),
    }
    filters: dict[str, Callable[..., Any]] = {
        "base64": lambda data: base64.b64encode(data).decode("ascii"),
        "ink": ink,
        "number": _number,
        "percent": lambda share, digits=1: f"{100 * share:.{digits}f}",
        "skill_colour": skill_colour,
    }
    tests = {"known": lambda value: not _missing(value)}
    text = render("dds_lightning.interpret.atlas", "page.html.jinja", values, filters=filters, tests=tests)
    return text.lstrip()  # the macros leave empty lines


def _missing(value: Any) -> bool:
    return value is None or pd.isna(value)


def _number(value: Any, measure: Measure) -> str:
    return "–" if _missing(value) else format(measure.factor * float(value), measure.form)


def write_atlas(atlas: Atlas, path: str | Path, about: Sequence[tuple[str, str]] = (), command: str = "") -> Path:
    """Write the page as one self-contained HTML file.

    Args:
        atlas: The result of `make_atlas`.
        path: The file to write.
        about: Facts for the page's header, such as the checkpoint and the data, as (name, text).
        command: The command that recreates the page.

    Returns:
        The file.
    """
    path = Path(path)
    with written_whole(path) as part:
        part.write_text(page(atlas, about, command), encoding="utf-8")
    return path


def write_pictures(atlas: Atlas, folder: str | Path, prefix: str) -> list[Path]:
    """Write each picture of the page as a small PNG file, `PREFIX-PICTURE.png`, for papers, slides and READMEs.

    Args:
        atlas: The result of `make_atlas`.
        folder: The folder, which is created if necessary.
        prefix: First part of the files' names.

    Returns:
        The files, in the page's order.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for name, picture in atlas.pictures.items():
        paths.append(folder / f"{prefix}-{name.replace('_', '-')}.png")
        with written_whole(paths[-1]) as part:
            part.write_bytes(small_png(picture.data))
    return paths
