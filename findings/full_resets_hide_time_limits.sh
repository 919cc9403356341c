#!/usr/bin/env bash
# playground 0.2.0 with brax 0.14.2: wrap_for_brax_training(full_reset=True) begins each episode at a
# new state, and erases info["truncation"] while it does so, for all of info becomes that of the new
# episode. An episode that its time limit cut then looks as if the task had ended it: brax's PPO and
# SAC, which read this entry, learn that the future is worth nothing there. episode_done and
# episode_metrics of the episode are erased, too. With full_reset=False, the entries are right.
# Here each episode of CartpoleBalance is cut after 5 steps; the pole is still up.
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
from mujoco_playground._src.dm_control_suite import cartpole

config = cartpole.default_config()
config.impl = "jax"
balance = cartpole.Balance(swing_up=False, sparse=False, config=config)


def last(full_reset):
    """Returns done, truncation, episode_done, and the return, after the last step of an episode."""
    envs = wrapper.wrap_for_brax_training(balance, episode_length=5, full_reset=full_reset)
    state = jax.jit(envs.reset)(jax.random.split(jax.random.PRNGKey(0), 1))
    step = jax.jit(envs.step)
    for _ in range(5):
        state = step(state, jnp.zeros((1, envs.action_size)))
    info = state.info
    episode_return = info["episode_metrics"]["sum_reward"]
    values = (state.done, info["truncation"], info["episode_done"], episode_return)
    return [round(float(x[0]), 2) for x in values]


cached = last(False)
full = last(True)
print("done, truncation, episode_done, return:", cached, "with full_reset:", full)
assert cached[:3] == [1, 1, 1] and cached[3] > 4
assert full == [1, 0, 0, 0]
PROGRAM
