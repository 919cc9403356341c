"""The program of a robot: an exported policy acts 50 times a second, one step late.

C MuJoCo is the robot here, and nothing of mjx_reinforce is needed. In this folder, to train the
quadruped, to export its policy, and to let it walk for ten seconds of wall clock:

    python -m mjx_reinforce.train --env quadruped:Quadruped --output quadruped
    python -m mjx_reinforce.export quadruped --env quadruped:Quadruped --output policy.npz
    python robot_loop.py policy.py

On a robot, ``observe`` reads sensors, and the control goes to the servos in place of ``mj_step``.
"""

import importlib
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

mujoco: Any = importlib.import_module("mujoco")  # a C extension without stubs

PERIOD = 0.02  # s between actions, as in training


def observe(data):
    """Returns what the task's ``observe`` returns, in its order and units."""
    return np.concatenate([data.qpos[2:], data.qvel])


def run(policy, model, num_steps, wait):
    """Plays a policy, and returns the robot's positions [num_steps + 1, nq].

    Args:
      policy: an exported module, with its control.
      model: an ``MjModel``.
      num_steps: for so many actions.
      wait: is called with the number of each step after it, and returns when the next is due.
    """
    act = policy.act
    if hasattr(policy, "Policy"):  # it remembers the last observations
        act = policy.Policy().act
    data = mujoco.MjData(model)
    positions = [data.qpos.copy()]
    # Until the first action arrives, the servos hold what they hold.
    ctrl = np.zeros(model.nu)
    for step in range(num_steps):
        # Measuring, computing and sending take time: the action arrives with the next step.
        next_ctrl = policy.control(act(observe(data)))
        data.ctrl[:] = ctrl
        mujoco.mj_step(model, data, round(PERIOD / model.opt.timestep))
        positions.append(data.qpos.copy())
        ctrl = next_ctrl
        wait(step)
    return np.array(positions)


def wall_clock():
    """Returns a ``wait`` that keeps the period; it says by how much a step was late."""
    start = time.monotonic()

    def wait(step):
        left = start + PERIOD * (step + 1) - time.monotonic()
        if left < 0:
            print(f"step {step} was {-1e3 * left:.1f} ms late")
        time.sleep(max(left, 0))

    return wait


if __name__ == "__main__":
    robot = mujoco.MjModel.from_xml_path(str(Path(__file__).with_name("quadruped.xml")))
    file = Path(sys.argv[1])
    sys.path.insert(0, str(file.parent))
    way = run(importlib.import_module(file.stem), robot, num_steps=500, wait=wall_clock())
    print(f"walked {way[-1, 0] - way[0, 0]:.2f} m in {PERIOD * (len(way) - 1):.0f} s")
