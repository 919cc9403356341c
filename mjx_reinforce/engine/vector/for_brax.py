"""The environments under brax's interface: what its PPO and SAC, and rejax, train on."""

from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
from brax.envs.base import Env, State, Wrapper

from mjx_reinforce.engine.base import Box, Discrete, Environment
from mjx_reinforce.engine.checks import check_key, check_name
from mjx_reinforce.engine.contract import check_shape, in_words
from mjx_reinforce.engine.vector.environment import VectorState, make_vec


class BraxVectorWrapper(Wrapper):
    """An environment whose batches step in one call; what ``envs.for_brax`` returns.

    ``reset`` and ``step`` play as many as there are keys; without resets of its own, also one.
    ``pipeline_state`` is a ``VectorState``. Other attributes are those of the environment.

    vec: the engine, for one environment
    episode_length: the time limit in steps, None for none
    """

    def __init__(
        self, env: Environment, episode_length: int | None, autoreset: str, engine: str
    ) -> None:
        """Compiles the step; the arguments are those of ``envs.for_brax``."""
        check_name("autoreset", str(autoreset), dict.fromkeys(("same_step", "disabled")))
        super().__init__(cast(Env, env))
        options: Any = {"autoreset": autoreset, "max_episode_steps": episode_length}
        # Under ``jax.vmap``, a step is one call for all environments.
        self.vec = make_vec(env, 1, engine=engine, **options)
        self.episode_length = self.vec.max_episode_steps
        if isinstance(self.vec.action_space, Discrete):
            raise ValueError(
                f"the actions of brax's trainers are continuous, and {type(env).__name__} has "
                f"{self.vec.action_space.num_actions} discrete ones"
            )

    @property
    def observation_size(self) -> int:
        """O."""
        return self.vec.observation_size

    def reset(self, rng: jax.Array) -> State:
        """Returns environments at the start of an episode.

        Args:
          rng: [N] keys, also as words [N, 2], or a key; consumed.

        Raises:
          ValueError: it is no key, keys of more axes, or one alone with autoreset "same_step".
        """
        check_key(rng)
        if not jnp.issubdtype(rng.dtype, jax.dtypes.prng_key):
            rng = jax.random.wrap_key_data(rng)
        if rng.ndim > 1:
            raise ValueError(f"the keys must be [] or [N], got {in_words(rng)}")
        # Wrappers of brax, which map one, would take our time limit for an end by the task.
        if rng.ndim == 0 and self.vec.autoreset == "same_step":
            raise ValueError(
                "reset takes a key for each environment, got one: brax's wrappers have no place "
                "here; write ppo.train(env, wrap_env_fn=envs.for_brax, ...) with the task as env"
            )

        def begin(key: jax.Array) -> VectorState:
            return _single(self.vec.reset(key[None]))

        state = (jax.vmap(begin) if rng.ndim else begin)(rng)
        sums = jax.tree.map(jnp.zeros_like, state.metrics)
        return _as_brax(state, sums, {})

    def step(self, state: State, action: jax.Array) -> State:
        """Returns the environments one step later.

        Args:
          state: of ``reset`` or ``step``.
          action: [A] or [N, A]. An entry with bounds has them at -1 and 1; others are as they are.

        Raises:
          ValueError: the state is not of this environment, or the actions have another shape.
        """

        def play(state: VectorState, action: jax.Array) -> VectorState:
            return _single(self.vec.step(jax.tree.map(lambda x: x[None], state), action[None]))

        before = getattr(state, "pipeline_state", None)
        if not isinstance(before, VectorState):
            raise ValueError(f"the state must be of reset or step, got {in_words(state)}")
        check_shape("the actions", action, (*before.done.shape, self.vec.action_size))
        advance = jax.vmap(play) if before.done.ndim else play
        after = advance(before, _controls(cast(Box, self.vec.action_space), action))
        sums = {
            name: jnp.where(before.done, 0, state.info["episode_metrics"][name]) + x
            for name, x in after.metrics.items()
        }
        return _as_brax(after, sums, state.info)


def _single(state: VectorState) -> VectorState:
    """Returns the one environment of a batch, without its axis."""
    return jax.tree.map(lambda x: x[0], state)


def _controls(space: Box, action: jax.Array) -> jax.Array:
    """Returns actions [..., A] of a space, of what covers its bounds from -1 to 1."""
    is_bounded = np.isfinite(space.low) & np.isfinite(space.high)
    dtype = jnp.result_type(action, float)
    low = jnp.asarray(np.where(is_bounded, space.low, -1), dtype)
    high = jnp.asarray(np.where(is_bounded, space.high, 1), dtype)
    return jnp.where(is_bounded, low + (action + 1) / 2 * (high - low), action)


def _as_brax(state: VectorState, sums: dict[str, jax.Array], info: dict[str, Any]) -> State:
    """Returns environments with the entries that brax's ``EpisodeWrapper`` has.

    Args:
      state: one environment, or many.
      sums: the metrics, summed over the episode so far.
      info: what else is known, such as the entries of other wrappers.
    """
    dtype = state.reward.dtype
    done = state.done.astype(dtype)
    steps = state.episode_length.astype(dtype)
    truncation = (state.truncated & ~state.terminated).astype(dtype)
    totals = {"sum_reward": state.episode_return, "length": steps}
    entries = {
        "steps": steps,
        "truncation": truncation,
        "time_out": truncation,  # of ``bootstrap_on_timeout``
        "episode_done": done,
        "episode_metrics": sums | totals,
    }
    simulation: Any = state
    # brax's wrappers write into both dicts.
    return State(simulation, state.obs, state.reward, done, dict(state.metrics), info | entries)
