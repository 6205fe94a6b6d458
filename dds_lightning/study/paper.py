"""The paper's own numbers (tables 1 to 3), to stand beside others in a column of their own.

They were measured on D4RL's data in D4RL's physics, five seeds, by the authors; `DATA_DIFFER` goes with them.
"""

from __future__ import annotations

from collections.abc import Mapping

Number = tuple[float, float | None]
"""Mean and standard deviation; None where only a mean is printed."""

LAYOUTS = {
    "table1": "Laid out as the paper's table 1.",
    "table2": "Laid out as the paper's table 2, which is for AntMaze-Large-Diverse. It finds that K matters where D is "
    "small (no success with K 32 and D 32 or 64) and hardly where D is 128 or more.",
    "table3": "Laid out as the paper's table 3; its numbers beside a maze are for AntMaze-Large-Diverse. It finds the "
    "transformer with the diffusion decoder ahead of all other pairs by a wide margin.",
    "figure5": "Laid out as the paper's figure 5, which has curves and no numbers.",
    "figure6": "Laid out as the paper's figure 6, which has curves and no numbers; it finds that H hardly matters.",
}
"""Table or figure -> what a report that is set beside it says of it."""
SHORT = {"Decision Diffuser": "DD", "Diffusion-QL": "DQL"}
"""What the paper's table 1 calls methods that have another title here."""
DATA_DIFFER = (
    "The paper's numbers are for other data (D4RL's, in D4RL's physics) and longer trainings: they show which pattern "
    "to expect, not which value."
)


def _rows(methods: str, text: str) -> dict[str, dict[str, Number]]:
    names = methods.split()
    table: dict[str, dict[str, Number]] = {}
    for task, *values in (line.split() for line in text.strip().splitlines()):
        numbers = {name: _number(value) for name, value in zip(names, values, strict=True) if value != "-"}
        table[task] = numbers
    return table


def _number(text: str) -> Number:
    mean, _, spread = text.partition("±")
    return float(mean), float(spread) if spread else None


TABLE1: Mapping[str, Mapping[str, Number]] = {
    **_rows(
        "TD3+BC IQL CQL IDQL DT DD LDCQ DDS",
        """
        halfcheetah-medium 48.3 47.4 44.0 51.0 42.6 49.1 42.8 42.5±2.6
        hopper-medium 59.3 66.3 58.5 65.4 67.6 79.3 66.2 84.7±2.1
        walker2d-medium 83.7 78.3 72.5 82.5 74.0 82.5 69.4 75.1±3.1
        halfcheetah-medium-replay 44.6 44.2 47.8 45.9 36.6 39.3 41.8 41.6±1.5
        hopper-medium-replay 60.9 94.7 95.0 92.1 82.7 100.0 66.2 84.6±1.1
        walker2d-medium-replay 81.8 73.9 77.2 85.1 66.6 75.0 68.5 72.9±0.4
        halfcheetah-medium-expert 90.7 86.7 91.6 95.9 86.8 90.6 90.2 94.2±1.6
        hopper-medium-expert 98.0 91.5 105.4 108.6 107.6 111.8 111.3 109.8±1.5
        walker2d-medium-expert 110.1 109.6 108.8 112.7 108.1 108.8 109.3 108.3±0.5
        """,
    ),
    **_rows(
        "IQL CQL DQL IDQL DT LDCQ OPAL DDS",
        """
        antmaze-umaze 87.5 74.0 93.4 94.0 59.2 - - 95.6±1.2
        antmaze-umaze-diverse 62.2 84.0 66.2 80.2 53.0 - - 94.5±0.6
        antmaze-medium-play 71.2 61.2 76.6 84.5 0.0 - - 88.5±0.8
        antmaze-medium-diverse 70.0 53.7 78.6 84.8 0.0 75.6 81.1 89.1±0.5
        antmaze-large-play 39.6 15.8 46.4 63.5 0.0 - - 81.9±0.8
        antmaze-large-diverse 47.5 14.9 56.6 67.9 0.0 73.6 70.3 82.6±0.6
        """,
    ),
    **_rows(
        "BC IQL CQL DQL DT DD LDCQ DDS",
        """
        kitchen-partial 38.0 46.3 50.1 60.5 42.0 57.0 67.8 65.1±1.5
        kitchen-mixed 51.5 51.0 52.4 62.6 50.7 65.0 62.3 67.5±0.8
        """,
    ),
}
"""Task -> method -> normalised score."""

TABLE2: Mapping[tuple[int, int], Number] = {
    (dimension, skills): _number(value)
    for dimension, row in {
        32: "85.2±0.2 85.1±1.5 62.8±0.9 0.0",
        64: "79.3±0.5 88.9±0.3 68.3±0.4 0.0",
        128: "76.3±0.7 77.8±0.3 82.6±0.6 78.2±0.2",
        256: "81.5±0.3 85.2±0.2 81.6±1.1 76.8±0.7",
    }.items()
    for skills, value in zip((4, 8, 16, 32), row.split(), strict=True)
}
"""(D, K) -> success on antmaze-large-diverse."""

TABLE3: Mapping[str, Mapping[tuple[str, str], Number]] = {
    task: dict(
        zip(
            (("gru", "mlp"), ("transformer", "mlp"), ("gru", "diffusion"), ("transformer", "diffusion")),
            map(_number, row.split()),
            strict=True,
        )
    )
    for task, row in {
        "antmaze-large-diverse": "43.4±2.4 63.0±0.8 32.2±1.3 82.6±0.6",
        "kitchen-mixed": "50.3±2.7 51.4±1.8 31.3±3.2 67.5±0.8",
    }.items()
}
"""Task -> (encoder, decoder) -> score."""


def number_of(table: str, task: str, method: str, settings: Mapping[str, object]) -> Number | None:
    """Return the paper's number that stands beside one of ours.

    Args:
        table: ``table1``, ``table2`` or ``table3``; anything else has no numbers.
        task: Ours. Tables 2 and 3 take the paper's AntMaze-Large-Diverse for a task that the paper does not have.
        method: Title of the method.
        settings: Axis -> value of the row and column.
    """
    task = task.partition("@")[0].partition("?")[0]
    if table == "table1":
        return TABLE1.get(task, {}).get(SHORT.get(method, method))
    dimension, skills = settings.get("skill.model.skill_dim"), settings.get("skill.model.num_skills")
    if table == "table2" and isinstance(dimension, int) and isinstance(skills, int):
        return TABLE2.get((dimension, skills))
    if table == "table3":
        row = TABLE3.get(task, TABLE3["antmaze-large-diverse"])
        return row.get((str(settings.get("skill.model.encoder")), str(settings.get("skill.model.decoder"))))
    return None
