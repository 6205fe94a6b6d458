"""The critic and the policy over a whole maze: V as a heat map, the likeliest code and where it leads."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
import torch
from matplotlib.colors import BoundaryNorm
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from numpy.typing import NDArray

from dds_lightning.errors import UserError
from dds_lightning.interpret.draw.drawing import LABEL, draw_number, draw_walls, maze_figure
from dds_lightning.interpret.measure.replay import replay_codes
from dds_lightning.interpret.measure.states import at_rest, rest_states
from dds_lightning.tasks import Task

if TYPE_CHECKING:
    from dds_lightning.agent import DDSAgent
    from dds_lightning.policy import PolicyModule

ValueFunction = Callable[[NDArray[np.float32]], NDArray[np.float32]]
"""Maps observations (N, O) to values (N,)."""
CodeFunction = Callable[[NDArray[np.float32]], NDArray[np.int64]]
"""Maps observations (N, O) to codes (N,)."""

BANDS = 12
"""Colours of the value map."""
STAYS = 0.02
"""An arrow shorter than this fraction of a cell is not drawn: the skill leads nowhere from there."""


def value_and_codes(policy: PolicyModule) -> tuple[ValueFunction, CodeFunction]:
    """Return V and the likeliest code of a policy as functions of NumPy observations (N, O).

    V is clamped to the range that the rewards and discounts of the policy's data allow: a network may err beyond it,
    for example above 0 beside a goal in a maze where every step costs something.
    """
    policy.eval()
    device = next(policy.parameters()).device
    least, most = policy.value_range.tolist()

    @torch.inference_mode()
    def value(observations: NDArray[np.float32]) -> NDArray[np.float32]:
        return policy.v(torch.from_numpy(observations).to(device)).clamp(least, most).cpu().numpy()

    @torch.inference_mode()
    def codes(observations: NDArray[np.float32]) -> NDArray[np.int64]:
        return policy.codes(torch.from_numpy(observations).to(device), selection="greedy").cpu().numpy()

    return value, codes


def value_table(task: Task, agent: DDSAgent, steps: int | None = None, seed: int = 0, env: Any = None) -> pd.DataFrame:
    """Evaluate the critic and the policy in every free cell, for a body at rest in its middle.

    Args:
        task: A maze.
        agent: An agent with a policy.
        steps: How many steps the likeliest code is held to see where it leads; None takes H.
        seed: Seed of the decoder's noise.
        env: An environment from `replay.simulator`; without it one is created.

    Returns:
        One row per free cell: `row`, `column`, `x`, `y` (m), `value`, `code` (the likeliest), its `probability`, `dx`
        and `dy` (m, where it led).

    Raises:
        UserError: The task has no maze, or the agent has no policy.
    """
    if agent.policy is None:
        raise UserError("the agent has no policy, expected one with values and choices to map")
    cells = task.free_cells()
    places = task.cell_to_xy(list(cells))
    observations = at_rest(task, places)
    value, codes = value_and_codes(agent.policy)
    chosen = codes(observations)
    with torch.inference_mode():
        chances = agent.policy.logits(torch.from_numpy(observations).to(agent.device)).softmax(dim=-1).cpu().numpy()
    made = replay_codes(
        task, agent.skill, rest_states(task, cells), chosen, steps, agent.noise_scale, seed, env, each=True
    )
    moved = made.qpos[np.arange(len(cells)), made.lengths, :2] - places
    rows, columns = np.array(cells).T
    table = {"row": rows, "column": columns, "x": places[:, 0], "y": places[:, 1], "value": value(observations)}
    table |= {"code": chosen, "probability": chances[np.arange(len(cells)), chosen]}
    return pd.DataFrame({**table, "dx": moved[:, 0], "dy": moved[:, 1]})


def plot_policy_map(task: Task, agent: DDSAgent, steps: int | None = None, seed: int = 0, env: Any = None) -> Figure:
    """Draw the `plot_value_map` of an agent, with arrows that show where the likeliest code leads from each cell.

    The arguments and errors are those of `value_table`.
    """
    table = value_table(task, agent, steps, seed, env)
    assert agent.policy is not None
    value, codes = value_and_codes(agent.policy)
    return plot_value_map(task, value, codes, arrows=table[["dx", "dy"]].to_numpy())


def plot_value_map(
    task: Task,
    value: ValueFunction,
    codes: CodeFunction | None = None,
    directions: NDArray[Any] | None = None,
    resolution: int = 6,
    arrows: NDArray[Any] | None = None,
) -> Figure:
    """Draw V over the free cells, the body at rest, with the chosen code and where it leads.

    Each colour covers the same area of the maze, so that the slope is visible far from the goal too, where a discounted
    value is small; the colour bar shows the values at which colours change.

    Args:
        task: The maze.
        value: Maps observations (N, O) to V (N,); position first, then the body as it starts an episode.
        codes: Maps observations (N, O) to codes (N,); evaluated at cell centres.
        directions: (K, 2) mean displacement of each code in metres, for the arrows.
        resolution: Points per cell on each axis.
        arrows: (C, 2) displacement of the chosen code from each free cell, in their order, instead of `directions`.
    """
    figure, ax = maze_figure(task)
    draw_walls(ax, task)
    limits = ax.get_xlim(), ax.get_ylim()
    half = task.cell_size / 2
    offsets = (np.arange(resolution) + 0.5) / resolution * task.cell_size - half
    cells = [task.cell_to_xy(cell) for cell in task.free_cells()]
    patches = [np.stack(np.meshgrid(offsets, offsets), axis=-1) + centre for centre in cells]  # (R, R, 2) each
    points = np.concatenate([patch.reshape(-1, 2) for patch in patches])
    values = np.asarray(value(at_rest(task, points)), dtype=float).reshape(len(cells), resolution, resolution)
    edges = np.unique(np.quantile(values, np.linspace(0, 1, BANDS + 1)))
    if len(edges) < 2:  # V is the same everywhere
        edges = edges[0] + np.array([-0.5, 0.5])
    norm = BoundaryNorm(edges, 256)
    for centre, patch in zip(cells, values, strict=True):
        sides = (centre[0] - half, centre[0] + half, centre[1] - half, centre[1] + half)
        image = ax.imshow(patch, extent=sides, origin="lower", cmap="viridis", norm=norm, zorder=0.5)
    bar = figure.colorbar(image, ax=ax, shrink=0.9, spacing="uniform", ticks=edges, format="%.3g")
    bar.set_label("V(s), discounted learning reward", fontsize=LABEL)
    bar.ax.tick_params(labelsize=9.5)
    if codes is not None:
        chosen = np.asarray(codes(at_rest(task, np.stack(cells))))
        ways = arrows if arrows is not None else None if directions is None else np.asarray(directions)[chosen]
        for i, (centre, code) in enumerate(zip(cells, chosen, strict=True)):
            if ways is not None and (length := float(np.linalg.norm(ways[i]))) > STAYS * task.cell_size:
                tip = centre + ways[i] / length * 0.48 * task.cell_size
                outline = [withStroke(linewidth=3.2, foreground="black")]  # visible on dark and on light values
                line = {"color": "white", "lw": 1.5, "path_effects": outline}
                arrow = {"arrowstyle": "->", "shrinkA": 0, "shrinkB": 0, **line}
                ax.annotate("", tuple(tip), tuple(centre), arrowprops=arrow, zorder=5.5)
            draw_number(ax, centre, int(code), size=8)
    ax.set(xlim=limits[0], ylim=limits[1])
    where = "from there" if arrows is not None else "on average"
    ax.set_title(f"Value of a body at rest; likeliest skill and where it leads {where}", fontsize=LABEL)
    return figure
