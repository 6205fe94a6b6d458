"""Seeded mutations of every kind of file that is read: of its bytes, and of what it says.

Blind changes of bytes hardly get past a checksum or a parser. So most mutations take a file apart, change one thing
that it says (a value, a name, a type, a shape, a link) and put it together again.
"""

import copy
import io
import json
import os
import pickle
import random
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pandas as pd
import torch
import yaml

SECRET = "../precious/secret"
"""What hostile names point to, from the folder of a case."""
TEXTS = ["", "\x00", "\x1b[2J\x1b]0;owned\x07", "<script>alert(1)</script>", "[/b]", "../" * 8 + "etc/passwd", SECRET]
TEXTS += ["/dev/zero", "a" * 20_000, "os:system", "payload_of_a_stranger:Env", "hf:a/b", "nan", "\u202e", "%s{0}", "-1"]
ODD: list[Any] = [None, True, False, 0, 1, -1, 2**31, -(2**63), 2**64, 10**400, 0.5, -0.0, 1e308, -1e308]
ODD += [float("nan"), float("inf"), float("-inf"), [], {}, [[]], [None], {"a": {"b": [1]}}, [0] * 20_000, *TEXTS]

Mutation = Callable[[bytes, random.Random], bytes]


def of_bytes(data: bytes, rng: random.Random) -> bytes:
    """Change, cut, repeat or insert some bytes."""
    place, size = rng.randrange(len(data) or 1), rng.choice([1, 1, 2, 8, 64, 4096])
    part = data[place : place + size]
    return rng.choice(
        [
            lambda: data[:place] + bytes(byte ^ (1 << rng.randrange(8)) for byte in part) + data[place + size :],
            lambda: data[:place],
            lambda: data[:place] + part * rng.choice([2, 100]) + data[place + size :],
            lambda: data[:place] + rng.randbytes(size) + data[place:],
            lambda: data[:place] + rng.choice([b"\x00", b"\xff"]) * size + data[place + size :],
            lambda: data[:place] + struct.pack("<q", rng.choice([0, -1, 2**31, 2**62])) + data[place + 8 :],
        ]
    )()


def of_value(value: Any, rng: random.Random) -> Any:
    """Change one place in plain values: another value, no value, a copy under another name, or one more level."""
    value = copy.deepcopy(value)
    place, key = value, None
    while isinstance(place, (dict, list)) and place:
        keys = list(place) if isinstance(place, dict) else list(range(len(place)))
        parent, key = place, rng.choice(keys)
        place = parent[key]
        if not isinstance(place, (dict, list)) or rng.random() < 0.3:
            break
    if key is None:
        return rng.choice(ODD)
    kind = rng.random()
    if kind < 0.6:
        parent[key] = rng.choice(ODD)
    elif kind < 0.7:
        del parent[key]
    elif kind < 0.8:
        parent[key] = [place] if rng.random() < 0.5 else {"a": place}
    elif kind < 0.9 and isinstance(parent, dict):
        parent[rng.choice(TEXTS)] = parent.pop(key)
    elif isinstance(place, (int, float)) and not isinstance(place, bool):
        parent[key] = place * rng.choice([-1, 0, 2, 10**3, 10**9]) + rng.choice([0, 1, 0.5])
    else:
        parent[key] = str(place) if rng.random() < 0.5 else rng.choice(ODD)
    return value


def of_json(data: bytes, rng: random.Random) -> bytes:
    """Change what a JSON file says, or how."""
    kind = rng.random()
    if kind < 0.15:
        return of_bytes(data, rng)
    if kind < 0.25:
        depth = rng.choice([30, 1000, 100_000])
        return rng.choice([b"[" * depth, b'{"a":' * depth + b"1" + b"}" * depth, b"9" * depth, b"[1," * depth])
    return json.dumps(of_value(json.loads(data), rng)).encode("utf-8", "surrogatepass")


