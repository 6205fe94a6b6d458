"""MuJoCo, imported in one place: its physics must not depend on whether it could draw.

`import mujoco` loads the graphics library that `MUJOCO_GL` names, and fails where there is none or where the name is
wrong. Nothing is drawn in this process (`interpret.draw.rendering` draws in another), so then it is imported without.
"""

import os
import sys

try:
    import mujoco as mujoco
except ModuleNotFoundError as error:
    if error.name == "mujoco" or "MUJOCO_GL" not in os.environ:
        raise
    mujoco = None
except Exception:
    if "MUJOCO_GL" not in os.environ:
        raise
    mujoco = None

if mujoco is None:
    for name in [name for name in sys.modules if name.partition(".")[0] == "mujoco"]:
        del sys.modules[name]  # what the first attempt left half imported
    wanted = os.environ["MUJOCO_GL"]
    os.environ["MUJOCO_GL"] = "disable"
    try:
        import mujoco as mujoco
    finally:
        os.environ["MUJOCO_GL"] = wanted
