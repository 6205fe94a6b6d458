"""The command `dds atlas`: the signature is the command line, the docstring the help."""

from __future__ import annotations

from pathlib import Path

from dds_lightning.cli.arguments import data_spec
from dds_lightning.console.reports import Report, pairs, table
from dds_lightning.errors import UserError

STAGES = 11
"""Approximate number of steps, which the progress bar counts, when nothing is compared."""
SHOWN = ("code", "share", "again", "recovered", "distance", "speed", "reward", "value", "alone")
"""Columns of the table that is printed; the page has them all."""


def atlas(
    place: str,
    data: str | None = None,
    task: str | None = None,
    out: str = "atlas.html",
    episodes: int = 5,
    against: list[str] = [],  # noqa: B006 - jsonargparse shows the default and nobody changes it
    seed: int = 0,
    figures: str | None = None,
) -> Report:
    """Look at the skills of a checkpoint: one HTML page with pictures, clips and numbers, which opens offline.

    Every skill is replayed in the task's environment, from the same states; episodes show how the policy strings them
    together; tables say what each does in the data, and how well it can be recognised from its behaviour.

    With --json: `atlas` (the page), `task`, `horizon`, `num_skills`, `segments` (of the data that were encoded),
    `skills` (one row per code), `round_trip` and `recovery` (accuracy, its error, chance, control, confusion,
    information in bits), `transitions` and `distances` (K x K), `comparison` (one row per model, or null). What is not
    measured is null.

    Args:
        place: A run of `dds run`, a published directory, hf:OWNER/NAME, or a skill checkpoint (.ckpt).
        data: Where the data are: local:DIR, minari:ID, d4rl:FILE, arrays:DIR, or just a folder or file; a run knows
            where its data are.
        task: Name of the task; without it the one that the checkpoint was made for.
        out: The HTML file to write.
        episodes: Episodes to play with the policy and with each single skill, unless a run has played them already;
            0 for none.
        against: Other skill checkpoints, for example of other seeds or with continuous skills, to compare with.
        seed: Seed of everything random.
        figures: A folder in which each picture is also written as a small PNG file, named after the page.
    """
    from dds_lightning.saving.hub import is_hub, pull

    page = Path(out)
    if page.suffix != ".html" or page.is_dir():
        raise UserError(f"--out is {out}, expected the name of a file that ends in .html")
    if episodes < 0:
        raise UserError(f"--episodes is {episodes}, expected a number of episodes, or 0 for none")
    if figures is not None and Path(figures).is_file():
        raise UserError(f"--figures is {figures}, a file, expected a folder")
    root = pull(place) if is_hub(place) else Path(place)
    if not root.exists():
        raise UserError(f"there is no {place}: give a run of `dds run`, a published directory or a skill checkpoint")
    spec = data_spec(data) if data else None

    from dds_lightning.console.progress import announcements
    from dds_lightning.study.subject import atlas as make

    with announcements(STAGES + len(against)) as announce:
        others, folder = [Path(one) for one in against], Path(figures) if figures else None
        made, path = make(root, spec, task, page, episodes, others, seed, folder, announce)
    found, trip, shown = made.recovery, made.trip, made.table[[name for name in SHOWN if name in made.table]]
    lines = [
        ("codes in use", f"{len(found.codes)} of {len(made.table)}"),
        (
            "found again",
            f"{100 * trip.accuracy:.1f} % of replays in own states, another code held {100 * trip.control:.1f} %",
        ),
        ("recovered", f"{100 * found.accuracy:.1f} % of replays from any state"),
        ("chance", f"{100 * found.chance:.1f} %"),
        ("told by the state", f"the code of {100 * trip.state:.1f} % of the data's segments, by where they begin"),
        ("about where it leads", f"{found.information_in_state:.2f} bits in a state, at most {found.most:.2f}"),
        ("page", f"{path} ({path.stat().st_size / 1e6:.1f} MB)"),
    ]
    return Report({"atlas": path, **made.facts()}, [table(shown), pairs(lines)])
