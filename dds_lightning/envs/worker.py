"""The program of an environment worker, which steps some slots of an `EnvPool` on request, and its protocol.

Imports neither torch nor Lightning, so a worker starts in about a second and stays small.
"""

from __future__ import annotations

import contextlib
import os
import pickle
import signal
import struct
import traceback
from collections.abc import Iterator
from typing import IO, TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from dds_lightning.errors import UserError

if TYPE_CHECKING:
    from dds_lightning.tasks import Task

_HEADER = struct.Struct("<cQ")


def record_dtype(task: Task) -> np.dtype[Any]:
    """Return the type of a slot's answer to one step.

    Fields: `observation` (O,) to act on next; `reached` (O,) where the action led (they differ when an
    episode ended and the next began); `position` and `reached_position` (2,) likewise, NaN without a maze;
    `reward`, `terminated`, `truncated`; `success` of the state reached; `alive`, whether the slot has more steps.
    """
    width = (task.observation_dim,)
    return np.dtype(
        [
            ("observation", np.float32, width),
            ("reached", np.float32, width),
            ("position", np.float64, (2,)),
            ("reached_position", np.float64, (2,)),
            ("reward", np.float64),
            ("terminated", np.bool_),
            ("truncated", np.bool_),
            ("success", np.bool_),
            ("alive", np.bool_),
        ]
    )


class Slots:
    """Some environments and the seeds that each has yet to play; runs in a worker, or in the caller itself."""

    def __init__(self, task: Task, count: int) -> None:
        """Build `count` environments."""
        with _small_textures():
            self.envs = [task.make_env() for _ in range(count)]
        self.dtype = record_dtype(task)
        self.seeds: list[list[int]] = [[] for _ in self.envs]

    def start(self, seeds: list[list[int]]) -> NDArray[Any]:
        """Give every slot its list of seeds and start the first episodes; returns one record per slot."""
        self.seeds = [list(reversed(each)) for each in seeds]
        records = np.zeros(len(self.envs), self.dtype)
        for slot, record in enumerate(records):
            self._begin(slot, record)
        return records

    def step(self, slots: NDArray[np.int64], actions: NDArray[np.float32]) -> NDArray[Any]:
        """Step some slots; returns one record for each."""
        records = np.zeros(len(slots), self.dtype)
        for slot, action, record in zip(slots.tolist(), actions, records, strict=True):
            observation, reward, terminated, truncated, info = self.envs[slot].step(action)
            position = info.get("position", np.nan)
            record["reached"], record["reached_position"] = observation, position
            record["reward"], record["success"] = reward, info.get("success", False)
            record["terminated"], record["truncated"] = terminated, truncated
            if terminated or truncated:
                self._begin(slot, record)
            else:
                record["observation"], record["position"], record["alive"] = observation, position, True
        return records

    def _begin(self, slot: int, record: Any) -> None:
        if not self.seeds[slot]:
            return
        observation, info = self.envs[slot].reset(seed=self.seeds[slot].pop())
        record["observation"], record["position"] = observation, info.get("position", np.nan)
        record["alive"] = True

    def close(self) -> None:
        """Close every environment."""
        for env in self.envs:
            env.close()


@contextlib.contextmanager
def _small_textures() -> Iterator[None]:
    """Build MuJoCo models with one-pixel textures: a pool's environments are never rendered.

    Drawing the mazes' sky is 97 % of the 70 ms that a model takes to compile. Physics is the same to the bit.
    """
    try:
        from dds_lightning.envs.physics import mujoco
    except ImportError:  # an environment without MuJoCo
        yield
        return
    original = mujoco.MjModel.from_xml_path

    def compile_small(filename: str, *arguments: Any, **keywords: Any) -> Any:
        if arguments or keywords:
            return original(filename, *arguments, **keywords)
        spec = mujoco.MjSpec.from_file(filename)
        for texture in spec.textures:
            if texture.builtin != mujoco.mjtBuiltin.mjBUILTIN_NONE:
                texture.width = texture.height = 1
        return spec.compile()

    mujoco.MjModel.from_xml_path = compile_small
    try:
        yield
    finally:
        mujoco.MjModel.from_xml_path = original


def write_frame(stream: IO[bytes], kind: bytes, payload: bytes) -> None:
    """Send one message: a letter for its kind, its size, its bytes."""
    stream.write(_HEADER.pack(kind, len(payload)) + payload)
    stream.flush()


def read_frame(stream: IO[bytes]) -> tuple[bytes, bytes] | None:
    """Return the next frame, or None if the other side has closed the pipe."""
    header = stream.read(_HEADER.size)
    if len(header) < _HEADER.size:
        return None
    kind, size = _HEADER.unpack(header)
    payload = stream.read(size)
    return (kind, payload) if len(payload) == size else None


def pack_step(slots: NDArray[np.int64], actions: NDArray[np.float32]) -> bytes:
    """A request to step `slots` (n,) with `actions` (n, A)."""
    return slots.astype(np.int64).tobytes() + actions.tobytes()


def unpack_step(payload: bytes, action_dim: int) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """The inverse of `pack_step`."""
    count = len(payload) // (8 + 4 * action_dim)
    actions = np.frombuffer(payload, np.float32, offset=8 * count).reshape(count, action_dim)
    return np.frombuffer(payload, np.int64, count), actions


def worker_main() -> None:
    """Run a worker process until its input ends."""
    # Ctrl-C reaches the whole terminal, a scheduler's SIGTERM the whole job: the caller decides, and the worker ends
    # with it.
    for signum in (signal.SIGINT, signal.SIGTERM):
        signal.signal(signum, signal.SIG_IGN)
    source = os.fdopen(os.dup(0), "rb")
    sink = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # whatever a library prints must not land between the frames
    slots: Slots | None = None
    while (frame := read_frame(source)) is not None:
        kind, payload = frame
        try:
            if kind == b"I":
                task, count = pickle.loads(payload)  # noqa: S301 - from our caller, through a private pipe
                slots = Slots(task, count)
                answer = b""
            else:
                assert slots is not None
                if kind == b"R":
                    answer = slots.start(pickle.loads(payload)).tobytes()  # noqa: S301 - likewise
                else:
                    answer = slots.step(*unpack_step(payload, task.action_dim)).tobytes()
            reply = b"O"
        except UserError as error:
            reply, answer = b"U", str(error).encode()
        except Exception:
            reply, answer = b"E", traceback.format_exc().encode()
        try:
            write_frame(sink, reply, answer)
        except OSError:
            break  # the caller has ended