def of_yaml(data: bytes, rng: random.Random) -> bytes:
    """Change what a YAML file says, or use what YAML offers to hide it."""
    kind = rng.random()
    if kind < 0.15:
        return of_bytes(data, rng)
    value = yaml.safe_load(data)
    if kind < 0.4:
        key = rng.choice(list(value)) if isinstance(value, dict) and value else "a"
        count = rng.choice([2, 5, 11, 40])
        laughs = "a0: &a0 [x, x, x, x, x, x, x, x, x, x]\n"
        laughs += "".join(f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]\n" for i in range(1, count))
        hidden = rng.choice(
            [
                f"{laughs}{key}: *a{count - 1}\n",
                f"{key}: &x [*x]\n",
                f"{key}: !!python/object/apply:os.mkdir [ran]\n",
                f"{key}: !!binary {'A' * 4000}\n",
                f"{key}: {'[' * 500}\n",
                f"? [1, 2]\n: 3\n{key}: 1\n",
                f"{key}: 2001-99-99\n",
                f"<<: {{{key}: 1}}\n",
                f"--- 1\n--- {key}\n",
                f"{key}: {'9' * 5000}\n",
            ]
        )
        if isinstance(value, dict):
            value.pop(key, None)
        return (yaml.safe_dump(value) + hidden).encode()
    return yaml.safe_dump(of_value(value, rng), allow_unicode=True).encode("utf-8", "replace")


def of_safetensors(data: bytes, rng: random.Random) -> bytes:
    """Change the header, the numbers, or both so that they fit."""
    kind = rng.random()
    if kind < 0.15:
        return of_bytes(data, rng)
    (size,) = struct.unpack("<Q", data[:8])
    header, body = json.loads(data[8 : 8 + size]), data[8 + size :]
    names = [name for name in header if name != "__metadata__"]
    one, other = rng.choice(names), rng.choice(names)
    if kind < 0.35:
        header = of_value(header, rng)
    elif kind < 0.45:
        header[one], header[other] = header[other], header[one]
    elif kind < 0.55:
        header[rng.choice([*TEXTS, "skill.more", other])] = header.pop(one)
    elif kind < 0.65:
        header[one]["dtype"] = rng.choice(["F64", "F16", "BF16", "I64", "U8", "BOOL", "C64", "X"])
    elif kind < 0.7:
        count = rng.choice([100, 5000, 50_000])
        header |= {f"t{i}": {"dtype": "F32", "shape": [0], "data_offsets": [0, 0]} for i in range(count)}
    elif kind < 0.8:
        header[one]["shape"] = [*header[one]["shape"], 1] if rng.random() < 0.5 else header[one]["shape"][::-1]
    elif "__metadata__" in header and kind < 0.87:
        about = header["__metadata__"]
        key = rng.choice(list(about))
        about[key] = of_json(about[key].encode(), rng).decode("utf-8", "replace") if about[key][:1] == "{" else "odd"
    else:
        first, last = header[one]["data_offsets"]
        filler = struct.pack("<f", rng.choice([float("nan"), float("inf"), float("-inf"), -0.0, -1.0, 1e30]))
        body = body[:first] + (filler * (last - first))[: last - first] + body[last:]
    text = json.dumps(header).encode("utf-8", "replace")
    return struct.pack("<Q", len(text)) + text + body


class _Payload:
    def __init__(self, call: Any, *arguments: Any) -> None:
        self.call, self.arguments = call, arguments

    def __reduce__(self) -> tuple[Any, tuple[Any, ...]]:
        return self.call, self.arguments


def of_checkpoint(data: bytes, rng: random.Random) -> bytes:
    """Change plain values, tensors, parts of the archive, or the pickle in it."""
    kind = rng.random()
    if kind < 0.15:
        return of_bytes(data, rng)
    content = torch.load(io.BytesIO(data), weights_only=True)
    if kind < 0.25:
        return _rezipped(data, rng)
    if kind < 0.4:
        payload = rng.choice([(os.mkdir, "ran"), (os.remove, SECRET), (bytearray, 10**11), (eval, "open('ran', 'w')")])
        content[rng.choice([*content, "more"])] = _Payload(*payload)
        if kind < 0.28:
            return pickle.dumps(content)
    elif kind < 0.6:
        name = rng.choice(list(content["state_dict"]))
        value = content["state_dict"][name]
        content["state_dict"][name] = rng.choice(
            [
                lambda: value * float("nan"),
                lambda: value.double(),
                lambda: value[None],
                lambda: torch.zeros(1).expand(10**9),
                lambda: value.flatten()[:0],
                lambda: value.to_sparse() if value.ndim else value,
                lambda: rng.choice(ODD),
                lambda: torch.zeros(value.shape, device="meta"),
                lambda: value.to(torch.complex64),
            ]
        )()
    else:
        content = {**content, **of_value({k: v for k, v in content.items() if k != "state_dict"}, rng)}
    file = io.BytesIO()
    torch.save(content, file)
    return file.getvalue()


