#!/usr/bin/env bash
# playground 0.2.0 with brax 0.14.2: PandaPickCube pays for the box near its target only once the gripper
# has been at the box, which it notes in info["reached_box"]. The wrapper that Playground trains with
# begins each episode at the first state, but leaves info as it was. So an environment whose gripper has
# been at the box once pays for the rest of the training. Here three episodes begin at the same state: the
# arm stands still, goes to the box, and stands still again. The first and the third have the same
# observations, bit for bit, but the third returns 1.8 times as much. So training pays for what evaluation,
# which resets, does not pay for, and no observation tells the two apart. PandaOpenCabinet has such a
# note, too; PandaPickCubeCartesian clears its own.
# Playground downloads the arm's file elsewhere; slides with the names of its joints stand for it here.
# With the arm itself, standing still for the 150 steps of an episode returned 120, and then 205.
# Seen with: mujoco 4.0.0, mujoco-mjx 3.17.0, jax 0.10.2, Python 3.11. Fails if that changes.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet playground==0.2.0 brax==0.14.2 mujoco==4.0.0 mujoco-mjx==3.17.0 \
  jax==0.10.2 jaxlib==0.10.2
JAX_PLATFORMS=cpu "$folder/venv/bin/python" - <<'PROGRAM'
import jax
import jax.numpy as jnp
from mujoco_playground import wrapper
from mujoco_playground._src import mjx_env
from mujoco_playground._src.manipulation.franka_emika_panda import pick

LENGTH = 80
AXES = ("1 0 0", "0 1 0", "0 0 1")
SLIDE = '<joint name="{}" type="slide" axis="{}" damping="200" armature="1"/>'
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
envs = wrapper.wrap_for_brax_training(env, episode_length=LENGTH)
step = jax.jit(envs.step)


def episode(state, speed):
    """Returns the state after an episode, its observations, and its return; speed 0 stands still."""
    observations, rewards = [], []
    for _ in range(LENGTH):
        way = state.data.xpos[0, env._obj_body] - state.data.site_xpos[0, env._gripper_site]
        action = jnp.zeros((1, envs.action_size)).at[0, :3].set(jnp.clip(speed * way, -1, 1))
        observations.append(state.obs)
        state = step(state, action)
        rewards.append(float(state.reward[0]))
    assert state.done[0] == 1 and state.info["truncation"][0] == 1
    return state, jnp.stack(observations), sum(rewards)


state = jax.jit(envs.reset)(jax.random.split(jax.random.PRNGKey(1), 1))
state, first_observations, first_return = episode(state, speed=0)
state, _, _ = episode(state, speed=2.5)
state, third_observations, third_return = episode(state, speed=0)
print(f"returns of standing still: {first_return:.1f}, after the box was reached: {third_return:.1f}")
assert (first_observations == third_observations).all()
assert third_return > 1.5 * first_return
PROGRAM
