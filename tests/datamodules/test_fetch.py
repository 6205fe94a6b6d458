"""Downloading: whole or resumed, never half; against a server on this machine."""

from __future__ import annotations

import http.server
import json
import re
import socket
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from datamodules import load_trajectories
from datamodules.sources import download as downloading
from datamodules.sources import fetch as fetching
from datamodules.sources.download import download
from datamodules.sources.fetch import D4RL_SERVER, d4rl_root, fetch, fetch_d4rl, fetch_minari, find_d4rl
from datamodules.trajectories import DataError
from dds_lightning.errors import UserError
from dds_lightning.tasks import get_task
from tests.recordings import record, write_d4rl_file

TASK = get_task("hopper-medium")
CONTENT = b"\x89HDF\r\n\x1a\n" + np.random.default_rng(0).bytes(300_000)


class Server:
    """What the tests set, and what was asked for.

    Attributes:
        files: Path to content; others are not found.
        ranges: Whether parts are served.
        cut_after: Bytes of an answer after which the connection is cut, then None again.
        cuts: How many more answers are cut.
        announce: Lengthens the announced length by so many bytes.
        tag: ETag.
        asked: (path, Range) of every request.
    """

    def __init__(self) -> None:
        self.files: dict[str, bytes] = {}
        self.ranges, self.cut_after, self.cuts, self.announce, self.tag = True, 0, 0, 0, '"one"'
        self.asked: list[tuple[str, str | None]] = []
        self.status = 200
        outer = self

        class Handler(http.server.BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                outer.answer(self)

            def log_message(self, *arguments: Any) -> None:
                pass

        self.httpd = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.url = f"http://127.0.0.1:{self.httpd.server_port}"
        threading.Thread(target=self.httpd.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True).start()

    def answer(self, request: Any) -> None:
        wanted = request.headers.get("Range")
        self.asked.append((request.path, wanted))
        content = self.files.get(request.path)
        if content is None or self.status != 200:
            request.send_error(404 if content is None else self.status)
            return
        start = 0
        unchanged = request.headers.get("If-Range") in (None, self.tag)
        if wanted and self.ranges and unchanged:
            start = int(re.fullmatch(r"bytes=(\d+)-", wanted)[1])  # type: ignore[index]
            if start >= len(content):
                request.send_response(416)
                request.send_header("Content-Range", f"bytes */{len(content)}")
                request.end_headers()
                return
            request.send_response(206)
            request.send_header("Content-Range", f"bytes {start}-{len(content) - 1}/{len(content)}")
        else:
            request.send_response(200)
        request.send_header("Content-Length", str(len(content) - start + self.announce))
        if self.tag:
            request.send_header("ETag", self.tag)
        request.end_headers()
        cut = self.cuts > 0
        self.cuts -= cut
        request.wfile.write(content[start : start + self.cut_after if cut else None])


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch) -> Iterator[Server]:
    monkeypatch.setattr(downloading, "PAUSE", 0.0)
    monkeypatch.setenv("no_proxy", "*")
    running = Server()
    monkeypatch.setattr(fetching, "D4RL_SERVER", running.url)
    monkeypatch.setattr(fetching, "MINARI_SERVER", running.url)
    running.files["/file.hdf5"] = CONTENT
    yield running
    running.httpd.shutdown()
    running.httpd.server_close()


