"""What a hostile main_data.hdf5 may hold, beside an honest metadata.json."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import h5py
import numpy as np
import pytest

from dds_lightning.tasks import get_task
from tests.minari_recordings import write_minari_set
from tests.refusals import MAZE, STEPS, maze_episodes, refuse
from tests.spoiling import Spoil, declare, replace


def _virtual(file: h5py.File) -> None:
    del file["episode_1/rewards"]
    layout = h5py.VirtualLayout((STEPS,), "f8")
    layout[:] = h5py.VirtualSource("elsewhere.hdf5", "rewards", shape=(STEPS,))
    file.create_virtual_dataset("episode_1/rewards", layout)


def _hole(file: h5py.File) -> None:
    """Two chunks, of which only the first was ever written."""
    del file["episode_1/rewards"]
    file.create_dataset("episode_1/rewards", (STEPS,), "f8", chunks=(STEPS // 2,))[: STEPS // 2] = 0.0


def _plugin(file: h5py.File) -> None:
    del file["episode_1/rewards"]
    layout = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    layout.set_chunk((STEPS,))
    layout.set_filter(32099, h5py.h5z.FLAG_OPTIONAL)
    space = h5py.h5s.create_simple((STEPS,))
    h5py.h5d.create(file["episode_1"].id, b"rewards", h5py.h5t.NATIVE_DOUBLE, space, layout)


def _group(file: h5py.File) -> None:
    del file["episode_1/rewards"]
    file.create_group("episode_1/rewards")


def _loop(file: h5py.File) -> None:
    del file["episode_1/observations"]
    file["episode_1/observations"] = file["episode_1"]


def _orders(file: h5py.File) -> None:
    del file["episode_1/rewards"]
    file["episode_1"].create_group("\x1b[2J\n" * 300)


OUTSIDE = [("outside.bin", 0, h5py.h5f.UNLIMITED)]
REWARDS = "episode_1/rewards"
FILES: dict[str, tuple[Spoil, str]] = {
    # elsewhere
    "external link": (
        replace(REWARDS, h5py.ExternalLink("else.hdf5", "/x")),
        "episode_1: 'rewards' is a link to elsewhere",
    ),
    "external link to an episode": (
        replace("episode_1", h5py.ExternalLink("else.hdf5", "/x")),
        "'episode_1' is a link",
    ),
    "soft link": (replace("episode_1", h5py.SoftLink("/episode_0")), "'episode_1' is a link to elsewhere"),
    "soft link into nothing": (replace(REWARDS, h5py.SoftLink("/nowhere")), "'rewards' is a link to elsewhere"),
    "link in the observations": (
        replace("episode_1/observations/observation", h5py.SoftLink("/episode_0/observations/observation")),
        "episode_1, observations: 'observation' is a link to elsewhere",
    ),
    "external storage": (
        declare(REWARDS, (STEPS,), "f8", external=OUTSIDE),
        "'rewards' is stored in another file",
    ),
    "virtual dataset": (_virtual, "'rewards' is stored in another file"),
    "observations that hold themselves": (_loop, "got the entries actions, .* expected 'observation'"),
    # types
    "objects": (
        replace(REWARDS, np.array([np.arange(2.0)] * STEPS + [None], object)[:-1], dtype=h5py.vlen_dtype(np.float64)),
        "episode_1, rewards: got values of type object, expected real numbers",
    ),
    "strings": (replace(REWARDS, ["os.system"] * STEPS), "rewards: got values of type object, expected real numbers"),
    "short strings": (replace(REWARDS, np.array([b"0"] * STEPS)), r"rewards: got values of type \|S1"),
    "references": (declare(REWARDS, (STEPS,), h5py.ref_dtype), "rewards: got values of type object"),
    "pickles": (replace(REWARDS, np.array([b"\x80\x04."] * STEPS, "V3")), r"rewards: got values of type \|V3"),
    "records": (replace(REWARDS, np.zeros(STEPS, [("r", "f4"), ("x", "i4")])), "rewards: got values of type"),
    "complex numbers": (replace(REWARDS, np.zeros(STEPS, complex)), "rewards: got values of type"),
    "a type for an array": (replace(REWARDS, np.dtype("f8")), "rewards: got a group, expected an array"),
    "names that a terminal obeys": (_orders, r"episode_1: 'rewards' is missing; found \?\[2J"),
    "a group for an array": (_group, "rewards: got a group, expected an array"),
    "an array for an episode": (replace("episode_1", np.zeros(3)), "episode_1: got an array, expected a group"),
    "an array for observations": (
        replace("episode_1/observations", np.zeros((STEPS + 1, 4))),
        "episode_1, observations: got an array, expected a group",
    ),
    # sizes
    "a size beyond the file": (
        declare(REWARDS, (10**15,), "f8"),
        "rewards: it declares shape .* but its file holds 0 bytes of it",
    ),
    "packed beyond belief": (
        declare("episode_1/actions", (10**12, 2), chunks=(10**6, 2), compression="gzip"),
        "actions: it declares shape .* is not plausible",
    ),
    "never written": (declare(REWARDS, (STEPS,), "f8"), "rewards: it declares shape .* its file holds 0 bytes of it"),
    "a chunk never written": (_hole, "rewards: it declares shape .* in 2 blocks, but its file holds 1 of them"),
    "a filter from a plug-in": (_plugin, "rewards: it is stored with filter 32099, which needs a plug-in"),
    "one number": (replace(REWARDS, 0.0), "rewards: got one value, expected an array"),
    "no numbers": (replace(REWARDS, h5py.Empty("f8")), "rewards: got nothing, expected an array"),
    "no steps": (replace("episode_1/rewards", np.zeros(0)), "promises 40 steps, but .* has 20"),
    "three axes": (
        replace("episode_1/observations/observation", np.zeros((STEPS + 1, 4, 1))),
        r"observations/observation: got shape \(21, 4, 1\), expected \(steps, 4\)",
    ),
    "another task's width": (
        replace("episode_1/observations/observation", np.zeros((STEPS + 1, 27))),
        r"observations/observation: got shape \(21, 27\), expected \(steps, 4\)",
    ),
}


@pytest.mark.parametrize("case", FILES)
def test_arrays_are_not_trusted(case: str, tmp_path: Path, sentinel: Path) -> None:
    spoil, message = FILES[case]
    folder = write_minari_set(tmp_path / "sets", "set-v0", get_task(MAZE), maze_episodes(), spoil=spoil)
    refuse(folder, MAZE, message, sentinel)


def _shared(file: h5py.File) -> None:
    """One array of a few packed bytes is the rewards of every episode."""
    for number in range(2):
        del file[f"episode_{number}/rewards"]
    file.create_dataset("episode_0/rewards", data=np.zeros(5_000_000), compression="gzip")
    file["episode_1/rewards"] = file["episode_0/rewards"]


def _long(file: h5py.File) -> None:
    """Packed rewards that promise the memory of sixty million steps."""
    del file["episode_1/rewards"]
    file.create_dataset("episode_1/rewards", data=np.zeros(60_000_000, np.int8), compression="gzip", chunks=(10**7,))


@pytest.mark.parametrize("spoil", [_shared, _long])
def test_a_small_file_cannot_ask_for_much_memory(spoil: Spoil, tmp_path: Path, sentinel: Path) -> None:
    folder = write_minari_set(
        tmp_path, "set-v0", get_task(MAZE), maze_episodes(), metadata={"total_steps": None}, spoil=spoil
    )
    refuse(folder, MAZE, "the arrays of .* are more than 50 times as large as the file", sentinel)


@pytest.fixture
def flipped(maze_set: Path) -> Iterator[Path]:
    path = maze_set / "data" / "main_data.hdf5"
    with h5py.File(path) as file:
        offset = file["episode_1/actions"].id.get_chunk_info(0).byte_offset
    raw = bytearray(path.read_bytes())
    raw[offset + 3] ^= 0x55
    path.write_bytes(raw)
    return maze_set


def test_a_changed_byte_is_noticed(flipped: Path, sentinel: Path) -> None:
    refuse(flipped, MAZE, "episode_1, actions: .*main_data.hdf5 is damaged there", sentinel)
