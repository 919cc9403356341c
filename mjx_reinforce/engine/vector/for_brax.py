"""The environments as brax's trainers take them: batched, with actions from -1 to 1.

    from brax.training.agents.ppo import train as ppo
    import mjx_reinforce
    from mjx_reinforce.engine.vector.for_brax import BraxVectorEnv
    env = BraxVectorEnv(mjx_reinforce.make_vec("HalfCheetah-v5", 2048, autoreset="same_step"))
    ppo.train(env, num_envs=2048, num_eval_envs=2048, wrap_env=False, episode_length=1000, ...)

brax's trainers must not wrap them, and evaluate on as many as they train on.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from brax.envs.base import Env, State

from mjx_reinforce.engine.base import Box
from mjx_reinforce.engine.vector.environment import VectorEnv, VectorState


class BraxVectorEnv(Env):
    """N environments whose step is one call, and what brax's own wrappers tell.

    Each begins its next episode in the step that ends one, from a new start; brax's
    ``AutoResetWrapper`` goes back to the first one.

    vec: the same environments in JAX
    """

    def __init__(self, vec: VectorEnv):
        """Takes environments with ``autoreset="same_step"``.

        Raises:
          ValueError: the actions have no bounds, or ``autoreset`` is another.
        """
        if vec.autoreset != "same_step":
            raise ValueError(f"autoreset must be 'same_step' for brax, got {vec.autoreset!r}")
        space = vec.action_space
        if not isinstance(space, Box) or not np.all(np.isfinite([space.low, space.high])):
            raise ValueError(f"actions must have bounds for brax's policies, got {space}")
        self.vec = vec
        self._low, self._width = jnp.asarray(space.low), jnp.asarray(space.high - space.low)

    def reset(self, rng: jax.Array) -> State:
        """Begins N episodes from a key [], or one each [N]."""
        return self._state(self.vec.reset(rng))

    def step(self, state: State, action: jax.Array) -> State:
        """Plays a step with actions [N, A] from -1 to 1."""
        vector: Any = state.pipeline_state
        action = self._low + (action + 1) / 2 * self._width
        return self._state(self.vec.step(vector, action))

    @property
    def observation_size(self) -> int:
        """The size of an observation."""
        return self.vec.observation_size

    @property
    def action_size(self) -> int:
        """The size of an action."""
        return self.vec.action_size

    @property
    def backend(self) -> str:
        """The simulator, which brax asks for."""
        return "mjx"

    def _state(self, vector: VectorState) -> State:
        number = vector.reward.dtype
        done, steps = vector.done.astype(number), vector.episode_length.astype(number)
        info = {
            "steps": steps,
            "truncation": (vector.truncated & ~vector.terminated).astype(number),
            "episode_done": done,
            "episode_metrics": {"sum_reward": vector.episode_return, "length": steps},
        }
        kept: Any = vector  # brax only passes it on
        return State(kept, vector.obs, vector.reward, done, dict(vector.metrics), info)
