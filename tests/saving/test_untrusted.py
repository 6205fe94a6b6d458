"""Files of strangers: opened in one place, within bounds, and without following anything out of their folder."""

import ast
import json
import os
import re
import struct
import zipfile
from pathlib import Path

import pytest
import torch

from dds_lightning.errors import UserError
from dds_lightning.saving.arrays import read_npy, read_npz, read_parquet, read_tensors
from dds_lightning.saving.checkpoint import load_ckpt
from dds_lightning.saving.untrusted import (
    check_plain,
    conform,
    parse_json,
    parse_yaml,
    read_csv,
    read_text,
    refuse_links,
    remove_tree,
    safe_name,
)

ROOT = Path(__file__).parents[2]

# ---------------------------------------------------------------- one place

OPENING = {
    "yaml": {"load", "safe_load", "full_load", "unsafe_load", "load_all", "safe_load_all"},
    "json": {"load", "loads"},
    "np": {"load", "loadtxt", "genfromtxt", "fromfile", "memmap"},
    "pd": {"read_csv", "read_json", "read_parquet", "read_pickle", "read_hdf", "read_feather"},
    "h5py": {"File"},
    "shutil": {"rmtree"},
    "pickle": {"load", "loads"},
    "torch": {"load"},
    "": {"safe_open", "load_file", "rmtree"},
}
"""Module -> what only the readers may call."""
READERS = {"dds_lightning/saving/untrusted.py", "dds_lightning/saving/arrays.py"}
ELSEWHERE = {
    "dds_lightning/saving/checkpoint.py": {"torch.load"},  # the reader of checkpoints
    "dds_lightning/examples/act_with_onnx.py": {"json.loads"},  # runs without this package, on a file of one's own
    "datamodules/behaviours/training/publish.py": {"pd.read_csv"},  # the curve of one's own training
    "datamodules/behaviours/training/learner.py": {"torch.load"},  # the state of one's own interrupted training
    "dds_lightning/grid/engines.py": {"json.loads"},  # the answer of its own worker, through a private pipe
    "dds_lightning/grid/worker.py": {"json.loads"},  # the jobs that come the other way
    "dds_lightning/envs/worker.py": {"pickle.loads"},  # what its own caller sends through a private pipe
}


