"""The atlas of small untrained agents: one file, complete, and everything in it can be told without seeing."""

import io
import re
from html.parser import HTMLParser

import numpy as np
import pytest
from PIL import Image

from dds_lightning.console.reports import plain
from dds_lightning.interpret.atlas import pictures as atlas_pictures
from dds_lightning.interpret.atlas.build import make_atlas
from dds_lightning.interpret.atlas.page import page, write_atlas, write_pictures
from dds_lightning.interpret.atlas.pictures import most_different
from dds_lightning.interpret.draw import rendering
from dds_lightning.interpret.draw.palette import skill_colour
from dds_lightning.interpret.draw.png import small_png
from dds_lightning.rollout.actors import Contestant, single_skills
from dds_lightning.rollout.play import rollout
from dds_lightning.tasks import get_task
from tests.interpret.tiny import hold_shorter, recorded, tiny_agent, tiny_skill

MAZE = get_task("pointmaze-umaze-diverse")
HOPPER = get_task("hopper-medium")


class Reader(HTMLParser):
    """Collects tags and checks that they close in order."""

    def __init__(self, text):
        super().__init__()
        self.open, self.tags, self.words = [], [], ""
        self.feed(text)
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag not in ("meta", "img", "br", "input"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.words += data

    def all(self, tag):
        return [attributes for name, attributes in self.tags if name == tag]


@pytest.fixture(scope="module", autouse=True)
def _small_pictures():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(atlas_pictures, "DPI", 30)
        hold_shorter(patch, pointmaze=0.1, hopper=0.08, walker2d=0.08, halfcheetah=0.08)
        patch.setattr(rendering, "BACKENDS", ())  # pictures by MuJoCo have a test of their own
        patch.delenv("MUJOCO_GL", raising=False)
        yield


@pytest.fixture(scope="module")
def maze():
    """An atlas with everything: policy, episodes, single skills, another model to compare with."""
    agent = tiny_agent(MAZE)
    short = type(MAZE)(**{**vars(MAZE), "max_episode_steps": 20})
    players = [Contestant("policy", agent.variant("sample"), 2), single_skills(agent, 2)]
    result = rollout(short, players, workers=0, progress=False, record=True)
    others = [("continuous skills, clustered", tiny_skill(MAZE, bottleneck="gaussian"))]
    messages: list[str] = []
    made = make_atlas(
        agent, MAZE, recorded(MAZE, 100), result, "policy", "single skill", others, states=3, announce=messages.append
    )
    assert "replaying the skills" in messages
    return made


@pytest.fixture(scope="module")
def hopper():
    """An atlas of skills alone."""
    agent = tiny_agent(HOPPER)
    return make_atlas(type(agent)(agent.skill, None, "random"), HOPPER, recorded(HOPPER, 60), states=3)


def test_every_code_has_a_row_with_all_that_is_known(maze):
    table = maze.table
    assert table["code"].tolist() == [0, 1, 2]
    assert table["share"].sum() == pytest.approx(1.0)
    assert (table["nearest"] != table["code"]).all()
    np.testing.assert_allclose(table["near"], maze.distances[range(3), table["nearest"]])
    assert table["alone_episodes"].tolist() == [2, 2, 2]
    used = table["share"] > 0.1 / 3
    assert table["recovered"].notna().tolist() == used.tolist()
    assert sorted(maze.clips) == np.flatnonzero(used).tolist()
    assert maze.recovery.codes.tolist() == np.flatnonzero(used).tolist()
    assert {"spread", "apart", "value", "chosen", "turn", "reward"} <= set(table)


def test_a_maze_has_paths_values_and_timelines(maze):
    expected = {"starts_by_skill", "skills_by_start", "stitching", "trajectories", "values", "recovery", "trip"}
    assert set(maze.pictures) == expected | {"effects", "transitions", "distances", "diversity", "where", "comparison"}
    for picture in [*maze.pictures.values(), *maze.clips.values()]:
        with Image.open(io.BytesIO(picture.data)) as image:
            assert image.size == picture.size
    assert all(picture.mime == "image/gif" for picture in maze.clips.values())


def test_a_runner_has_strobes_and_no_maze(hopper):
    assert set(hopper.pictures) == {
        "strobe",
        "trip",
        "recovery",
        "effects",
        "transitions",
        "distances",
        "diversity",
        "where",
    }
    assert hopper.clips
    assert hopper.comparison is None
    assert {"alone", "value", "chosen", "dy"}.isdisjoint(hopper.table)
    assert "Stick figures" in hopper.pictures["strobe"].alt


def test_the_page_needs_nothing_but_itself(maze, tmp_path):
    path = write_atlas(maze, tmp_path / "atlas.html", [("data", "mine")], "dds atlas here")
    text = path.read_text(encoding="utf-8")
    read = Reader(text)
    images = read.all("img")
    assert len(images) == len(maze.pictures) + len(maze.clips)
    assert all(image["src"].startswith("data:image/") for image in images)
    assert all(len(image["alt"]) > 20 and int(image["width"]) > 0 for image in images)
    assert not re.search(r"https?://|<script|<link|@import|url\(", text)
    assert "prefers-color-scheme: dark" in text
    assert 'name="viewport"' in text
    assert len(read.all("input")) == len(read.all("label")) == len(maze.pictures)  # each can be enlarged, by keys too
    widths = [style["style"] for style in read.all("figure")]
    assert widths == [f"--w:{image['width']}" for image in images if image["src"].startswith("data:image/png")]
    assert re.search(r"\.picture img \{[^}]*width: 100%; height: auto", text)  # it scales with the window
    assert not re.search(r"(header|main)[^{]*\{[^}]*max-width", text)  # the page is as wide as the window
    anchors = {attributes["id"] for _, attributes in read.tags if "id" in attributes}
    links = [link["href"] for link in read.all("a")]
    assert links
    assert {link[1:] for link in links} <= anchors
    assert "dds atlas here" in read.words


def test_the_page_tells_the_numbers_of_the_table(maze):
    read = Reader(page(maze))
    rows = len(read.all("article"))
    assert rows == len(maze.clips)
    found, words = maze.recovery, " ".join(read.words.split())
    assert f"gets the same code in {100 * maze.trip.accuracy:.1f} %" in words
    assert f"recovered in {100 * found.accuracy:.1f} %" in words
    assert f"chance is {100 * found.chance:.1f} %" in words
    for share in maze.table["share"]:
        assert f"{100 * share:.1f}" in read.words
    assert "continuous skills, clustered" in read.words
    (compared,) = [t for t in page(maze).split("<table>") if "decoding error" in t]
    assert compared.count('<th scope="col">') * 2 == compared.count("<td>") + compared.count('<th scope="row">')


def test_a_page_of_skills_alone_leaves_out_what_was_not_measured(hopper, maze):
    read = Reader(page(hopper))
    headings = [attributes.get("id") for attributes in read.all("section")]
    assert headings == ["replays", "skills", "recovery", "places", "relations", "numbers"]
    assert "pitch change" in read.words
    columns = re.findall(r'<th scope="col"[^>]*>([^<]*)<', page(hopper))
    assert "pitch change" in columns
    assert not {"value", "chosen"} & set(columns)  # no policy, so neither
    assert {"value", "chosen"} <= set(re.findall(r'<th scope="col"[^>]*>([^<]*)<', page(maze)))


def test_words_from_outside_cannot_become_markup(hopper):
    read = Reader(page(hopper, [("data", "<script>alert(1)</script>")], "dds atlas '<img src=x onerror=y>'"))
    assert not read.all("script")
    assert not [image for image in read.all("img") if "onerror" in image]
    assert "<script>alert(1)</script>" in read.words
    assert "dds atlas '<img src=x onerror=y>'" in read.words


def test_facts_are_plain_json(maze, hopper):
    facts = plain(maze.facts())
    assert len(facts["skills"]) == facts["num_skills"] == 3
    assert facts["recovery"]["chance"] == maze.recovery.chance
    assert facts["round_trip"]["accuracy"] == maze.trip.accuracy
    assert len(facts["transitions"]) == 3
    assert plain(hopper.facts())["comparison"] is None


def test_bodies_are_shown_in_the_state_in_which_skills_differ_most():
    ways = np.zeros((3, 2, 5, 1))  # three codes, two states, five moments, one position
    t = np.arange(5)
    ways[0, 1, :, 0], ways[1, 1, :, 0], ways[2, 1, :, 0] = t, 1.1 * t, -t
    state, codes = most_different(ways + 7.0, np.array([0.5, 0.3, 0.2]), 2)
    assert (state, codes.tolist()) == (1, [0, 2])  # from state 0 all do the same
    assert most_different(ways, np.array([0.2, 0.3, 0.5]), 2)[1].tolist() == [1, 2]  # the commonest, then the farthest
    ended = ways.copy()
    ended[2, :, 1:] = np.nan  # what ends at once cannot differ
    assert most_different(ended, np.array([0.5, 0.3, 0.2]), 2)[1].tolist() == [0, 1]
    assert most_different(ways, np.array([0.5, 0.3, 0.2]), 9)[1].tolist() == [0, 1, 2]


def test_pictures_are_written_small_and_named_after_the_page(maze, tmp_path):
    paths = write_pictures(maze, tmp_path / "new", "mine")
    assert sorted(path.name for path in paths) == sorted(f"mine-{n.replace('_', '-')}.png" for n in maze.pictures)
    assert sorted(paths) == sorted((tmp_path / "new").iterdir())
    for path, picture in zip(paths, maze.pictures.values(), strict=True):
        assert path.stat().st_size < len(picture.data)
        with Image.open(path) as image:
            assert (image.size, image.mode) == (picture.size, "P")


def test_the_public_names_are_there():
    from dds_lightning import interpret

    assert all(callable(getattr(interpret, name)) for name in interpret._HOMES)
    with pytest.raises(AttributeError, match="no_such_name"):
        _ = interpret.no_such_name


def test_a_kitchen_has_the_way_of_its_arm(monkeypatch):
    task = get_task("kitchen-mixed")
    hold_shorter(monkeypatch, kitchen=0.24)
    agent = tiny_agent(task, num_skills=2, horizon=3)
    made = make_atlas(type(agent)(agent.skill, None, "random"), task, recorded(task, 24), states=2)
    assert {"strobe", "where", "recovery"} <= set(made.pictures)
    assert made.table["distance"].notna().any()
    assert "rad/s" in Reader(page(made)).words


def test_a_small_picture_keeps_the_colours_that_mean_something():
    rng = np.random.default_rng(0)
    pixels = rng.integers(0, 256, (200, 300, 3)).astype(np.uint8)  # a photograph with every colour
    pixels[:9, :9] = [int(skill_colour(1)[i : i + 2], 16) for i in (1, 3, 5)]
    pixels[20:, 100:] = 255
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, format="png")
    with Image.open(io.BytesIO(small_png(file.getvalue()))) as image:
        small = np.asarray(image.convert("RGB"))
    np.testing.assert_array_equal(small[:9, :9], pixels[:9, :9])
    np.testing.assert_array_equal(small[20:, 100:], 255)
    few = small_png(file.getvalue(), limit=1)  # as small as it gets
    assert len(few) < len(small_png(file.getvalue()))
    with Image.open(io.BytesIO(few)) as image:
        assert len(image.getcolors()) <= 64
