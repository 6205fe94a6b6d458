"""Figures hold what the tables say: walls, paths, codes, ends."""

import io
from itertools import pairwise

import imageio.v3 as imageio
import numpy as np
import pandas as pd
import pytest
from matplotlib.collections import LineCollection, PatchCollection, PathCollection
from matplotlib.colors import to_rgba

from dds_lightning.errors import UserError
from dds_lightning.interpret.draw.clip import write_clip
from dds_lightning.interpret.draw.curves import PANELS, plot_training_curves
from dds_lightning.interpret.draw.maze import (
    choose_episodes,
    plot_failures,
    plot_single_skills,
    plot_skills_by_start,
    plot_starts_by_skill,
    plot_trajectories,
    plot_value_map,
)
from dds_lightning.interpret.draw.palette import NO_SKILL, SKILL_COLOURS, START, WALL, ink, skill_colour
from dds_lightning.rollout.result import RolloutPath, RolloutResult
from dds_lightning.tasks import get_task

TASK = get_task("pointmaze-umaze-diverse")
ROUTE = np.array([TASK.cell_to_xy(cell) for cell in ((1, 1), (1, 2), (1, 3), (2, 3), (3, 3), (3, 2), (3, 1))])


def walk(fraction: float = 1.0, codes: tuple[int, ...] = (0, 1)) -> RolloutPath:
    """Part of the way from start to goal in 60 steps, the codes changing every ten."""
    t = np.linspace(0, fraction * (len(ROUTE) - 1), 61)
    positions = np.stack([np.interp(t, np.arange(len(ROUTE)), ROUTE[:, i]) for i in (0, 1)], axis=1)
    return RolloutPath(
        positions.astype(np.float32), np.array([codes[(i // 10) % len(codes)] for i in range(60)], np.int16)
    )


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
    lines = [c for c in ax.collections if isinstance(c, LineCollection)][::-1]  # the first one lies on top
    assert [len(line.get_segments()) for line in lines] == [60, 60]
    assert tuple(lines[0].get_colors()[0]) == to_rgba(skill_colour(0))
    assert tuple(lines[0].get_colors()[15]) == to_rgba(skill_colour(1))
    assert "67% of 3 episodes" in ax.get_title()
    entries = [text.get_text() for text in ax.get_legend().get_texts()]
    assert entries == ["start", "goal", "0: 50%", "1: 50%"]


def test_the_numbers_along_a_path_are_its_codes_where_they_take_over(result):
    ax = plot_trajectories(TASK, result, "AWR policy", episodes=1).axes[0]
    path = result.paths["AWR policy", 0]
    assert [(text.get_text(), text.xy) for text in ax.texts] == [
        (str(path.codes[t]), pytest.approx(tuple(path.positions[t]))) for t in (10, 20, 30, 40, 50)
    ]  # step 0 is the star's


def test_single_skills_have_a_panel_each(result):
    figure = plot_single_skills(TASK, result)
    assert [ax.texts[0].get_text() for ax in figure.axes] == ["0", "1"]
    assert [ax.texts[1].get_text() for ax in figure.axes] == ["0% reach the goal"] * 2
    assert len([c for c in figure.axes[0].collections if isinstance(c, LineCollection)]) == 2


@pytest.fixture
def replays() -> dict[str, np.ndarray]:
    """Two skills from three starts, ten steps to the right or to the left; the last replay ends after four."""
    starts = np.tile(ROUTE[:3], (2, 1))
    codes = np.repeat([0, 1], 3)
    direction = np.where(codes == 0, 1.0, -1.0)[:, None] * np.array([1.0, 0.0])
    positions = starts[:, None] + 0.1 + 0.03 * np.arange(11)[:, None] * direction[:, None]
    alive = np.ones((6, 10), bool)
    alive[5, 4:] = False
    positions[5, 5:] = np.nan
    return {"starts": starts, "positions": positions, "codes": codes, "alive": alive}


def trails(ax) -> list:
    return [line for line in ax.lines if line.get_marker() == "None"]


def test_every_start_has_a_panel_with_every_skill_and_its_number_at_its_end(replays):
    figure = plot_skills_by_start(TASK, **replays)
    assert len(figure.axes) == 3
    for ax in figure.axes:
        assert sorted(text.get_text() for text in ax.texts) == ["0", "1"]
        assert len(trails(ax)) == 2
    ends = {text.xy for ax in figure.axes for text in ax.texts}
    assert tuple(replays["positions"][5, 4]) in ends  # the one that ended before
    assert not any(np.isnan(ends_xy).any() for ends_xy in ends)


def test_the_window_of_a_start_is_five_cells_inside_the_maze(replays):
    large = get_task("pointmaze-large-diverse")
    starts = np.stack([large.cell_to_xy((7, 1)), large.cell_to_xy((5, 6))])
    figure = plot_skills_by_start(large, starts, np.stack([starts] * 3, axis=1), np.zeros(2, int))
    corner, middle = figure.axes  # in the order of x
    assert (corner.get_xlim(), corner.get_ylim()) == ((-6.0, -1.0), (-4.5, 0.5))
    x, y = large.cell_to_xy((5, 6))
    assert (middle.get_xlim(), middle.get_ylim()) == ((x - 2.5, x + 2.5), (y - 2.5, y + 2.5))
    near = plot_skills_by_start(large, starts, np.stack([starts] * 3, axis=1), np.zeros(2, int), reach=1.0).axes[1]
    assert near.get_xlim() == (x - 1.0, x + 1.0)


def test_every_skill_has_a_panel_with_every_start(replays):
    figure = plot_starts_by_skill(TASK, **replays)
    assert [ax.texts[0].get_text() for ax in figure.axes] == ["0", "1"]
    for code, ax in enumerate(figure.axes):
        assert [len(line.get_xdata()) for line in trails(ax)] == ([11, 11, 11] if code == 0 else [11, 11, 5])
        assert {line.get_color() for line in trails(ax)} == {skill_colour(code)}
        (stars,) = [line for line in ax.lines if line.get_marker() == "*"]
        np.testing.assert_allclose(stars.get_xydata(), ROUTE[:3] + 0.1)  # where the bodies really began
    assert "from 3 starts, 10 steps" in figure.get_suptitle()


@pytest.mark.parametrize("panels", [1, 2, 3])
def test_no_title_is_wider_than_its_figure(replays, panels):
    few = {name: values[:panels] for name, values in replays.items()}
    by_code = {**few, "codes": np.arange(panels)}
    for figure in (plot_skills_by_start(TASK, **few), plot_starts_by_skill(TASK, **by_code)):
        figure.savefig(io.BytesIO())
        title = figure._suptitle.get_window_extent()
        assert figure.bbox.x0 <= title.x0 < title.x1 <= figure.bbox.x1
        assert title.y0 > max(ax.get_window_extent().y1 for ax in figure.axes)
    starts = "1 start" if panels == 1 else f"{panels} starts"
    assert f"from {starts}, 10 steps" in figure.get_suptitle().replace("\n", " ")


def dots(ax) -> np.ndarray:
    (collection,) = [c for c in ax.collections if isinstance(c, PathCollection)]
    return collection.get_offsets()


def test_failures_show_every_end_the_skill_in_use_and_how_many_ended_in_a_cell(result):
    ax = plot_failures(TASK, result, "AWR policy").axes[0]
    assert "1 of 3 episodes failed" in ax.get_title()
    end = result.paths["AWR policy", 1].positions[-1]
    np.testing.assert_allclose(dots(ax), end[None], rtol=1e-6)
    number, count = ax.texts
    assert (number.get_text(), count.get_text()) == ("1", "1×")
    assert number.xy == pytest.approx(tuple(end))
    assert count.get_position() == pytest.approx(tuple(TASK.cell_to_xy(TASK.xy_to_cell(end))))


def test_ends_on_top_of_each_other_are_still_counted(result):
    table = pd.concat([result.episodes[result.episodes["episode"] == 1]] * 7)
    ax = plot_failures(TASK, RolloutResult(TASK.name, table), "AWR policy").axes[0]
    assert len(dots(ax)) == 7
    assert [text.get_text() for text in ax.texts] == ["1", "7×"]
    number, count = ax.texts
    assert count.get_zorder() > number.get_zorder()  # no disc hides a digit of it
    assert [text.get_text() for text in ax.get_legend().get_texts()] == ["goal", "1: 7×"]


def test_ends_of_an_actor_without_skills_have_dots_and_no_number(result):
    ax = plot_failures(TASK, result, "cloning").axes[0]
    assert len(dots(ax)) == 1
    assert [text.get_text() for text in ax.texts] == ["1×"]
    assert [text.get_text() for text in ax.get_legend().get_texts()] == ["goal", "no skill: 1×"]


def test_without_failures_the_figure_says_so_and_shows_the_ends(result):
    good = RolloutResult(result.task, result.episodes[result.episodes["success"]], result.paths)
    ax = plot_failures(TASK, good, "AWR policy").axes[0]
    assert "no episode of 2 failed" in ax.get_title()
    assert len(dots(ax)) == 2
    assert ax.texts[-1].get_text() == "2×"


def test_value_map_asks_at_free_places_only():
    asked = []

    def value(observations):
        asked.append(observations)
        return -np.linalg.norm(observations[:, :2] - TASK.goal_xy(), axis=1)

    figure = plot_value_map(TASK, value, lambda o: np.zeros(len(o), int), np.array([[1.0, 0.0]]), resolution=3)
    assert len(asked[0]) == 9 * len(TASK.free_cells())
    assert {tuple(cell) for cell in TASK.xy_to_cell(asked[0][:, :2])} == set(TASK.free_cells())
    assert len(figure.axes[0].images) == len(TASK.free_cells())
    assert sum(text.get_text() == "0" for text in figure.axes[0].texts) == len(TASK.free_cells())


def test_colours_of_the_value_map_cover_equal_areas_however_skewed_the_values():
    figure = plot_value_map(TASK, lambda o: np.exp(-4.0 * np.linalg.norm(o[:, :2] - TASK.goal_xy(), axis=1)))
    images = figure.axes[0].images
    values = np.concatenate([np.ravel(image.get_array().data) for image in images])
    edges = images[0].norm.boundaries
    counts = np.histogram(values, edges)[0]
    assert len(counts) == 12
    assert counts.max() - counts.min() <= 6  # 252 points, ties by symmetry
    assert edges[-1] / np.median(values) > 10


def test_a_critic_that_knows_nothing_yet_can_be_drawn():
    assert plot_value_map(TASK, lambda o: np.zeros(len(o))).axes[0].images


def test_an_unknown_contestant_is_named_with_the_known_ones(result):
    with pytest.raises(
        UserError, match="actor is 'X', expected one of the contestants in the table: AWR policy, single skill, cloning"
    ):
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


@pytest.mark.parametrize("used", [[3, 4, 4], [7, 7, 7], [0, 1, 1]])
def test_curves_count_codes_in_whole_numbers_and_no_title_meets_another(tmp_path, used):
    files = {stage: tmp_path / f"{stage}.csv" for stage in PANELS}
    for stage, panels in PANELS.items():
        pd.DataFrame({"step": [0, 1, 2], **{column: used for column, _ in panels}}).to_csv(files[stage], index=False)
    figure = plot_training_curves(files)
    figure.savefig(io.BytesIO())
    (codes,) = [ax for ax in figure.axes if ax.get_title() == "codes in use"]
    assert all(tick == round(tick) for axis in (codes.get_yticks(), codes.get_xticks()) for tick in axis)
    for row in (figure.axes[:4], figure.axes[4:]):
        boxes = [ax.title.get_window_extent() for ax in row]
        assert all(left.x1 < right.x0 for left, right in pairwise(boxes))
        assert boxes[-1].x1 < figure.bbox.x1


def linear(colour: str) -> np.ndarray:
    rgb = np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)]) / 255
    return np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)


