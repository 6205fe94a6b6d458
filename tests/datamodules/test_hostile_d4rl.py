"""Corrupt, foreign and hostile files in D4RL's layout: each is refused in one sentence, and nothing of it is run."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from datamodules import load_trajectories
from datamodules.trajectories import DataError
from dds_lightning.tasks import get_task
from tests.recordings import Episode, d4rl_rows, record, write_d4rl_file
from tests.spoiling import Spoil, declare, replace

HOPPER = "hopper-medium"


@cache
def _recorded(name: str) -> list[Episode]:
    return record(get_task(name), 60, episode_steps=20)


def _rows(name: str = HOPPER) -> dict[str, Any]:
    return d4rl_rows(get_task(name), _recorded(name))


def _put(key: str, index: Any, value: Any) -> Spoil:
    def spoil(file: h5py.File) -> None:
        file[key][index] = value

    return spoil


def _group(file: h5py.File) -> None:
    del file["observations"]
    file["observations/observation"] = np.zeros((60, 11))


def _virtual(file: h5py.File) -> None:
    layout = h5py.VirtualLayout(shape=(60, 11), dtype="f4")
    layout[:] = h5py.VirtualSource("elsewhere.hdf5", "observations", shape=(60, 11))
    del file["observations"]
    file.create_virtual_dataset("observations", layout)


def _external(file: h5py.File) -> None:
    del file["rewards"]
    file.create_dataset("rewards", shape=(60,), dtype="f4", external=[("/etc/hostname", 0, h5py.h5f.UNLIMITED)])


def _plugin(file: h5py.File) -> None:
    """Blosc, without having it: the filter's name is all that the file needs to say."""
    del file["actions"]
    layout = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    layout.set_chunk((60, 3))
    layout.set_filter(32001, h5py.h5z.FLAG_OPTIONAL, ())
    space = h5py.h5s.create_simple((60, 3))
    h5py.h5d.create(file.id, b"actions", h5py.h5t.IEEE_F32LE, space, layout)


def _references(file: h5py.File) -> None:
    kind = h5py.special_dtype(ref=h5py.Reference)
    del file["actions"]
    array = file.create_dataset("actions", (60, 3), dtype=kind)
    array[0, 0] = file["rewards"].ref


def _hole(file: h5py.File) -> None:
    """Two of three blocks are written, HDF5 would make up zeros for the third."""
    array = file["observations"][:]
    del file["observations"]
    made = file.create_dataset("observations", shape=(60, 11), dtype="f4", chunks=(20, 11))
    made[:40] = array[:40]


def _bomb(file: h5py.File) -> None:
    """A hundred million bytes of zeros in a hundred thousand."""
    zeros = np.zeros((2_300_000, 11), np.float32)
    for key in ("observations", "actions", "rewards", "terminals", "timeouts"):
        del file[key]
    file.create_dataset("observations", data=zeros, compression="gzip", chunks=(100_000, 11))
    file["actions"], file["rewards"] = np.zeros((2_300_000, 3), np.float32), zeros[:, 0]
    file["terminals"], file["timeouts"] = zeros[:, 0], zeros[:, 0]


def _large_block(file: h5py.File) -> None:
    """A few rows, in a block that would fill the memory when it is unpacked."""
    array = file["observations"][:]
    del file["observations"]
    file.create_dataset(
        "observations", data=array, maxshape=(None, 11), chunks=(2_000_000, 11), compression="gzip", dtype="f4"
    )


def _minari(file: h5py.File) -> None:
    for key in list(file):
        del file[key]
    file["episode_0/observations"] = np.zeros((5, 11))


def _no_ends(file: h5py.File) -> None:
    file["terminals"][:], file["timeouts"][:] = False, False


