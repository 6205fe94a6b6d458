"""Pictures rendered by MuJoCo, if there is a graphics driver: the same frames as the stick figures.

A missing or broken driver can end the process that uses it, so pictures are rendered in a separate process; if every
backend fails, there are none, and the stick figures have to suffice.
"""

from __future__ import annotations

import io
import json
import os
import subprocess
import sys
import time
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from dds_lightning.errors import UserError
from dds_lightning.interpret.draw.drawing import LABEL, grid, heading, write_title
from dds_lightning.saving.arrays import read_npy, read_npz
from dds_lightning.saving.untrusted import parse_json
from dds_lightning.tasks import Task, is_own
from dds_lightning.tasks.own import definition

BACKENDS = ("egl", "osmesa", "glfw")
"""Tried in this order unless `MUJOCO_GL` names one."""
COLUMNS = 6
"""Maximum number of moments shown."""
PATIENCE = 120.0
"""Time limit of one backend in seconds."""
PROBE = 8
"""Frames after which a backend that would exceed the limit gives up."""
_CODE = "from dds_lightning.interpret.draw.rendering import worker; worker()"


def render_frames(task: Task, qpos: NDArray[Any], width: int = 320, height: int = 240) -> NDArray[np.uint8] | None:
    """Render a body at some moments, the camera beside its torso.

    Args:
        task: The environment.
        qpos: (T, nq); rows after the end of a replay (NaN) are left out.
        width: Width in pixels.
        height: Height in pixels.

    Returns:
        (T, height, width, 3), or None if no graphics driver works.
    """
    qpos = np.asarray(qpos, dtype=np.float64)
    qpos = qpos[np.isfinite(qpos).all(axis=1)]
    file, asked = io.BytesIO(), definition(task) if is_own(task) else task.name
    np.savez(file, qpos=qpos, size=np.array([width, height]), task=np.array(json.dumps(asked)))
    wanted = os.environ.get("MUJOCO_GL", "").lower()
    path = os.pathsep.join(entry or os.getcwd() for entry in sys.path)
    for backend in (wanted,) if wanted else BACKENDS:
        environment = {**os.environ, "MUJOCO_GL": backend, "PYTHONPATH": path}
        if backend == "osmesa":
            environment["PYOPENGL_PLATFORM"] = "osmesa"
        try:
            made = subprocess.run(  # noqa: S603 - this Python and a constant program, no shell
                [sys.executable, "-P", "-c", _CODE],
                input=file.getvalue(),
                capture_output=True,
                env=environment,
                timeout=PATIENCE,
                check=False,
            )
        except (subprocess.TimeoutExpired, OSError):
            continue
        if made.returncode == 0 and made.stdout:
            return read_npy(io.BytesIO(made.stdout))
    return None


def plot_rendered(task: Task, frames: dict[int, NDArray[np.uint8]], every: int) -> Figure:
    """Draw rendered frames side by side, one row per skill, one column per moment, chosen from `strobe.plot_strobes`.

    Args:
        task: The environment.
        frames: Code -> (T, h, w, 3).
        every: Steps between two frames of the rendered series.

    Raises:
        UserError: There is nothing to draw.
    """
    if not frames:
        raise UserError("frames is empty, expected the frames of at least one skill")
    longest = max(map(len, frames.values()))
    moments = np.linspace(0, longest - 1, min(longest, COLUMNS)).round().astype(int)
    wide = 7.0 / len(moments)
    figure, axes = grid(len(frames) * len(moments), wide, wide * 0.75 + 0.25, columns=len(moments))
    for row, (code, series) in enumerate(frames.items()):
        for column, t in enumerate(moments):
            ax = axes[row * len(moments) + column]
            ax.set_axis_off()
            if t >= len(series):  # it has fallen earlier
                continue
            ax.imshow(series[t])
            if column == 0:
                heading(ax, code, f"{0:.2f} s")
            else:
                ax.set_title(f"{t * every * task.step_seconds:.2f} s", fontsize=9)
    write_title(figure, "The same frames rendered by MuJoCo", LABEL - 1)
    return figure


def worker() -> None:
    """Run the separate process: reads the request from standard input, writes an array to standard output."""
    sink = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # whatever a library prints must not land in the array
    request = read_npz(io.BytesIO(sys.stdin.buffer.read()))
    qpos, (width, height), name = request["qpos"], request["size"], str(request["task"])
    file = io.BytesIO()
    np.save(file, _render(name, qpos, int(width), int(height)), allow_pickle=False)
    sink.write(file.getvalue())
    sink.flush()
    os._exit(0)  # a driver may fail during its clean-up, when its work is done


def _render(facts: str, qpos: NDArray[np.float64], width: int, height: int) -> NDArray[np.uint8]:
    import mujoco

    from dds_lightning.interpret.measure.replay import simulator
    from dds_lightning.interpret.views import has_view, view_of
    from dds_lightning.tasks import known_task
    from dds_lightning.tasks.own import build_task

    mujoco.GLContext(16, 16).free()  # without a driver the process ends here, before anything slow
    asked = parse_json(facts, "the request")  # our own: its environment is already used by the caller
    task = known_task(asked) if isinstance(asked, str) else build_task(asked, "the request")
    with simulator(task) as env:
        model: Any = env.unwrapped.model
        model.vis.global_.offwidth, model.vis.global_.offheight = width, height
        data = mujoco.MjData(model)
        renderer = mujoco.Renderer(model, height, width)
        camera = mujoco.MjvCamera()
        view = view_of(task)
        if has_view(task):
            camera.distance, camera.azimuth, camera.elevation = view.camera
        else:
            mujoco.mjv_defaultFreeCamera(model, camera)
        frames: list[NDArray[np.uint8]] = []
        start = time.perf_counter()
        for row in qpos:
            if len(frames) == PROBE and (time.perf_counter() - start) / PROBE * len(qpos) > PATIENCE / 2:
                raise TimeoutError("a driver without a graphics card")
            data.qpos[:] = row
            mujoco.mj_forward(model, data)
            torso = data.xpos[model.jnt_bodyid[0]]
            if has_view(task):
                camera.lookat[:] = view.looks_at or (torso[0], torso[1], view.eye)
            renderer.update_scene(data, camera)
            frames.append(renderer.render().copy())
    return np.stack(frames) if frames else np.zeros((0, height, width, 3), np.uint8)