def _rezipped(data: bytes, rng: random.Random) -> bytes:
    """The same archive with another member, name, content or packing."""
    file, kind = io.BytesIO(), rng.randrange(5)
    with zipfile.ZipFile(io.BytesIO(data)) as old, zipfile.ZipFile(file, "w") as new:
        chosen = rng.choice(old.namelist())
        for name in old.namelist():
            content = old.read(name)
            if name == chosen:
                if kind == 0:
                    continue
                content = of_bytes(content, rng) if kind == 1 else content
                name = rng.choice(["../../outside", "/outside", name.upper()]) if kind == 2 else name
            new.writestr(name, content, zipfile.ZIP_DEFLATED if kind == 3 else zipfile.ZIP_STORED)
        if kind == 4:
            new.writestr(rng.choice(["bomb", chosen]), bytes(3 * 10**8), zipfile.ZIP_DEFLATED)
    return file.getvalue()


def of_array(array: Any, rng: random.Random) -> Any:
    """Another shape, type, order or value of an array."""
    array = np.array(array)
    flat = array.reshape(-1)
    changes = [
        lambda: array[:0],
        lambda: array[:-1] if array.ndim else array[None],
        lambda: array[None],
        lambda: flat,
        lambda: np.concatenate([array, array]) if array.ndim else array,
        lambda: array.astype(rng.choice(["f8", "f2", "i8", "u1", "c8", "S4", "U4", "?"])),
        lambda: array.T,
        lambda: np.zeros((), array.dtype),
        lambda: np.zeros((3, 3, 3)),
    ]
    if array.dtype.kind in "fiu" and array.size:

        def spoilt() -> Any:
            values = [0, 1, -1, 10**6] + ([np.nan, np.inf, -np.inf, 1e38] if array.dtype.kind == "f" else [2**31 - 1])
            with np.errstate(all="ignore"):
                where = slice(None) if rng.random() < 0.3 else rng.randrange(flat.size)
                changed = flat.copy()
                changed[where] = np.array(rng.choice(values)).astype(array.dtype)
            return changed.reshape(array.shape)

        changes += [spoilt] * 6
    elif array.dtype.kind == "b" and array.size:
        changes += [lambda: ~array, lambda: (rng.randrange(2, 255) * np.ones(array.shape, np.uint8)).view(np.bool_)] * 2
    return rng.choice(changes)()


def of_npy(data: bytes, rng: random.Random) -> bytes:
    """Change an array, or the header that declares it."""
    kind = rng.random()
    if kind < 0.2:
        return of_bytes(data, rng)
    if kind < 0.4:
        end = data.index(b"\n")
        shape = rng.choice(["(10000000000,)", "(-1,)", "(1, 0)", "()", "(99999999999999999999,)", "('a',)"])
        dtype = rng.choice(["<f4", "|O", "<f8", "[('a', '<f4')]", "V8", "|S9", "<M8[s]"])
        dtype = dtype if dtype.startswith("[") else f"'{dtype}'"
        text = f"{{'descr': {dtype}, 'fortran_order': False, 'shape': {shape}, }}".ljust(end - 10)
        return data[:8] + struct.pack("<H", len(text) + 1) + text.encode() + data[end:]
    file = io.BytesIO()
    np.save(file, of_array(np.load(io.BytesIO(data)), rng), allow_pickle=False)
    return file.getvalue()


def of_npz(data: bytes, rng: random.Random) -> bytes:
    """Change an array of an archive, its name, or the archive."""
    kind = rng.random()
    if kind < 0.15:
        return of_bytes(data, rng)
    if kind < 0.35:
        return _rezipped(data, rng)
    with np.load(io.BytesIO(data)) as stored:
        arrays = {**stored}
    name = rng.choice(list(arrays))
    if kind < 0.45:
        arrays[rng.choice(["more", "x" * 300])] = arrays.pop(name)
    elif kind < 0.5:
        del arrays[name]
    else:
        arrays[name] = of_array(arrays[name], rng)
    file = io.BytesIO()
    np.savez(file, **arrays)
    return file.getvalue()


def of_parquet(data: bytes, rng: random.Random) -> bytes:
    """Change a column, its name or type, the rows, or the metadata."""
    kind = rng.random()
    if kind < 0.25:
        return of_bytes(data, rng)
    table = pd.read_parquet(io.BytesIO(data))
    attrs, column = dict(table.attrs), rng.choice(list(table.columns))
    if kind < 0.35:
        table = table.drop(columns=column)
    elif kind < 0.45:
        table = table.rename(columns={column: rng.choice(["more", "a" * 300])})
    elif kind < 0.55:
        table = rng.choice([table.iloc[:0], pd.concat([table, table]), table.iloc[::-1], table.iloc[:1]])
    elif kind < 0.65:
        attrs = {"task": rng.choice([value for value in ODD if value != 10**400 and value == value])}
    else:
        values = [None, 0, -1, 2**31, 1e300, float("nan"), float("inf"), True, [1], [2**40], [-1], ["a"]]
        value = rng.choice([*values, *(text for text in TEXTS if "\x00" not in text)])
        rows = len(table) if rng.random() < 0.6 or not len(table) else 1
        column_values = [value] * rows + list(table[column])[rows:]
        table[column] = pd.Series(column_values, dtype=object if isinstance(value, (list, str)) else None).to_numpy()
    table.attrs = attrs
    file = io.BytesIO()
    try:
        table.to_parquet(file, index=False)
    except Exception:  # pandas refuses to write it: bytes instead
        return of_bytes(data, rng)
    return file.getvalue()