SPOILT: dict[str, tuple[Spoil, str]] = {
    "no rewards": (lambda f: f.pop("rewards"), "'rewards' is missing; found actions, infos, observations"),
    "no observations": (lambda f: f.pop("observations"), "'observations' is missing; found actions"),
    "empty": (lambda f: [f.pop(key) for key in list(f)], "'observations' is missing; found nothing"),
    "Minari's layout": (_minari, "it has the layout of Minari's files, one group per episode; read it with local:DIR"),
    "a group for an array": (_group, "observations: got a group, expected an array"),
    "flat observations": (replace("observations", np.zeros(660)), r"observations: got shape \(660,\), expected"),
    "two-dimensional rewards": (
        replace("rewards", np.zeros((60, 2))),
        r"rewards: got shape \(60, 2\), expected \(rows,\)",
    ),
    "one number for an array": (replace("rewards", 1.0), "rewards: got one value, expected an array"),
    "nothing for an array": (replace("rewards", h5py.Empty("f4")), "rewards: got nothing, expected an array"),
    "no rows": (
        lambda f: [replace(k, f[k][:0])(f) for k in list(f) if k != "infos"],
        "rewards: got 0 rows, expected",
    ),
    "an action too few": (replace("actions", np.zeros((59, 3))), "actions: got 59 rows, but rewards has 60"),
    "a flag too few": (replace("timeouts", np.zeros(59, bool)), "timeouts: got 59 rows, but rewards has 60"),
    "another task's widths": (
        replace("observations", np.zeros((60, 17))),
        r"observations: got shape \(60, 17\), expected \(rows, 11\) as task 'hopper-medium' has it; "
        "choose a task that fits the data",
    ),
    "next observations of another width": (
        lambda f: f.create_dataset("next_observations", data=np.zeros((60, 10))),
        r"next_observations: got shape \(60, 10\), expected \(rows, 11\)",
    ),
    "next observations of other rows": (
        lambda f: f.create_dataset("next_observations", data=f["observations"][:]),
        "next_observations: .* of 60 rows differ from the next row's observations",
    ),
    "not a number": (
        _put("observations", (7, 3), np.nan),
        "observations: got nan at row 7, column 3, expected finite",
    ),
    "infinite reward": (_put("rewards", 9, np.inf), "rewards: got inf at row 9, expected finite"),
    "too large for 32 bits": (replace("rewards", np.full(60, 1e300)), r"rewards: got 1e\+300 at row 0"),
    "outside the box": (
        _put("actions", (11, 2), 1.5),
        "actions: got 1.5 at row 11, column 2, expected -1 to 1",
    ),
    "odd flags": (replace("terminals", np.full(60, 0.5)), "terminals: got 0.5 at row 0, expected 0 or 1"),
    "flags that are no numbers": (
        replace("terminals", np.full(60, np.nan)),
        "terminals: got nan at row 0, expected 0 or 1",
    ),
    "text": (replace("rewards", np.array([b"x"] * 60)), "rewards: got values of type .S1, expected real numbers"),
    "objects": (
        replace("observations", np.array(["os.system('true')"] * 60, object), dtype=h5py.string_dtype()),
        "observations: got values of type object, expected real numbers",
    ),
    "ragged": (
        declare("actions", (60,), h5py.vlen_dtype(np.float32)),
        "actions: got values of type object, expected real numbers",
    ),
    "compound": (
        replace("rewards", np.zeros(60, [("a", "f4"), ("b", "i4")])),
        r"rewards: got values of type \[\('a'.*expected real numbers",
    ),
    "opaque": (replace("rewards", np.zeros(60, "V8")), "rewards: got values of type .V8, expected real numbers"),
    "complex": (replace("rewards", np.zeros(60, complex)), "rewards: got values of type complex128, expected"),
    "arrays in arrays": (declare("rewards", (60,), np.dtype("(2,)f4")), "rewards: got values of type .*expected"),
    "references": (_references, "actions: got values of type object, expected real numbers"),
    "a soft link": (replace("rewards", h5py.SoftLink("/infos/qpos")), "'rewards' is a link to elsewhere"),
    "a link to another file": (
        replace("rewards", h5py.ExternalLink("elsewhere.hdf5", "/rewards")),
        "'rewards' is a link to elsewhere",
    ),
    "a link to itself": (replace("rewards", h5py.SoftLink("/rewards")), "'rewards' is a link to elsewhere"),
    "bytes of another file": (_external, "'rewards' is stored in another file"),
    "a virtual array": (_virtual, "'observations' is stored in another file"),
    "a plug-in": (_plugin, "actions: it is stored with filter 32001, which needs a plug-in, and plug-ins are foreign"),
    "more than the file holds": (
        declare("observations", (10**13, 11), chunks=(10**6, 11)),
        r"observations: it declares shape \(10000000000000, 11\), 440 TB, but its file holds 0 bytes of it",
    ),
    "declared, not written": (
        declare("observations", (60, 11)),
        r"observations: it declares shape \(60, 11\), 2.64 kB, but its file holds 0 bytes of it",
    ),
    "declared in blocks, not written": (
        declare("observations", (60, 11), chunks=(20, 11)),
        "observations: it declares shape .* in 3 blocks, but its file holds 0 of them",
    ),
    "a hole": (_hole, "observations: it declares shape .* in 3 blocks, but its file holds 2 of them"),
    "a bomb": (_bomb, "observations: it declares shape .*, 101 MB, but its file holds .* kB of it; more than 50 times"),
    "a block too large": (_large_block, "observations: it declares shape .* more than 50 times smaller"),
    "no ends": (_no_ends, "terminals: none of the 60 rows is marked as an episode's last, .* no complete episode"),
    "nothing but ends": (
        lambda f: (_put("timeouts", slice(None), True)(f), _put("terminals", slice(None), False)(f)),
        "observations: no row leads to another one, so it has no complete episode",
    ),
}


@pytest.mark.parametrize("case", SPOILT)
def test_a_spoilt_file_is_refused_naming_file_and_field(case: str, tmp_path: Path) -> None:
    path = write_d4rl_file(tmp_path / "spoilt.hdf5", get_task(HOPPER), _recorded(HOPPER))
    spoil, message = SPOILT[case]
    with h5py.File(path, "r+") as file:
        spoil(file)
    with pytest.raises(DataError, match=r"^data set 'spoilt.hdf5'.*" + message) as refusal:
        load_trajectories(f"d4rl:{path}", HOPPER)
    assert "\n" not in str(refusal.value)


