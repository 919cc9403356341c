"""Our environments in rejax, which maps the step of one environment by ``jax.vmap``.

    pip install rejax gymnax==0.0.9
    python with_rejax.py    # PPO on HalfCheetah, a million env steps

``make_vec(task, 1)``, mapped over N, is one call for all of them, so nothing of rejax is changed.
"""

from typing import Any

import jax
from rejax import PPO  # pyright: ignore[reportMissingImports]
from rejax.compat.brax2gymnax import Brax2GymnaxEnv  # pyright: ignore[reportMissingImports]

from mjx_reinforce import make_vec
from mjx_reinforce.engine.vector.for_brax import BraxVectorEnv


class OneOfMany(Brax2GymnaxEnv):
    """One environment as rejax takes it; mapped over N, its step is one call for all N."""

    def __init__(self, task: str):
        """Takes an id of ours whose actions have bounds."""
        self.env = BraxVectorEnv(make_vec(task, 1, autoreset="same_step"))
        self.max_steps_in_episode = self.env.vec.max_episode_steps

    def reset(self, key: jax.Array, params: Any = None) -> tuple[jax.Array, Any]:
        """Begins an episode; returns its observation [O] and state."""
        state: Any = self.env.reset(key)
        return state.obs[0], state

    def step(
        self, key: jax.Array, state: Any, action: jax.Array, params: Any = None
    ) -> tuple[jax.Array, Any, jax.Array, jax.Array, dict[str, Any]]:
        """Plays a step with an action [A] from -1 to 1; one that ends an episode resets."""
        state = self.env.step(state, action[None])
        return state.obs[0], state, state.reward[0], state.done[0] != 0, {}


if __name__ == "__main__":
    env = OneOfMany("HalfCheetah-v5")
    program = PPO.create(env=env, num_envs=32, num_steps=64, num_epochs=2, num_minibatches=2)
    jax.block_until_ready(jax.jit(program.train)(jax.random.PRNGKey(0)))
