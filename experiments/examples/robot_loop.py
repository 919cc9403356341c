"""The program of a robot: an exported policy acts 50 times a second, one step late.

C MuJoCo is the robot here, and nothing of mjx_reinforce is needed. In this folder, to train the
quadruped, to export its policy, and to let it walk for ten seconds of wall clock:

    python -m mjx_reinforce.train --env quadruped:Quadruped --output quadruped
    python -m mjx_reinforce.export quadruped --env quadruped:Quadruped --output policy.npz
    python robot_loop.py policy.py

The same for a robot on legs and the class that ``new`` writes of it, which walks as commanded,
forward and sideways (m/s), and turns to the left (rad/s); here of the quadruped's model, too:

    cp quadruped.xml dog.xml
    python -m mjx_reinforce.new dog.xml
    python -m mjx_reinforce.train legged --env dog:Dog --minutes 20 --output dog_run
    python -m mjx_reinforce.export dog_run --env dog:Dog --output policy.npz
    python robot_loop.py policy.py --xml dog.xml --command 0.5 0 0.2

On a robot, ``observe`` reads sensors, and the control goes to the servos in place of ``mj_step``.
"""

import argparse
import importlib
import sys
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

mujoco: Any = importlib.import_module("mujoco")  # a C extension without stubs

PERIOD = 0.02  # s between actions, as in training


class Walk(NamedTuple):
    """What a robot saw and did in N steps.

    positions: [N + 1, nq]
    speeds: [N, 3] forward, sideways (m/s), and to the left (rad/s), in its own frame
    observations: [N, O]
    controls: [N, nu]
    """

    positions: np.ndarray
    speeds: np.ndarray
    observations: np.ndarray
    controls: np.ndarray


def quadruped(data, action, step):
    """Returns what ``observe`` of quadruped.py returns, in its order and units."""
    return np.concatenate([data.qpos[2:], data.qvel])


def legged(policy, model, command):
    """Returns the same for the class that ``new`` writes of a robot on legs, under a command [3].

    It has the home pose and the gait's period of the policy's file, and all else of the model: the
    servos are in the order of the class's JOINTS, and its BODY is that of the free joint.
    """
    servos = model.actuator_trnid[:, 0]
    body = model.jnt_bodyid[0]
    period = len(policy.P["gait"])

    def observe(data, action, step):
        rotation = data.xmat[body].reshape(3, 3)
        gravity = -rotation[2]
        gyro = data.cvel[body, :3] @ rotation
        angles = data.qpos[model.jnt_qposadr[servos]] - policy.P["home"]
        speeds = data.qvel[model.jnt_dofadr[servos]]
        phase = 2 * np.pi * (step % period) / period
        clock = np.array([np.sin(phase), np.cos(phase)])
        strides = np.outer(clock, command).ravel()
        return np.concatenate([gravity, gyro, angles, speeds, action, command, clock, strides])

    return observe


def control(policy, action, step):
    """Returns the controls [nu] of a step in which an action arrives."""
    if "gait" in policy.P:
        return policy.control(action, step)
    return policy.control(action)


def run(policy, model, num_steps, wait, observe=quadruped):
    """Plays a policy, and returns its ``Walk``.

    Args:
      policy: an exported module, with its control.
      model: an ``MjModel``, whose first joint is free; it starts in the first key frame.
      num_steps: for so many actions.
      wait: is called with the number of each step after it, and returns when the next is due.
      observe: returns what the policy sees, of an ``MjData``, the last action, and the step.
    """
    act = policy.act
    if hasattr(policy, "Policy"):  # it remembers the last observations
        act = policy.Policy().act
    data = mujoco.MjData(model)
    if model.nkey:
        mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_forward(model, data)
    # Until the first action arrives, the servos do what an action of zero means.
    action = np.zeros(model.nu)
    ctrl = control(policy, action, 0)
    positions, speeds, observations, controls = [data.qpos.copy()], [], [], []
    for step in range(num_steps):
        # Measuring, computing and sending take time: the action arrives with the next step.
        observations.append(observe(data, action, step))
        action = act(observations[-1])
        next_ctrl = control(policy, action, step + 1)
        data.ctrl[:] = ctrl
        mujoco.mj_step(model, data, round(PERIOD / model.opt.timestep))
        controls.append(ctrl)
        ctrl = next_ctrl
        positions.append(data.qpos.copy())
        rotation = data.xmat[model.jnt_bodyid[0]].reshape(3, 3)
        speeds.append([*(data.qvel[:3] @ rotation)[:2], data.qvel[5]])
        wait(step)
    return Walk(*map(np.array, (positions, speeds, observations, controls)))


def wall_clock():
    """Returns a ``wait`` that keeps the period; it says by how much a step was late."""
    start = time.monotonic()

    def wait(step):
        left = start + PERIOD * (step + 1) - time.monotonic()
        if left < 0:
            print(f"step {step} was {-1e3 * left:.1f} ms late")
        time.sleep(max(left, 0))

    return wait


def summary(walk):
    """Returns how far a robot walked, seen once a second, and its mean speeds, in words."""
    places = walk.positions[:: round(1 / PERIOD), :2]
    distance = np.linalg.norm(np.diff(places, axis=0), axis=1).sum()
    forward, sideways, turn = walk.speeds.mean(axis=0)
    return (
        f"walked {distance:.2f} m in {PERIOD * len(walk.speeds):.0f} s: {forward:.2f} m/s forward, "
        f"{sideways:.2f} m/s sideways, {turn:.2f} rad/s to the left"
    )


def main():
    """Plays the policy of the command line for ten seconds."""
    parser = argparse.ArgumentParser(description="Play an exported policy at 50 Hz.")
    parser.add_argument("policy", type=Path, help="the module, policy.py")
    parser.add_argument("--xml", default=Path(__file__).with_name("quadruped.xml"), type=Path)
    parser.add_argument(
        "--command", nargs=3, type=float, default=(0.5, 0.0, 0.0), help="m/s, m/s, rad/s"
    )
    arguments = parser.parse_args()
    sys.path.insert(0, str(arguments.policy.resolve().parent))
    policy = importlib.import_module(arguments.policy.stem)
    model = mujoco.MjModel.from_xml_path(str(arguments.xml))
    observe = quadruped
    if "gait" in policy.P:
        observe = legged(policy, model, arguments.command)
    print(summary(run(policy, model, num_steps=500, wait=wall_clock(), observe=observe)))


if __name__ == "__main__":
    main()
