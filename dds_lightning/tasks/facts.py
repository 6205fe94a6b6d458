"""Everything about one task, for people and for programs: what `dds tasks` prints."""

from __future__ import annotations

from typing import Any

from dds_lightning.tasks import get_task
from dds_lightning.tasks.bodies import action_names, observation_names
from dds_lightning.tasks.task import Cell, Task, bounds_text

REWARDS = {
    "environment": "r is the environment's own reward, as recorded",
    "goal": "r is 1 for the step that reaches the goal, else 0, whatever goal was recorded",
    "arrival": "r is 1 for the step that reaches the goal, else 0, as recorded with one of the evaluation's goals",
    "subtasks": "r is the number of subtasks done in the state reached, at every step",
}
PAPERS_DATA = (
    "measured with D4RL's data in D4RL's physics: a score from other data or in another physics cannot be compared"
)
_PHYSICS = {
    ("halfcheetah", "v4"): "the closest successor of Gym's v2 class, in which D4RL recorded",
    ("halfcheetah", "v5"): "the same physics and rewards as v4",
    ("hopper", "v4"): "the closest successor of Gym's v2 class, in which D4RL recorded",
    ("hopper", "v5"): "as v4, but the step that falls does not earn the reward of 1 for being upright",
    ("walker2d", "v4"): "the closest successor of Gym's v2 class, in which D4RL recorded; right foot's friction 0.9",
    ("walker2d", "v5"): "as v4, but the right foot's friction is 1.9 as the left one's, and the step that falls does "
    "not earn the reward of 1 for being upright",
    ("antmaze", "d4rl"): "torque of +-30 N m; starts with noise on every coordinate; every episode "
    "draws its goal; (0, 0) in the start cell, y down the map",
    ("antmaze", "robotics"): "gymnasium-robotics': torque of +-150 N m; starts at rest; the goal stands "
    "still; (0, 0) in the maze's middle, y up the map",
}
"""(First part of the name, physics) -> how it differs from the other physics, apart from the numbers in the row."""

_NUMBERS = {
    "env_id": "environment",
    "step_seconds": "seconds a step",
    "origin": "origin",
    "goal_radius": "goal radius",
    "goal_noise": "goal noise",
}
"""Attributes that a variant may change -> their names in the output."""


def task_facts(task: Task) -> dict[str, Any]:
    """Return every fact about a task, by the names that `dds tasks` uses; what does not apply is None or empty.

    Lengths are in metres, cells are (row, column), `data` holds the arguments for `--data`.
    """
    return {
        "task": task.name,
        "family": task.family,
        "environment": task.env_id,
        "physics": task.physics,
        "variants": _variants(task),
        "observations": task.observation_dim,
        "observation": task.observation_layout,
        "observation names": observation_names(task),
        "actions": task.action_dim,
        "action names": action_names(task),
        "action box": (task.action_low, task.action_high),
        "steps": task.max_episode_steps,
        "seconds a step": task.step_seconds,
        "seconds": _seconds(task),
        "maze": task.maze_map,
        "cell size": task.cell_size if task.maze_map else None,
        "origin": task.origin if task.maze_map else None,
        "start": _place(task, task.start_cell),
        "goal": _place(task, task.goal_cell),
        "goal radius": task.goal_radius if task.maze_map else None,
        "goal noise": task.goal_noise if task.maze_map else None,
        "subtasks": task.subtasks,
        "learning reward": reward_formula(task),
        "reward": REWARDS[task.data_reward],
        "score 0": task.score_min,
        "score 100": task.score_max,
        "episodes": task.evaluation_episodes,
        "data": data_specs(task),
        "data sets": dict(task.data_ids),
        "recorded in": recorded_in(task),
        "paper": task.paper_score,
        "paper's data": None if task.paper_score is None else PAPERS_DATA,
    }


def task_lines(task: Task) -> list[tuple[str, str]]:
    """Return the same facts for people, as (name, text) line by line."""
    layout = f": {task.observation_layout}" if task.observation_layout else ""
    return [
        ("environment", task.env_id + (f", physics {task.physics}" if task.physics else "")),
        ("observation", f"{task.observation_dim} numbers{layout}"),
        (
            "action",
            f"{task.action_dim} numbers from {bounds_text(task.action_low)} to {bounds_text(task.action_high)}: "
            f"{', '.join(action_names(task))}",
        ),
        ("episode", f"at most {task.max_episode_steps} steps of {task.step_seconds:g} s, {_seconds(task):g} s in all"),
        *_maze_lines(task),
        *([("subtasks", ", ".join(task.subtasks))] if task.subtasks else []),
        ("learning reward", f"{reward_formula(task)}, where {REWARDS[task.data_reward]}"),
        (
            "score",
            f"a return of {task.score_min:.10g} is 0, {task.score_max:.10g} is 100; by the environment's rewards",
        ),
        ("evaluation", f"{task.evaluation_episodes} episodes"),
        *_data_lines(task),
        ("recorded in", " or ".join(recorded_in(task))),
        *((name, _variant_text(task, found)) for name, found in _variants(task).items()),
        ("paper", "no score" if task.paper_score is None else f"{task.paper_score:g} (table 1), {PAPERS_DATA}"),
    ]


