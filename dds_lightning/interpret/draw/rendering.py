"""Pictures by MuJoCo itself, where a graphics driver is there: the same frames as the stick figures.

A driver that is missing or broken can end the process that asks for it, so pictures are made in a process of their own;
where every backend fails, there are none, and the stick figures have to do.
"""

from __future__ import annotations

import io
import json
import os
import subprocess
import sys
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from dds_lightning.errors import UserError
from dds_lightning.interpret.draw.drawing import LABEL, grid, heading
from dds_lightning.tasks import Task, facts_to_keep

BACKENDS = ("egl", "osmesa", "glfw")
"""Tried in this order unless `MUJOCO_GL` names one."""
COLUMNS = 6
"""Moments that are shown."""
PATIENCE = 120.0
"""Seconds that one backend may take."""
_CODE = "from dds_lightning.interpret.draw.rendering import worker; worker()"


def render_frames(task: Task, qpos: NDArray[Any], width: int = 320, height: int = 240) -> NDArray[np.uint8] | None:
    """Render a body at some moments, the camera beside its torso.

    Args:
        task: The environment.
        qpos: (T, nq); rows after the end of a replay (NaN) are left out.
        width: Width in pixels.
        height: Height in pixels.

    Returns:
        (T, height, width, 3), or None where no graphics driver works.
    """
    qpos = np.asarray(qpos, dtype=np.float64)
    qpos = qpos[np.isfinite(qpos).all(axis=1)]
    file = io.BytesIO()
    np.savez(file, qpos=qpos, size=np.array([width, height]), task=np.array(json.dumps(facts_to_keep(task))))
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
            frames: NDArray[np.uint8] = np.load(io.BytesIO(made.stdout), allow_pickle=False)
            return frames
    return None


def plot_rendered(task: Task, frames: dict[int, NDArray[np.uint8]], every: int) -> Figure:
    """Rendered frames side by side, a row a skill, a column a moment: some of those of `strobe.plot_strobes`.

    Args:
        task: The environment.
        frames: Code to (T, h, w, 3).
        every: Steps between two frames of the rendered series.

    Raises:
        UserError: There is nothing to draw.
    """
    if not frames:
        raise UserError("frames is empty: there is nothing to draw")
    longest = max(map(len, frames.values()))
    moments = np.linspace(0, longest - 1, min(longest, COLUMNS)).round().astype(int)
    wide = 7.0 / len(moments)
    figure, axes = grid(len(frames) * len(moments), wide, wide * 0.75 + 0.25, columns=len(moments))
    for row, (code, series) in enumerate(frames.items()):
        for column, t in enumerate(moments):
            ax = axes[row * len(moments) + column]
            ax.set_axis_off()
            if t >= len(series):  # it has fallen before
                continue
            ax.imshow(series[t])
            if column == 0:
                heading(ax, code, f"{0:.2f} s")
            else:
                ax.set_title(f"{t * every * task.step_seconds:.2f} s", fontsize=9)
    figure.suptitle("The same frames rendered by MuJoCo", fontsize=LABEL - 1)
    return figure


def worker() -> None:
    """What the process of its own runs: the request on standard input, an array on standard output."""
    sink = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # whatever a library prints must not land in the array
    with np.load(io.BytesIO(sys.stdin.buffer.read()), allow_pickle=False) as request:
        qpos, (width, height), name = request["qpos"], request["size"], str(request["task"])
    file = io.BytesIO()
    np.save(file, _render(name, qpos, int(width), int(height)), allow_pickle=False)
    sink.write(file.getvalue())
    sink.flush()
    os._exit(0)  # a driver that fails while it is put away has done its work


def _render(facts: str, qpos: NDArray[np.float64], width: int, height: int) -> NDArray[np.uint8]:
    import mujoco

    from dds_lightning.interpret.measure.replay import simulator
    from dds_lightning.interpret.views import view_of
    from dds_lightning.tasks import restore_task

    mujoco.GLContext(16, 16).free()  # without a driver it ends here, before anything slow
    task = restore_task(json.loads(facts), "the request")
    assert task is not None, "the caller names it"
    with simulator(task) as env:
        model: Any = env.unwrapped.model
        model.vis.global_.offwidth, model.vis.global_.offheight = width, height
        data = mujoco.MjData(model)
        renderer = mujoco.Renderer(model, height, width)
        camera = mujoco.MjvCamera()
        view = view_of(task)
        camera.distance, camera.azimuth, camera.elevation = view.camera
        frames = []
        for row in qpos:
            data.qpos[:] = row
            mujoco.mj_forward(model, data)
            torso = data.xpos[model.jnt_bodyid[0]]
            camera.lookat[:] = view.looks_at or (torso[0], torso[1], view.eye)
            renderer.update_scene(data, camera)
            frames.append(renderer.render().copy())
    return np.stack(frames) if frames else np.zeros((0, height, width, 3), np.uint8)