def lab(rgb: np.ndarray) -> np.ndarray:
    """CIELAB of linear sRGB."""
    xyz = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]]) @ rgb
    f = np.cbrt(np.maximum(xyz / np.array([0.9505, 1.0, 1.089]), 1e-6))
    return np.array([116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])])


VIEWS = {
    "normal": np.eye(3),
    "protanopia": np.array([[0.152, 1.053, -0.205], [0.115, 0.786, 0.099], [-0.004, -0.048, 1.052]]),
    "deuteranopia": np.array([[0.367, 0.861, -0.228], [0.280, 0.673, 0.047], [-0.012, 0.043, 0.969]]),
}


def seen(colours, view: str) -> np.ndarray:
    """CIELAB of colours as Machado et al. (2009) simulate them, severity 1."""
    return np.array([lab(np.clip(VIEWS[view] @ linear(c), 0, 1)) for c in colours])


@pytest.mark.parametrize("view", VIEWS)
@pytest.mark.parametrize(("first", "least"), [(8, 23.0), (16, 12.0)])
def test_colours_differ_also_to_the_colour_blind(view, first, least):
    points = seen(SKILL_COLOURS[:first], view)
    distance = np.linalg.norm(points[:, None] - points[None], axis=-1) + 1e3 * np.eye(first)
    assert distance.min() > least


@pytest.mark.parametrize("view", VIEWS)
def test_no_skill_looks_like_paper_wall_or_start(view):
    others = seen(("#ffffff", WALL, START), view)
    distance = np.linalg.norm(seen(SKILL_COLOURS, view)[:, None] - others[None], axis=-1)
    assert distance.min() > 12


def test_numbers_can_be_read_on_their_colour():
    def luminance(colour):
        return float(np.array([0.2126, 0.7152, 0.0722]) @ linear(colour))

    for colour in (*SKILL_COLOURS, NO_SKILL):
        dark, light = sorted([luminance(colour), luminance({"white": "#ffffff", "black": "#000000"}[ink(colour)])])
        assert (light + 0.05) / (dark + 0.05) >= 3.0


def test_no_skill_is_grey_and_codes_come_round():
    assert skill_colour(-1) == NO_SKILL
    assert skill_colour(17) == SKILL_COLOURS[1]
    assert len(set(SKILL_COLOURS)) == 16