def of_hdf5(data: bytes, rng: random.Random) -> bytes:
    """Change an array of a file, its type, its storage, or put a link in its place."""
    kind = rng.random()
    if kind < 0.3:
        return of_bytes(data, rng)
    file = io.BytesIO(data)
    with h5py.File(file, "r+") as opened:
        found: list[str] = []
        opened.visititems(lambda name, node: found.append(name) if isinstance(node, h5py.Dataset) else None)
        name = rng.choice(found)
        array = np.array(opened[name])
        del opened[name]
        if kind < 0.4:
            links = [h5py.SoftLink(place) for place in ("/nowhere", "/", f"/{name}")]
            opened[name] = rng.choice([*links, h5py.ExternalLink(SECRET, "/")])
        elif kind < 0.45:
            opened.create_group(name)
        elif kind < 0.55:
            shape = (rng.choice([0, 10**6, 10**12]), *array.shape[1:])
            opened.create_dataset(name, shape=shape, chunks=(1, *shape[1:]), dtype=array.dtype)
        elif kind < 0.6:
            opened[rng.choice(["more", "a/b"])] = array
        elif kind < 0.65:
            opened.create_dataset(name, data=np.array([b"text"] * 3, dtype=object), dtype=h5py.string_dtype())
        else:
            changed = of_array(array, rng)
            changed = changed.astype("S4") if changed.dtype.kind == "U" else changed
            packing = rng.choice([None, "gzip", "lzf"]) if changed.ndim and changed.size else None
            opened.create_dataset(name, data=changed, compression=packing)
    return file.getvalue()


def of_lines(data: bytes, rng: random.Random) -> bytes:
    """Change, leave out, repeat or swap lines of a text and its cells."""
    kind = rng.random()
    if kind < 0.2:
        return of_bytes(data, rng)
    lines = data.decode().splitlines()
    one = rng.randrange(len(lines))
    if kind < 0.35:
        del lines[one]
    elif kind < 0.45:
        lines *= rng.choice([2, 1000])
    elif kind < 0.55:
        lines[one] = rng.choice([value for value in TEXTS if "\n" not in value])
    else:
        split = "," if "," in lines[one] else "  "
        cells = lines[one].split(split)
        cells[rng.randrange(len(cells))] = str(rng.choice([*TEXTS, "1e999", "-5", "9" * 400, "nan", '"', "0x10"]))
        lines[one] = split.join(cells)
    return "\n".join(lines).encode("utf-8", "replace")


def of_kind(path: Path, rng: random.Random) -> None:
    """Mutate a file in place, by what its name says it is; now and then put another kind of thing there."""
    chance = rng.random()
    if chance < 0.02:
        path.unlink()
        rng.choice(
            [
                lambda: os.mkfifo(path),
                lambda: path.symlink_to("/dev/zero"),
                lambda: path.symlink_to(path.parent.parent / SECRET.removeprefix("../")),
                lambda: path.mkdir(),
                lambda: None,
                lambda: path.symlink_to(path.name),
            ]
        )()
        return
    data = path.read_bytes()
    kind = KINDS["SHA256SUMS" if path.name == "SHA256SUMS" else path.suffix.removeprefix(".")]
    for _ in range(rng.choice([1, 1, 1, 2])):
        try:
            data = kind(data, rng)
        except Exception:  # what the first mutation left cannot be taken apart again
            data = of_bytes(data, rng)
    path.write_bytes(data)


KINDS: dict[str, Mutation] = {
    "yaml": of_yaml,
    "json": of_json,
    "safetensors": of_safetensors,
    "ckpt": of_checkpoint,
    "hdf5": of_hdf5,
    "npy": of_npy,
    "npz": of_npz,
    "parquet": of_parquet,
    "csv": of_lines,
    "SHA256SUMS": of_lines,
}
"""Suffix -> the mutation of such a file."""