def calls(path):
    """Names of the calls in a file that open or delete something; reading back one's own dump is none."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if not isinstance(node, ast.Call):
            continue
        module, _, name = ast.unparse(node.func).rpartition(".")
        own = node.args and re.match(r"json\.dumps\(|\w+\.summary\(\)", ast.unparse(node.args[0]))
        if name in OPENING.get(module.split(".")[-1], ()) and not (module == "json" and own):
            yield f"{module}.{name}".lstrip(".")


def test_only_the_readers_open_and_delete():
    found = {}
    for folder in ("dds_lightning", "datamodules"):
        for path in (ROOT / folder).rglob("*.py"):
            name = str(path.relative_to(ROOT))
            if name not in READERS and (other := set(calls(path)) - ELSEWHERE.get(name, set())):
                found[name] = other
    assert found == {}


def test_the_search_sees_what_it_looks_for(tmp_path):
    (tmp_path / "a.py").write_text(
        "yaml.safe_load(t)\nnp.load(p)\njson.load(f)\npd.read_parquet(p)\nh5py.File(p)\nshutil.rmtree(p)\nrmtree(p)\n"
        "safetensors.torch.load_file(p)\njson.loads(json.dumps(x))\n"
    )
    assert len(list(calls(tmp_path / "a.py"))) == 7


# ---------------------------------------------------------------- kinds of files


def test_a_pipe_and_a_device_are_refused_without_waiting(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "pipe", Path("/dev/zero")):
        for reader in (read_text, read_npy, read_npz, read_tensors, load_ckpt, lambda p: read_parquet(p, {})):
            with pytest.raises(UserError, match=f"{path} is a pipe or a device, expected a file"):
                reader(path)


def test_a_link_is_followed_inside_of_the_folder_only(tmp_path):
    (tmp_path / "secret").write_text("1")
    folder = tmp_path / "folder"
    folder.mkdir()
    (folder / "file").write_text("2")
    (folder / "inside").symlink_to("file")
    (folder / "outside").symlink_to("../secret")
    assert read_text(folder / "inside", root=folder) == "2"
    with pytest.raises(UserError, match=r"outside is a link to .*/secret, outside of"):
        read_text(folder / "outside", root=folder)


def test_a_file_that_is_too_large_is_not_read(tmp_path):
    with (tmp_path / "sparse").open("wb") as file:
        file.truncate(2**40)
    with pytest.raises(UserError, match=r"sparse has 1,099,511,627,776 bytes, expected at most 1,048,576"):
        read_text(tmp_path / "sparse")


# ---------------------------------------------------------------- text

LAUGHS = "a0: &a0 [x, x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]\n" for i in range(1, 12)
)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (LAUGHS, "more than 100,000 values once its aliases are followed"),
        ("a: &a [*a]", "refers to itself"),
        ("[" * 100_000, "nested deeper than 40 levels"),
        ("{a: " * 1000 + "1" + "}" * 1000, "nested deeper than 40 levels"),
        ("- 1\n" * 150_000, "more than 100,000 values"),
        ("!!python/object/apply:os.mkdir [ran]", "cannot be read"),
        ("[1, 2]: 3", "cannot be read"),
        ("? 2020-01-01\n: 3", "has a date where a name was expected"),
        ("a: 2020-99-99", "cannot be read"),
        ("\x00", "cannot be read"),
        ("9" * 5000, "cannot be read"),
    ],
)
def test_yaml_beyond_bounds_is_one_sentence(text, message):
    with pytest.raises(UserError, match=message) as told:
        parse_yaml(text, "x.yaml")
    assert "\n" not in str(told.value)
    assert len(str(told.value)) < 400
    assert not Path("ran").exists()


def test_yaml_within_bounds_is_read_with_its_aliases():
    assert parse_yaml("a: &a {x: 1}\nb: *a\nc: [1, .inf, null]", "x.yaml")["b"] == {"x": 1}


@pytest.mark.parametrize("text", ["[" * 100_000, '{"a":' * 50 + "1" + "}" * 50, "9" * 5000, "{", "\ud800"])
def test_json_beyond_bounds_is_one_sentence(text):
    with pytest.raises(UserError, match=r"x\.json (cannot be read|is nested deeper)"):
        parse_json(text, "x.json")


def test_values_that_share_memory_count_as_often_as_they_appear():
    value = [0] * 10
    for _ in range(6):
        value = [value] * 10
    with pytest.raises(UserError, match="more than 100,000 values"):
        check_plain(value, "x")


def test_a_form_names_the_first_entry_that_does_not_fit():
    form = {"mean": (int, float), "name": (str,), "inner": {"low": (int, type(None))}}
    value = {"mean": 1, "name": "a<b>\x1b[2J", "inner": {}}
    assert conform(value, form, "x") == {"mean": 1, "name": "ab2J", "inner": {"low": None}}
    for wrong in ({"mean": True}, {"mean": float("nan")}, {"name": 1}, {"inner": []}, {"inner": {"low": "a"}}):
        with pytest.raises(UserError, match=r"^x"):
            conform({**value, **wrong}, form, "x")


def test_names_keep_letters_and_lose_markup():
    assert safe_name("AWR policy, sampled (best val/loss: 1.5 %)") == "AWR policy, sampled (best val/loss: 1.5 %)"
    assert safe_name("Grüße") == "Grüße"
    assert (
        safe_name("<img src=x onerror=alert(1)>\x1b]0;x\x07![a](http://b)`|*")
        == "img src=x onerror=alert(1)0;xa(http://b)"
    )


@pytest.mark.parametrize(
    "text", ["", "a,b\n1,<script>\n", "a,a\n1,2\n", "b\n1\n", 'a\n"unclosed\n', ",".join("x" * 5000)]
)
def test_a_table_of_text_must_hold_numbers(tmp_path, text):
    (tmp_path / "t.csv").write_text(text)
    with pytest.raises(UserError, match=r"t\.csv"):
        read_csv(tmp_path / "t.csv", {"a": "iuf"})


# ---------------------------------------------------------------- arrays


def npz(path, name, data):
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(name, data)
    return path


def npy(shape, body=b"", dtype="<f8"):
    header = repr({"descr": dtype, "fortran_order": False, "shape": shape}).ljust(117) + "\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header.encode() + body


@pytest.mark.parametrize(
    "content",
    [npy((10**12,)), npy((10**6, 10**6), b"x" * 8), npy((1,), b"x" * 8, "|O"), npy((-1,)), b"\x93NUMPY", b"", b"{}"],
)
def test_arrays_that_are_not_what_they_declare_are_refused(tmp_path, content):
    (tmp_path / "a.npy").write_bytes(content)
    with pytest.raises(UserError, match=r"a\.npy"):
        read_npy(tmp_path / "a.npy")
    with pytest.raises(UserError, match=r"a\.npz"):
        read_npz(npz(tmp_path / "a.npz", "a.npy", content))


def test_an_archive_that_unpacks_to_more_than_is_bearable_is_refused(tmp_path):
    path = npz(tmp_path / "bomb.npz", "a.npy", npy((10**8,), bytes(8 * 10**8)))
    assert path.stat().st_size < 10**6
    with pytest.raises(UserError, match="unpacks to more than"):
        read_npz(path)


def test_a_header_of_many_empty_tensors_is_refused(tmp_path):
    entries = {f"t{i}": {"dtype": "F32", "shape": [0], "data_offsets": [0, 0]} for i in range(20_000)}
    for count, message in ((20_000, "declares a header of"), (5000, "declares 5,000 tensors")):
        header = json.dumps(dict(list(entries.items())[:count])).encode()
        (tmp_path / "w").write_bytes(struct.pack("<Q", len(header)) + header)
        with pytest.raises(UserError, match=message):
            read_tensors(tmp_path / "w")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"hyper_parameters": [1]}, "'hyper_parameters' is a list"),
        ({"callbacks": 3}, "'callbacks' is a int"),
        ({"global_step": "many"}, "'global_step' is a str"),
        ({"state_dict": {"w": 1}}, "'w' in state_dict is a int"),
        ({"state_dict": {"w": torch.zeros(1).expand(10**9)}}, "declares 4,000,000,000 bytes of tensors"),
        ({"dds_format": 99}, "has format 99"),
    ],
)
def test_a_checkpoint_with_impossible_entries_is_refused(tmp_path, change, message):
    torch.save({"state_dict": {"w": torch.zeros(2)}, **change}, tmp_path / "a.ckpt")
    with pytest.raises(UserError, match=message):
        load_ckpt(tmp_path / "a.ckpt")


def test_a_checkpoint_of_shared_lists_is_refused(tmp_path):
    value = ["x"] * 10
    for _ in range(9):
        value = [value] * 10
    torch.save({"state_dict": {}, "hyper_parameters": {"lr": value}}, tmp_path / "a.ckpt")
    with pytest.raises(UserError, match="once its aliases are followed"):
        load_ckpt(tmp_path / "a.ckpt")


def test_memory_that_a_pickle_asks_for_is_not_given(tmp_path):
    """torch's own list of harmless callables has one that makes any number of zeros."""

    class Zeros:
        def __reduce__(self):
            return bytearray, (10**12,)

    torch.save({"state_dict": {}, "more": Zeros()}, tmp_path / "a.ckpt")
    with pytest.raises(UserError, match="it asks for __builtin__ bytearray"):
        load_ckpt(tmp_path / "a.ckpt")


# ---------------------------------------------------------------- deleting


def test_a_tree_is_deleted_only_where_it_really_lies(tmp_path):
    (tmp_path / "precious" / "a").mkdir(parents=True)
    root = tmp_path / "root"
    (root / "mine").mkdir(parents=True)
    (root / "link").symlink_to(tmp_path / "precious")
    (root / "mine" / "inner").symlink_to(tmp_path / "precious")
    for path in (root / "link", root / "link" / "a", root / ".." / "precious"):
        with pytest.raises((UserError, ValueError)):
            remove_tree(path, root)
    with pytest.raises(UserError, match=r"inner is a link"):
        refuse_links(root / "mine")
    remove_tree(root / "mine", root)
    remove_tree(root / "missing", root)
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["a", "link", "precious", "root"]