def test_zeros_that_compress_well_are_honest_data(tmp_path: Path) -> None:
    rows = {**_rows(), "rewards": np.zeros(60)}
    long = {key: np.concatenate([array] * 2000) for key, array in rows.items()}
    with h5py.File(tmp_path / "zeros.hdf5", "w") as file:
        for key, array in long.items():
            file.create_dataset(key, data=array, compression="gzip")
    assert load_trajectories(f"d4rl:{tmp_path / 'zeros.hdf5'}", HOPPER).num_steps > 100_000


# ---------------------------------------------------------------------- bytes


@pytest.mark.parametrize("keep", [0, 7, 100, 0.5, 0.99])
def test_a_truncated_file_is_refused(keep: float, tmp_path: Path) -> None:
    path = write_d4rl_file(tmp_path / "cut.hdf5", get_task(HOPPER), _recorded(HOPPER))
    whole = path.read_bytes()
    path.write_bytes(whole[: int(keep if keep > 1 else keep * len(whole))])
    with pytest.raises(DataError, match=r"data set 'cut.hdf5': .*cut.hdf5 is truncated or damaged"):
        load_trajectories(f"d4rl:{path}", HOPPER)


@pytest.mark.parametrize("content", [b"<html>login</html>", b"\x80\x04\x95pickle" * 50, b"PK\x03\x04" + bytes(500)])
def test_what_is_no_hdf5_is_refused(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "page.hdf5"
    path.write_bytes(content)
    with pytest.raises(DataError, match=r"page.hdf5 is truncated or damaged, or not an HDF5 file at all"):
        load_trajectories(f"d4rl:{path}", HOPPER)


def test_a_name_that_is_no_text_is_told(tmp_path: Path) -> None:
    path = write_d4rl_file(tmp_path / "bytes.hdf5", get_task(HOPPER), _recorded(HOPPER))
    with h5py.File(path, "r+") as file:
        file.move("rewards", b"rew\xffrds")
    with pytest.raises(DataError, match=r"'rewards' is missing; found .*rew.xffrds"):
        load_trajectories(f"d4rl:{path}", HOPPER)


def test_a_folder_is_no_file(tmp_path: Path) -> None:
    (tmp_path / "folder.hdf5").mkdir()
    with pytest.raises(DataError, match=r"folder.hdf5 is a folder"):
        load_trajectories(f"d4rl:{tmp_path / 'folder.hdf5'}", HOPPER)


def test_random_changes_of_bytes_load_or_are_refused_in_a_sentence(tmp_path: Path) -> None:
    path = write_d4rl_file(tmp_path / "flipped.hdf5", get_task(HOPPER), _recorded(HOPPER))
    whole, rng, refused = path.read_bytes(), np.random.default_rng(0), []
    for _ in range(150):
        changed = bytearray(whole)
        for place in rng.integers(0, len(whole), 4):
            changed[place] = rng.integers(256)
        path.write_bytes(changed)
        try:
            load_trajectories(f"d4rl:{path}", HOPPER)
        except DataError as error:
            refused.append(str(error))
    assert len(refused) > 10
    assert all("flipped.hdf5" in message for message in refused)


# ---------------------------------------------------------------------- other tasks

OTHERS = {
    "another maze": ("antmaze-large-play", "antmaze-umaze", "of the positions lie outside the corridors of task"),
    "another physics": ("antmaze-umaze@robotics", "antmaze-umaze", "of other physics with other coordinates"),
    "another body of the same widths": ("halfcheetah-medium", "walker2d-medium", "median height is .* another body"),
    "the other way round": ("walker2d-medium", "halfcheetah-medium", "median height is .* another body"),
    "other subtasks": ("kitchen-mixed", "kitchen-partial", "column 41, but the goal of task 'kitchen-partial'"),
    "other widths": ("kitchen-mixed", "antmaze-umaze", r"got shape \(60, 60\), expected \(rows, 29\) as task"),
}


@pytest.mark.parametrize("case", OTHERS)
def test_a_file_of_another_task_is_refused(case: str, tmp_path: Path) -> None:
    recorded, wanted, message = OTHERS[case]
    path = write_d4rl_file(tmp_path / "other.hdf5", get_task(recorded), _recorded(recorded))
    if case == "another maze":  # an ant that gets around
        with h5py.File(path, "r+") as file:
            file["observations"][:, :2] = np.linspace([0, 0], [0, 8], 60)
    with pytest.raises(DataError, match=r"^data set 'other.hdf5', observations: .*" + message):
        load_trajectories(f"d4rl:{path}", wanted)
    if case != "another maze":
        assert load_trajectories(f"d4rl:{path}", recorded).num_steps > 50
