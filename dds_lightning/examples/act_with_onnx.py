"""Act in PointMaze with an exported agent: numpy, onnxruntime and the simulator, no torch.

dds export checkpoints/pointmaze-large --out agent.onnx && python act_with_onnx.py agent.onnx
"""

import json
import sys

import gymnasium as gym
import gymnasium_robotics
import numpy as np
import onnxruntime

gym.register_envs(gymnasium_robotics)
session = onnxruntime.InferenceSession(sys.argv[1])
facts = json.loads(session.get_modelmeta().custom_metadata_map["dds_lightning.json"])
env = gym.make("PointMaze_Large-v3", continuing_task=False, max_episode_steps=800)
cells = {"reset_cell": np.array([7, 1]), "goal_cell": np.array([1, 10])}
seen, info = env.reset(seed=0, options=cells)
rng = np.random.default_rng(0)
code, step, ended = np.array([-1]), 0, False
while not ended:
    inputs = {
        "observations": seen["observation"][None].astype(np.float32),
        "codes": code if step % facts["horizon"] else np.array([-1]),  # -1: a new skill is due
        "gumbel": rng.gumbel(size=(1, facts["num_skills"])).astype(np.float32),
        "noise": rng.standard_normal((facts["draws"], 1, facts["action_dim"])).astype(np.float32),
    }
    action, code = session.run(None, inputs)
    seen, reward, terminated, truncated, info = env.step(action[0])
    step, ended = step + 1, terminated or truncated
print(f"{'reached the goal' if info['success'] else 'did not reach the goal'} in {step} steps")
