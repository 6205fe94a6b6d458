"""Figures hold what the tables say: walls, paths, codes, ends."""

import imageio.v3 as imageio
import numpy as np
import pandas as pd
import pytest
from matplotlib.collections import LineCollection, PatchCollection

from dds_lightning.errors import UserError
from dds_lightning.interpret.clip import write_clip
from dds_lightning.interpret.curves import plot_training_curves
from dds_lightning.interpret.maze import (
    choose_episodes,
    plot_failures,
    plot_single_skills,
    plot_skills_by_start,
    plot_trajectories,
    plot_value_map,
)
from dds_lightning.interpret.palette import NO_SKILL, SKILL_COLOURS, skill_colour
from dds_lightning.results import RolloutPath, RolloutResult
from dds_lightning.tasks import get_task

TASK = get_task("pointmaze-umaze-diverse")
ROUTE = np.array([TASK.cell_to_xy(cell) for cell in ((1, 1), (1, 2), (1, 3), (2, 3), (3, 3), (3, 2), (3, 1))])


def walk(fraction: float = 1.0, codes: tuple[int, ...] = (0, 1)) -> RolloutPath:
    """Part of the way from start to goal in 60 steps, the codes changing every ten."""
    t = np.linspace(0, fraction * (len(ROUTE) - 1), 61)
    positions = np.stack([np.interp(t, np.arange(len(ROUTE)), ROUTE[:, i]) for i in (0, 1)], axis=1)
    return RolloutPath(positions.astype(np.float32), np.array([codes[(i // 10) % len(codes)] for i in range(60)], np.int16))


@pytest.fixture
def result() -> RolloutResult:
    """Two good and one failed episode of a policy, four replays of single skills, and one actor without skills."""
    rows, paths = [], {}

    def add(actor, label, episode, path, success):
        paths[actor, episode] = path
        x, y = path.positions[-1]
        rows.append(
            {"actor": actor, "label": label, "episode": episode, "success": success, "length": len(path.codes)}
            | {"final_x": x, "final_y": y, "final_code": int(path.codes[-1])}
        )

    for episode, fraction in enumerate((1.0, 0.4, 1.0)):
        add("AWR policy", "AWR policy", episode, walk(fraction), fraction == 1.0)
    for episode in range(4):
        code = episode % 2
        add("single skill", f"skill {code}", episode, walk(0.3 + 0.1 * episode, (code,)), False)
    add("cloning", "cloning", 0, walk(0.5, (-1,)), False)
    return RolloutResult(TASK.name, pd.DataFrame(rows), paths)


def walls(ax) -> int:
    (collection,) = [c for c in ax.collections if isinstance(c, PatchCollection)]
    return len(collection.get_paths())


def test_every_wall_is_drawn_once(result):
    ax = plot_trajectories(TASK, result, "AWR policy").axes[0]
    assert walls(ax) == sum(row.count("1") for row in TASK.maze_map)


def test_each_step_has_the_colour_of_its_skill(result):
    ax = plot_trajectories(TASK, result, "AWR policy", episodes=2).axes[0]
    lines = [c for c in ax.collections if isinstance(c, LineCollection)]
    assert [len(line.get_segments()) for line in lines] == [60, 60]
    from matplotlib.colors import to_rgba

    assert tuple(lines[0].get_colors()[0]) == to_rgba(skill_colour(0))
    assert tuple(lines[0].get_colors()[15]) == to_rgba(skill_colour(1))
    assert "67% of 3 episodes" in ax.get_title()


def test_single_skills_have_a_panel_each(result):
    figure = plot_single_skills(TASK, result)
    visible = [ax for ax in figure.axes if ax.get_visible()]
    assert [ax.get_title()[:7] for ax in visible] == ["skill 0", "skill 1"]
    assert len([c for c in visible[0].collections if isinstance(c, LineCollection)]) == 2


def test_every_start_has_a_panel(result):
    starts = np.repeat(ROUTE[:3], 2, axis=0)
    positions = np.stack([start + np.zeros((11, 2)) for start in starts])
    figure = plot_skills_by_start(TASK, starts, positions, np.tile([0, 1], 3))
    panels = [ax for ax in figure.axes if ax.get_visible()]
    assert len(panels) == 3
    assert all(sum(text.get_text() in {"0", "1"} for text in ax.texts) == 2 for ax in panels)


def test_failures_show_the_end_and_the_skill_in_use(result):
    ax = plot_failures(TASK, result, "AWR policy").axes[0]
    assert "1 of 3 episodes failed" in ax.get_title()
    (mark,) = ax.texts
    assert mark.get_text() == "1"
    assert mark.xy == pytest.approx(tuple(result.paths["AWR policy", 1].positions[-1]))


def test_without_failures_the_figure_says_so(result):
    good = RolloutResult(result.task, result.episodes[result.episodes["success"]], result.paths)
    ax = plot_failures(TASK, good, "AWR policy").axes[0]
    assert "no episode of 2 failed" in ax.get_title()
    assert len(ax.texts) == 2


def test_value_map_asks_at_free_places_only():
    asked = []

    def value(observations):
        asked.append(observations)
        return -np.linalg.norm(observations[:, :2] - TASK.goal_xy(), axis=1)

    figure = plot_value_map(TASK, value, lambda o: np.zeros(len(o), int), np.array([[1.0, 0.0]]), resolution=3)
    assert len(asked[0]) == 9 * len(TASK.free_cells())
    assert {tuple(cell) for cell in TASK.xy_to_cell(asked[0][:, :2])} == set(TASK.free_cells())
    assert len(figure.axes[0].images) == len(TASK.free_cells())


def test_an_unknown_contestant_is_named_with_the_known_ones(result):
    with pytest.raises(UserError, match="no contestant 'X' in the table, only AWR policy, single skill, cloning"):
        plot_trajectories(TASK, result, "X")


def test_the_median_success_is_shown_first(result):
    assert choose_episodes(result, "AWR policy") == [0, 2]
    assert choose_episodes(result, "single skill") == [0, 1, 2, 3]


def test_clip_has_the_frames_it_was_asked_for_and_stays_small(tmp_path):
    path = write_clip(tmp_path / "clip.gif", TASK, walk(), "episode", frames=20, fps=5)
    images = imageio.imread(path)
    assert len(images) == 20
    assert imageio.immeta(path, index=19)["duration"] >= 1000  # the last one stays, to see the end
    assert path.stat().st_size < 400_000
    assert (images[0] != images[15]).any()
    assert [p.name for p in tmp_path.iterdir()] == ["clip.gif"]


def test_curves_draw_the_stages_that_are_there(tmp_path):
    table = pd.DataFrame({"step": [0, 50, 100], "train/denoising": [3.0, 2.0, 1.0], "val/codes_used": [np.nan, 8, 16]})
    table.to_csv(tmp_path / "metrics.csv", index=False)
    figure = plot_training_curves({"skill": tmp_path / "metrics.csv", "policy": tmp_path / "none.csv"})
    assert len(figure.axes) == 4
    assert figure.axes[0].lines[0].get_ydata().tolist() == [3.0, 2.0, 1.0]
    assert figure.axes[2].lines[0].get_xdata().tolist() == [50, 100]
    assert not figure.axes[3].lines


def linear(colour: str) -> np.ndarray:
    rgb = np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)]) / 255
    return np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)


def lab(rgb: np.ndarray) -> np.ndarray:
    """CIELAB of linear sRGB."""
    xyz = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]]) @ rgb
    f = np.cbrt(np.maximum(xyz / np.array([0.9505, 1.0, 1.089]), 1e-6))
    return np.array([116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])])


@pytest.mark.parametrize(("first", "least"), [(8, 12.0), (16, 4.0)])
def test_colours_differ_also_to_a_deuteranope(first, least):
    """Machado et al. (2009), severity 1; the first eight clearly, all sixteen at least a little."""
    deuteranopia = np.array([[0.367, 0.861, -0.228], [0.280, 0.673, 0.047], [-0.012, 0.043, 0.969]])
    for matrix in (np.eye(3), deuteranopia):
        points = np.array([lab(np.clip(matrix @ linear(c), 0, 1)) for c in SKILL_COLOURS[:first]])
        distance = np.linalg.norm(points[:, None] - points[None], axis=-1) + 1e3 * np.eye(first)
        assert distance.min() > least


def test_no_skill_is_grey_and_codes_come_round():
    assert skill_colour(-1) == NO_SKILL
    assert skill_colour(17) == SKILL_COLOURS[1]
    assert len(set(SKILL_COLOURS)) == 16