def draw_maze(task: Task) -> list[str]:
    """Draw the maze with two characters per cell: ## wall, S start, G goal; rows as in the map."""
    letters = {"1": "##", "0": "  "}
    rows = [[letters[value] for value in row] for row in task.maze_map or ()]
    for letter, cell in (("S ", task.start_cell), ("G ", task.goal_cell)):
        if rows and cell is not None:
            rows[cell[0]][cell[1]] = letter
    return ["".join(row) for row in rows]


def data_specs(task: Task) -> dict[str, str]:
    """Map each source to the `--data` argument of the task's data set there.

    `dds data collect` puts local ones into the folder data; D4RL's files answer to the task's name.
    """
    places = {"local": "data/{}", "d4rl": task.base_name, "minari": "{}"}
    return {source: f"{source}:{places[source].format(name)}" for source, name in task.data_ids.items()}


def recorded_in(task: Task) -> tuple[str, ...]:
    """Return the environments whose recordings fit the task."""
    return tuple(dict.fromkeys((task.env_id, *task.data_env_ids)))


def reward_formula(task: Task) -> str:
    """Return the learner's reward as a formula, for example `0.1 * (r - 1)`; `REWARDS` says what r is."""
    sign = "-" if task.reward_shift < 0 else "+"
    shifted = f"(r {sign} {abs(task.reward_shift):g})" if task.reward_shift else "r"
    return shifted if task.reward_scale == 1 else f"{task.reward_scale:g} * {shifted}"


def _data_lines(task: Task) -> list[tuple[str, str]]:
    notes = {
        "local": "where `dds data collect` puts it",
        "d4rl": f"the file {task.data_ids.get('d4rl')}; `dds data fetch` gets it",
        "minari": "`dds data fetch --source minari` gets it",
    }
    return [(f"data, {source}", f"{spec} ({notes[source]})") for source, spec in data_specs(task).items()]


def _seconds(task: Task) -> float:
    return round(task.max_episode_steps * task.step_seconds, 6)


def _maze_lines(task: Task) -> list[tuple[str, str]]:
    if task.start_cell is None or task.goal_cell is None:
        return []
    goal = f"{_cell(task, task.goal_cell)}, reached within {task.goal_radius:g} m"
    if task.goal_noise:
        goal += f"; each episode moves it, on average {task.goal_noise:g} m along x and along y"
    home = "the start cell" if task.origin_cell in (None, task.start_cell) else f"cell {task.origin_cell}"
    centre = "the maze, y grows up" if task.origin == "centre" else f"{home}, y grows down"
    return [
        ("maze", f"cells of {task.cell_size:g} m; (0, 0) is the middle of {centre} the drawing"),
        ("start", _cell(task, task.start_cell)),
        ("goal", goal),
    ]


def _cell(task: Task, cell: Cell) -> str:
    x, y = task.cell_to_xy(cell)
    return f"row {cell[0]}, column {cell[1]}, at x {x:g} m, y {y:g} m"


def _place(task: Task, cell: Cell | None) -> dict[str, Any] | None:
    return None if cell is None else {"cell": cell, "xy": task.cell_to_xy(cell)}


def _variants(task: Task) -> dict[str, dict[str, Any]]:
    """Return the task's variants: name -> what is different there, as numbers and as text."""
    _, mark, cells = task.name.partition("?")
    base = get_task(f"{task.base_name}{mark}{cells}")
    others = {name: get_task(f"{task.base_name}@{name}{mark}{cells}") for name in task.variants}
    found = {}
    for physics in task.variants:
        other = base if physics == base.physics else others[physics]
        numbers = {
            label: getattr(other, name)
            for name, label in _NUMBERS.items()
            if len({getattr(one, name) for one in others.values()}) > 1
        }
        text = _PHYSICS.get((task.base_name.partition("-")[0], physics), "")
        found[other.name] = {"physics": physics, **numbers, "words": text}
    return found


def _variant_text(task: Task, found: dict[str, Any]) -> str:
    numbers = ", ".join(
        f"{name} {value}" for name, value in found.items() if name not in ("physics", "origin", "words")
    )
    here = "this row: " if found["physics"] == task.physics else ""
    return here + "; ".join(filter(None, (numbers, found["words"])))
