#!/usr/bin/env bash
# playground 0.2.0, impl "jax": the manipulation tasks fill the joints of a new simulation in reset, and
# read positions, rotations, and sensors for the observation before anything has computed them. So the
# first observation of every episode has gripper and box at the world's origin, no way from one to the
# other, and matrices of zeros, which are no rotations. From this scene the policy chooses its first
# action, and a normalizer takes its statistics; no camera or arm will ever show it. mjx.forward in
# reset, as in the locomotion tasks, computes the true one. Here PandaPickCube; after a reset, AlohaHandOver,
# AlohaSinglePegInsertion, LeapCubeReorient, LeapCubeRotateZAxis, PandaOpenCabinet,
# PandaPickCubeCartesian, PandaPickCubeOrientation, and PandaRobotiqPushCube have zeros for the positions
# of all bodies and sites, too.
# Playground downloads the arm's file elsewhere; slides with the names of its joints stand for it here.
# Seen with: mujoco 4.0.0, mujoco-mjx 3.17.0, jax 0.10.2, Python 3.11. Fails if that changes.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet playground==0.2.0 brax==0.14.2 mujoco==4.0.0 mujoco-mjx==3.17.0 \
  jax==0.10.2 jaxlib==0.10.2
JAX_PLATFORMS=cpu "$folder/venv/bin/python" - <<'PROGRAM'
import jax
import numpy as np
from mujoco import mjx
from mujoco_playground._src import mjx_env
from mujoco_playground._src.manipulation.franka_emika_panda import pick

AXES = ("1 0 0", "0 1 0", "0 0 1")
SLIDE = '<joint name="{}" type="slide" axis="{}" armature="1"/>'
JOINTS = [SLIDE.format(f"joint{n + 1}", AXES[n % 3]) for n in range(7)]
SERVOS = [f'<position joint="joint{n + 1}" kp="2000" ctrlrange="-3 3"/>' for n in range(7)]
BALL = 'size=".01" mass=".5" contype="0" conaffinity="0"'
# Where the key frame of the task's own file has the joints, the gripper is at (0.5, 0.05, 0.4).
ARM = f"""<mujoco><worldbody><body name="arm" pos="2.86 -.25 -1.6">{"".join(JOINTS[:3])}<geom {BALL}/>
  <body>{"".join(JOINTS[3:])}<site name="gripper"/><geom name="hand_capsule" {BALL}/>
    <body>{SLIDE.format("finger_joint1", "0 1 0")}<geom name="left_finger_pad" {BALL}/></body>
    <body>{SLIDE.format("finger_joint2", "0 -1 0")}<geom name="right_finger_pad" {BALL}/></body>
  </body></body></worldbody><actuator>{"".join(SERVOS)}
  <position joint="finger_joint1" kp="300" ctrlrange="0 .04"/></actuator></mujoco>"""
folder = mjx_env.MENAGERIE_PATH / "franka_emika_panda"
(folder / "assets").mkdir(parents=True)
(folder / "mjx_panda.xml").write_text(ARM)

env = pick.PandaPickCube(config_overrides={"impl": "jax"})
state = jax.jit(env.reset)(jax.random.PRNGKey(1))
data = jax.jit(mjx.forward)(env.mjx_model, state.data)
num_joint_entries = env.mjx_model.nq + env.mjx_model.nv


def places(observation):
    """Returns the gripper's position (m), two rows of the box's rotation, and the way to the box (m)."""
    entries = np.round(np.asarray(observation, float)[num_joint_entries:], 2) + 0.0
    return entries[:3].tolist(), entries[9:15].tolist(), entries[15:18].tolist()


observed = places(state.obs)
computed = places(env._get_obs(data, state.info))
print("observed after reset:", *observed)
print("after mjx.forward:   ", *computed)
assert not any(x for entries in observed for x in entries)
assert computed[0] == [0.5, 0.05, 0.4]
assert computed[1] == [0, 1, 0, 0, 0, 1]
assert np.linalg.norm(computed[2]) > 0.3
PROGRAM
