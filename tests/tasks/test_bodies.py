"""Names of observations and actions, held against the joints and motors of the MuJoCo models."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
import pytest

from dds_lightning.envs.build import build_env
from dds_lightning.tasks import get_task, task_names
from dds_lightning.tasks.bodies import action_names, observation_names

MODELS = {
    "halfcheetah-medium": "HalfCheetah-v4",
    "hopper-medium": "Hopper-v4",
    "walker2d-medium": "Walker2d-v4",
    "antmaze-umaze": "AntMaze_UMaze-v4",
    "pointmaze-umaze-play": "PointMaze_UMaze-v3",
    "kitchen-mixed": "FrankaKitchen-v1",
}


def model_of(env_id: str) -> Any:
    inner: Any = build_env(env_id).unwrapped
    for name in ("ant_env", "point_env", "robot_env"):
        inner = getattr(inner, name, inner)
    return inner.model


def joints(model: Any) -> list[str]:
    return [mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_JOINT, j) for j in range(model.njnt)]


@pytest.mark.parametrize("name", task_names())
def test_every_number_has_a_name_of_its_own(name: str) -> None:
    task = get_task(name)
    observations, actions = observation_names(task), action_names(task)
    assert (len(observations), len(actions)) == (task.observation_dim, task.action_dim)
    assert len(set(observations)) == len(observations)
    assert len(set(actions)) == len(actions)
    assert not any(one.startswith(("observation", "action")) for one in (*observations, *actions))


@pytest.mark.parametrize("name", ["halfcheetah-medium", "hopper-medium", "walker2d-medium"])
def test_a_runners_angles_and_motors_are_the_models(name: str) -> None:
    model, names = model_of(MODELS[name]), observation_names(get_task(name))
    moved = [joint.removesuffix("_joint") for joint in joints(model)[3:]]
    if name.startswith("half"):
        words = [joint.replace("b", "back ", 1) if joint[0] == "b" else f"front {joint[1:]}" for joint in moved]
    else:
        words = ["left " + joint.removesuffix("_left") if "left" in joint else joint for joint in moved]
    assert [one.removesuffix(" (rad)") for one in names[2 : 2 + len(words)]] == words
    assert [one.removesuffix(" velocity (rad/s)") for one in names[-len(words) :]] == words
    assert action_names(get_task(name)) == tuple(words[j - 3] for j in model.actuator_trnid[:, 0])


def test_an_ants_motors_begin_with_the_fourth_leg_as_in_the_model() -> None:
    model, task = model_of("AntMaze_UMaze-v4"), get_task("antmaze-umaze")
    words = [joint.replace("_", " ") for joint in joints(model)[1:]]
    assert [one.removesuffix(" (rad)") for one in observation_names(task)[7:15]] == words
    assert [one.removesuffix(" velocity (rad/s)") for one in observation_names(task)[21:]] == words
    assert action_names(task) == tuple(words[j - 1] for j in model.actuator_trnid[:, 0])
    assert action_names(task)[:2] == ("hip 4", "ankle 4")


def test_the_kitchens_names_lie_on_the_models_joints() -> None:
    model, names = model_of("FrankaKitchen-v1"), observation_names(get_task("kitchen-mixed"))
    places = dict(zip(joints(model), model.jnt_qposadr, strict=True))
    kinds = dict(zip(joints(model), model.jnt_type, strict=True))
    ours = {
        "robot:panda0_joint1": "joint 1 (rad)",
        "robot:panda0_finger_joint2": "finger 2 (m)",
        "knob_Joint_1": "bottom right knob (rad)",
        "bottom_right_burner": "bottom right burner (m)",
        "knob_Joint_2": "bottom left knob (rad)",
        "bottom_left_burner": "bottom left burner (m)",
        "knob_Joint_3": "top right knob (rad)",
        "top_right_burner": "top right burner (m)",
        "knob_Joint_4": "top left knob (rad)",
        "top_left_burner": "top left burner (m)",
        "light_switch": "light switch (rad)",
        "light_joint": "light (m)",
        "slide_cabinet": "slide cabinet (m)",
        "left_hinge_cabinet": "left hinge cabinet (rad)",
        "right_hinge_cabinet": "right hinge cabinet (rad)",
        "microwave": "microwave (rad)",
        "kettle": "kettle x (m)",
    }
    for joint, name in ours.items():
        assert names[places[joint]] == name
        if kinds[joint] != mujoco.mjtJoint.mjJNT_FREE:
            hinge = kinds[joint] == mujoco.mjtJoint.mjJNT_HINGE
            assert name.endswith("(rad)" if hinge else "(m)")
    assert names[30:] == tuple(f"goal of {name}" for name in names[:30])
    motors = [joints(model)[j] for j in model.actuator_trnid[:, 0]]
    assert [int(places[joint]) for joint in motors] == list(range(9))


def test_a_push_along_x_moves_the_ball_along_x() -> None:
    task = get_task("pointmaze-umaze-play")
    names = observation_names(task)
    env = task.make_env()
    env.reset(seed=0)
    for _ in range(5):
        observation = env.step(np.array([1.0, 0.0], np.float32))[0]
    env.close()
    assert observation[names.index("x velocity (m/s)")] > 0.1
    assert abs(observation[names.index("y velocity (m/s)")]) < 1e-6