def _left(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


# ---------------------------------------------------------------------- one file


def test_a_whole_file_arrives_and_nothing_else_is_left(server: Server, tmp_path: Path) -> None:
    target = download(f"{server.url}/file.hdf5", tmp_path / "new" / "file.hdf5")
    assert target.read_bytes() == CONTENT
    assert _left(target.parent) == ["file.hdf5"]


def test_what_is_there_is_not_fetched_again(server: Server, tmp_path: Path) -> None:
    (tmp_path / "file.hdf5").write_bytes(b"mine")
    assert download(f"{server.url}/file.hdf5", tmp_path / "file.hdf5").read_bytes() == b"mine"
    assert not server.asked


def test_a_cut_connection_is_taken_up_where_it_broke(server: Server, tmp_path: Path) -> None:
    server.cuts, server.cut_after = 2, 100_000
    download(f"{server.url}/file.hdf5", tmp_path / "file.hdf5")
    assert (tmp_path / "file.hdf5").read_bytes() == CONTENT
    assert [wanted for _, wanted in server.asked] == [None, "bytes=100000-", "bytes=200000-"]


def test_after_giving_up_a_second_call_goes_on(server: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(downloading, "ATTEMPTS", 1)
    server.cuts, server.cut_after = 1, 120_000
    with pytest.raises(
        UserError, match=r"120,000 of 300,008 bytes arrived\); the 120,000 bytes that arrived are kept, and the sa"
    ):
        download(f"{server.url}/file.hdf5", tmp_path / "file.hdf5")
    assert _left(tmp_path) == ["file.hdf5.part", "file.hdf5.part.json"]
    download(f"{server.url}/file.hdf5", tmp_path / "file.hdf5")
    assert (tmp_path / "file.hdf5").read_bytes() == CONTENT
    assert server.asked[-1][1] == "bytes=120000-"
    assert _left(tmp_path) == ["file.hdf5"]


def test_a_server_without_ranges_sends_all_again(server: Server, tmp_path: Path) -> None:
    server.ranges, server.cuts, server.cut_after = False, 1, 100_000
    download(f"{server.url}/file.hdf5", tmp_path / "file.hdf5")
    assert (tmp_path / "file.hdf5").read_bytes() == CONTENT
    assert len(server.asked) == 2


@pytest.mark.parametrize("tag", ['"two"', ""])
def test_a_changed_file_is_fetched_anew(
    tag: str, server: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By its tag, or where the server has none by its size."""
    server.tag = '"one"' if tag else ""
    server.cuts, server.cut_after = 1, 100_000
    with monkeypatch.context() as once:
        once.setattr(downloading, "ATTEMPTS", 1)
        with pytest.raises(UserError):
            download(f"{server.url}/file.hdf5", tmp_path / "file.hdf5")
    server.tag = tag
    server.files["/file.hdf5"] = changed = CONTENT[:8] + CONTENT[::-1]
    assert download(f"{server.url}/file.hdf5", tmp_path / "file.hdf5").read_bytes() == changed


def test_a_file_that_has_shrunk_below_what_came_is_fetched_anew(server: Server, tmp_path: Path) -> None:
    server.tag = ""
    (tmp_path / "file.hdf5.part").write_bytes(CONTENT + b"more")
    facts = {"url": f"{server.url}/file.hdf5", "size": len(CONTENT) + 100, "validator": None}
    (tmp_path / "file.hdf5.part.json").write_text(json.dumps(facts))
    assert download(f"{server.url}/file.hdf5", tmp_path / "file.hdf5").read_bytes() == CONTENT


def test_a_complete_part_only_takes_its_name(server: Server, tmp_path: Path) -> None:
    (tmp_path / "file.hdf5.part").write_bytes(CONTENT)
    facts = {"url": f"{server.url}/file.hdf5", "size": len(CONTENT), "validator": '"one"'}
    (tmp_path / "file.hdf5.part.json").write_text(json.dumps(facts))
    assert download(f"{server.url}/file.hdf5", tmp_path / "file.hdf5").read_bytes() == CONTENT
    assert _left(tmp_path) == ["file.hdf5"]


@pytest.mark.parametrize("facts", [None, "[]", "{", '{"url": "http://elsewhere/file.hdf5", "size": 5}'])
def test_a_part_of_something_else_is_not_gone_on_with(facts: str | None, server: Server, tmp_path: Path) -> None:
    (tmp_path / "file.hdf5.part").write_bytes(b"something else")
    if facts:
        (tmp_path / "file.hdf5.part.json").write_text(facts)
    assert download(f"{server.url}/file.hdf5", tmp_path / "file.hdf5").read_bytes() == CONTENT


def test_fewer_bytes_than_announced_are_no_file(server: Server, tmp_path: Path) -> None:
    server.announce = 50
    with pytest.raises(UserError, match=r"file.hdf5 cannot be read \(.*; the .* bytes that arrived are kept"):
        download(f"{server.url}/file.hdf5", tmp_path / "file.hdf5")
    assert not (tmp_path / "file.hdf5").exists()


def test_another_page_in_its_place_is_deleted(server: Server, tmp_path: Path) -> None:
    server.files["/file.hdf5"] = b"<html>Log in to the network</html>"
    with pytest.raises(
        UserError, match=r"sent something other than an HDF5 file, which was deleted; it began with b'<html>Lo'"
    ):
        download(f"{server.url}/file.hdf5", tmp_path / "file.hdf5")
    assert not list(tmp_path.glob("*.part"))


def test_a_file_that_the_server_lacks_is_said_once(server: Server, tmp_path: Path) -> None:
    with pytest.raises(
        UserError, match=r"/other.hdf5 cannot be read \(the server answers 404 .*elsewhere and put it at"
    ):
        download(f"{server.url}/other.hdf5", tmp_path / "other.hdf5")
    assert len(server.asked) == 1


def test_a_server_in_trouble_is_no_end_of_the_world(server: Server, tmp_path: Path) -> None:
    server.status = 503
    with pytest.raises(UserError, match=r"\(the server answers 503 Service Unavailable\); nothing was lost"):
        download(f"{server.url}/file.hdf5", tmp_path / "file.hdf5")


def test_without_room_nothing_is_written(server: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    usage = downloading.shutil.disk_usage(tmp_path)
    monkeypatch.setattr(downloading.shutil, "disk_usage", lambda path: usage._replace(free=1000))
    with pytest.raises(UserError, match=r"needs 300,008 more bytes, but .* has room for 1,000"):
        download(f"{server.url}/file.hdf5", tmp_path / "file.hdf5")
    assert _left(tmp_path) == []


def test_a_folder_that_cannot_be_written_is_named(server: Server, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(UserError, match=r"file/file.hdf5 cannot be written: "):
        download(f"{server.url}/file.hdf5", tmp_path / "file" / "file.hdf5")


def test_offline_the_message_names_address_place_and_remedy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("no_proxy", "*")
    with socket.socket() as closed:
        closed.bind(("127.0.0.1", 0))
        url = f"http://127.0.0.1:{closed.getsockname()[1]}"
    target = tmp_path / TASK.data_ids["d4rl"]
    monkeypatch.setattr(fetching, "D4RL_SERVER", url)
    with pytest.raises(UserError) as refusal:
        fetch_d4rl(TASK, tmp_path)
    message = str(refusal.value)
    assert "\n" not in message
    for part in (f"{url}/gym_mujoco_v2/{target.name}", "refused", "nothing was lost", f"put it at {target}"):
        assert part in message


# ---------------------------------------------------------------------- data sets


def test_a_tasks_file_is_fetched_and_then_found_by_name(
    server: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("D4RL_DATASET_DIR", str(tmp_path / "d4rl"))
    made = write_d4rl_file(tmp_path / "made.hdf5", TASK, record(TASK, 40))
    server.files["/gym_mujoco_v2/hopper_medium-v2.hdf5"] = made.read_bytes()
    for name in ("hopper-medium-v2", "hopper-medium", "hopper_medium-v2.hdf5", "hopper_medium-v2"):
        with pytest.raises(
            DataError, match=rf"data set '{name}': there is no such file here .*dds data fetch hopper-medium`"
        ):
            load_trajectories(f"d4rl:{name}", "hopper-medium")
    path = fetch("hopper-medium")
    assert path == d4rl_root() / "hopper_medium-v2.hdf5"
    for name in ("hopper-medium-v2", "hopper-medium", "hopper_medium-v2.hdf5", "hopper_medium-v2"):
        assert find_d4rl(name) == path
        assert load_trajectories(f"d4rl:{name}", "hopper-medium").num_steps >= 35


@pytest.mark.parametrize(
    ("task", "address"),
    [
        ("halfcheetah-medium-replay", "gym_mujoco_v2/halfcheetah_medium_replay-v2.hdf5"),
        ("walker2d-medium-expert", "gym_mujoco_v2/walker2d_medium_expert-v2.hdf5"),
        ("antmaze-umaze", "ant_maze_v2/Ant_maze_u-maze_noisy_multistart_False_multigoal_False_sparse_fixed.hdf5"),
        (
            "antmaze-large-play",
            "ant_maze_v2/Ant_maze_hardest-maze_noisy_multistart_True_multigoal_False_sparse_fixed.hdf5",
        ),
        ("kitchen-partial", "kitchen/kitchen_microwave_kettle_light_slider-v0.hdf5"),
        ("kitchen-complete", "kitchen/mini_kitchen_microwave_kettle_light_slider-v0.hdf5"),
    ],
)
def test_addresses_are_d4rls(task: str, address: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[str] = []
    monkeypatch.setattr(fetching, "download", lambda url, target: asked.append(url) or target)
    assert fetch(task, "d4rl", tmp_path) == tmp_path / address.partition("/")[2]
    assert asked == [f"{D4RL_SERVER}/{address}"]


def test_an_older_file_of_the_same_name_is_another_data_set() -> None:
    with pytest.raises(DataError, match=r"data set 'hopper-medium-v0': there is no such file .* give its path"):
        find_d4rl("hopper-medium-v0")


def test_a_path_that_is_not_there_is_named_with_what_is(tmp_path: Path) -> None:
    (tmp_path / "other.hdf5").touch()
    with pytest.raises(DataError, match=r"data set 'mine.hdf5': .*mine.hdf5 is missing; .* holds other.hdf5"):
        find_d4rl(str(tmp_path / "mine.hdf5"))


def test_a_task_without_data_there_says_what_it_has() -> None:
    with pytest.raises(UserError, match=r"task 'pointmaze-large-play' has no data set in source 'd4rl'; it has local:"):
        fetch("pointmaze-large-play")
    with pytest.raises(UserError, match="source: got 'elsewhere', expected d4rl or minari"):
        fetch("hopper-medium", "elsewhere")


# ---------------------------------------------------------------------- Minari's


def _publish(server: Server, folder: Path, dataset_id: str) -> str:
    repository, _, inner = dataset_id.partition("/")
    address = f"/{repository}/resolve/main/{inner}/data"
    for name in ("metadata.json", "main_data.hdf5"):
        server.files[f"{address}/{name}"] = (folder / "data" / name).read_bytes()
    return address


def test_minaris_two_files_become_a_data_set(
    server: Server, tmp_path: Path, minari_set: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "store"))
    _publish(server, minari_set(), "D4RL/pointmaze/large-v2")
    server.cuts, server.cut_after = 1, 50
    folder = fetch_minari("D4RL/pointmaze/large-v2")
    assert folder == tmp_path / "store" / "D4RL/pointmaze/large-v2"
    assert _left(folder.parent) == ["large-v2"]
    assert _left(folder / "data") == ["main_data.hdf5", "metadata.json"]
    assert load_trajectories("minari:D4RL/pointmaze/large-v2", "pointmaze-large-diverse").num_steps == 24
    asked = len(server.asked)
    assert fetch_minari("D4RL/pointmaze/large-v2") == folder
    assert len(server.asked) == asked


def test_minaris_metadata_are_checked_before_the_rest_is_fetched(
    server: Server, tmp_path: Path, minari_set: Any
) -> None:
    spec = json.dumps({"id": "PointMaze_Large-v3", "entry_point": "os:system"})
    address = _publish(server, minari_set(metadata={"env_spec": spec}), "D4RL/pointmaze/large-v2")
    with pytest.raises(DataError, match="os:system"):
        fetch_minari("D4RL/pointmaze/large-v2", tmp_path / "store")
    assert [path for path, _ in server.asked] == [f"{address}/metadata.json"]
    assert _left(tmp_path / "store" / "D4RL/pointmaze") == []


def test_an_id_that_leaves_the_folder_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"'\.\./\.\./evil' is not a Minari id"):
        fetch_minari("../../evil", tmp_path)
