"""N environments in JAX, whose step is one call.

How the episodes of one of them follow each other is as Gymnasium 1.x defines it. The reset of an
episode draws from the environment's own key alone, so what one plays does not depend on N.
"""

import enum
import functools
from collections.abc import Callable, Mapping
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.typing import ArrayLike

from mjx_reinforce.engine import episode
from mjx_reinforce.engine.base import (
    Arrays,
    Box,
    Discrete,
    Environment,
    PyTree,
    action_space,
    null_action,
    shapes,
)
from mjx_reinforce.engine.checks import check_count, check_key, check_name, check_type
from mjx_reinforce.engine.contract import check_environment, check_shape
from mjx_reinforce.engine.memory import gigabytes, host_memory
from mjx_reinforce.engine.play.available import GENERATOR
from mjx_reinforce.engine.play.choice import (
    MapEngine,
    environment_of,
    instead_of_vmap,
    map_function,
    teams_may_play,
)
from mjx_reinforce.engine.play.counter import key_of_words

#: When an environment whose episode has ended begins the next (Gymnasium's ``AutoresetMode``).
AUTORESETS = ("next_step", "same_step", "disabled")


class VectorState(Arrays):
    """N environments.

    Attributes:
      simulation: the environments' own states, N first
      reward: [N] what the last action earned; 0 where it broke, and after a reset
      terminated: [N] bool, whether the task ended the episode by it
      truncated: [N] bool, whether the time limit did
      nonfinite: [N] bool, whether it left the finite numbers, which terminates the episode
      final_obs: [N, O] what it led to, before any reset
      metrics: [N] each, the terms of its reward and what else the task tells, by name
      episode_return: [N] the rewards of the episode so far; all of them where it has just ended
      episode_length: [N] int32, its steps so far; all of them where it has just ended
      keys: [N, 2] uint32, what the next resets draw from

    Examples:
      >>> import jax
      >>> import mjx_reinforce as mr
      >>> vec = mr.make_vec("CartPole-v1", num_envs=8)
      >>> state = vec.reset(jax.random.key(0))
      >>> state = vec.step(state, vec.sample_actions(jax.random.key(1)))
      >>> state.obs.shape, state.reward.tolist()[:2]
      ((8, 4), [1.0, 1.0])
    """

    simulation: Any
    reward: jax.Array
    terminated: jax.Array
    truncated: jax.Array
    nonfinite: jax.Array
    final_obs: jax.Array
    metrics: dict[str, jax.Array]
    episode_return: jax.Array
    episode_length: jax.Array
    keys: jax.Array

    @property
    def obs(self) -> jax.Array:
        """What the next action is chosen by [N, O]; where ``same_step`` has reset, a new start."""
        return self.simulation.obs

    @property
    def done(self) -> jax.Array:
        """Whether the episode has ended [N], for one reason or the other."""
        return self.terminated | self.truncated


def blank(env: Environment) -> VectorState:
    """Returns the shapes of one environment's entry of a ``VectorState``."""
    return shapes(functools.partial(_begin, env), jax.ShapeDtypeStruct((2,), jnp.uint32))


def advance_function(env: Environment, limit: int | None, autoreset: str) -> Callable[..., Any]:
    """Returns (state, action, begins []) -> state of one environment.

    Where ``begins`` is true it only resets.

    Args:
      env: what is played.
      limit: the steps after which an episode is truncated; None never does.
      autoreset: one of ``AUTORESETS``.
    """

    def advance(state: VectorState, action: PyTree, is_start: jax.Array) -> VectorState:
        """Plays a step or begins an episode; with ``same_step`` it does both where one ends."""
        if autoreset == "same_step":
            step = _play(env, limit, state, action, ~is_start)
            resets = is_start | step.done
            start = lax.cond(resets, lambda: _begin(env, state.keys, resets), lambda: step)
            # Reward, flags and the last observation stay those of the step that ended the episode.
            start_state = step.replace(simulation=start.simulation, keys=start.keys)
            return jax.tree.map(lambda x, y: jnp.where(is_start, x, y), start, start_state)
        resets = is_start | (state.done if autoreset == "next_step" else False)
        return lax.cond(
            resets,
            lambda: _begin(env, state.keys, resets),
            lambda: _play(env, limit, state, action, ~resets),
        )

    return advance


def _begin(env: Environment, keys: jax.Array, is_used: bool | jax.Array = True) -> VectorState:
    """Returns an environment at the start of its next episode.

    Args:
      env: what is played.
      keys: as of ``VectorState``.
      is_used: [] whether the result is used. Mapped over environments, both sides of a condition
        are computed; an environment with a ``reset_where`` computes no more than it must.
    """
    key, reset_key = jax.random.split(key_of_words(keys))
    if hasattr(type(env), "reset_where"):
        start = cast(Any, env).reset_where(reset_key, jnp.asarray(is_used))
    else:
        start = env.reset(reset_key)
    is_done = jnp.zeros((), bool)
    zero = jnp.zeros_like(start.reward)
    return VectorState(
        simulation=start,
        reward=zero,
        terminated=is_done,
        truncated=is_done,
        nonfinite=is_done,
        final_obs=start.obs,
        metrics=dict(getattr(start, "metrics", {})),
        episode_return=zero,
        episode_length=jnp.zeros((), jnp.int32),
        keys=jax.random.key_data(key),
    )


def _play(
    env: Environment, limit: int | None, state: VectorState, action: PyTree, is_used: jax.Array
) -> VectorState:
    """Returns an environment one step later; an episode that is over begins to count again.

    ``is_used`` [] is as of ``_begin``.
    """
    is_over = state.done
    if hasattr(type(env), "step_where"):
        simulation = cast(Any, env).step_where(state.simulation, action, is_used)
    else:
        simulation = env.step(state.simulation, action)
    is_finite = jnp.all(jnp.isfinite(simulation.obs)) & jnp.isfinite(simulation.reward)
    is_finite &= jnp.isfinite(simulation.done)
    reward = jnp.where(is_finite, simulation.reward, 0)
    length = jnp.where(is_over, 0, state.episode_length) + 1
    # ``done`` of a time limit of the environment's own is no termination; of the task's it is one,
    # also where that comes with the last step of ``limit``.
    own_limit = _time_is_up(simulation)
    truncated = own_limit
    if limit is not None:
        truncated |= length >= limit
    return VectorState(
        simulation=simulation,
        reward=reward,
        terminated=((simulation.done != 0) & ~own_limit) | ~is_finite,
        truncated=truncated,
        nonfinite=~is_finite,
        final_obs=simulation.obs,
        metrics=dict(getattr(simulation, "metrics", {})),
        episode_return=jnp.where(is_over, 0, state.episode_return) + reward,
        episode_length=length,
        keys=state.keys,
    )


def _time_is_up(state: Any) -> jax.Array:
    """Returns whether an environment ended its episode [] by a time limit of its own.

    brax's and Playground's ``EpisodeWrapper`` set ``done`` then, and tell why.
    """
    info = getattr(state, "info", None)
    truncation = 0
    if isinstance(info, Mapping):
        truncation = info.get("truncation", 0)
    return jnp.asarray(truncation) != 0


#: Copies of the states that a step has in memory: 4.6 of HalfCheetah, a million of them.
_STATE_COPIES = 5


class VectorEnv:
    """N environments; what ``make_vec`` returns.

    ``reset`` and ``step`` are pure functions of arrays: call them under ``jax.jit``, ``jax.vmap``
    and in ``lax.scan``, and donate the state. They are not differentiated.

    Attributes:
      env: the environment of which there are N
      num_envs: N
      autoreset: when the next episode begins: "next_step", "same_step" or "disabled"
      max_episode_steps: the time limit in steps, which truncates an episode; None for none
      observation_size: O
      action_size: A
      action_space: a ``Box`` or ``Discrete`` of one environment
      engine: how the step is mapped: ``name``, and ``why``

    Examples:
      >>> import jax
      >>> import mjx_reinforce as mr
      >>> vec = mr.make_vec("CartPole-v1", num_envs=8)
      >>> state = vec.reset(jax.random.key(0))
      >>> state = vec.step(state, vec.sample_actions(jax.random.key(1)))
      >>> state.obs.shape, state.reward.tolist()[:2]
      ((8, 4), [1.0, 1.0])
    """

    def __init__(
        self,
        env: Environment,
        num_envs: int,
        autoreset: str,
        max_episode_steps: int | None,
        engine: str,
    ):
        """Compiles the step; the arguments are those of ``make_vec``."""
        self.env = env
        self.num_envs = num_envs
        self.autoreset = autoreset
        self.max_episode_steps = max_episode_steps
        self.action_space: Box | Discrete = action_space(env)
        # What is continuous is in JAX's precision, float64 where ``jax_enable_x64`` is set.
        zeros = null_action(env)
        dtype = jnp.result_type(float) if zeros.ndim else zeros.dtype
        self._null_action = np.asarray(zeros, dtype)
        self.action_size = env.action_size
        is_for_teams = teams_may_play(engine, env)
        task, reason = (env, None) if is_for_teams else environment_of(engine, env)
        self.engine = self._engine(engine, task, reason)
        if engine == "auto" and self.engine.name == "vmap":
            in_c = instead_of_vmap(env, self.engine.why)
            if in_c is not None:
                self.engine = self._engine(engine, *in_c)
        self._call = jax.jit(self.engine.call)

    def _engine(self, name: str, task: Environment, reason_for_c: str | None) -> MapEngine:
        """Returns what steps the environments, and takes their structure from the task.

        Args:
          name: of the engine.
          task: what the environments are.
          reason_for_c: why C MuJoCo computes the task's physics; None if it does not.
        """
        self._blank = blank(task)
        self.observation_size = int(self._blank.final_obs.shape[0])
        # Before the step is compiled, which takes seconds to minutes.
        self._check_memory()
        advance = advance_function(task, self.max_episode_steps, self.autoreset)
        if reason_for_c is not None:
            return MapEngine("mujoco", reason_for_c, jax.vmap(advance))
        flag = jax.ShapeDtypeStruct((), bool)
        return map_function(name, task, advance, self._blank, self._null_action, flag)

    def reset(self, key: jax.Array) -> VectorState:
        """Returns N environments at the start of their first episodes.

        Args:
          key: consumed; [] and that of environment i is this one folded with i, or [N] their own.

        Raises:
          ValueError: it is no key, or of another generator than JAX's default.
        """
        check_key(key)
        if not jnp.issubdtype(key.dtype, jax.dtypes.prng_key):
            key = jax.random.wrap_key_data(key)
        generator = str(jax.random.key_impl(key))
        if generator != GENERATOR:
            raise ValueError(
                f"the key is of the generator {generator}; make it with "
                f'jax.random.key(seed, impl="{GENERATOR}")'
            )
        words = jax.random.key_data(episode.episode_keys(key, self.num_envs))
        # A reset is the step of a blank state that all environments begin in: one program for both,
        # which is compiled once.
        zeros = jax.tree.map(lambda x: jnp.zeros((self.num_envs, *x.shape), x.dtype), self._blank)
        return self._advance(zeros.replace(keys=words), self._null_actions(), True)

    def step(self, state: VectorState, action: jax.Array) -> VectorState:
        """Returns the environments one step later.

        With "next_step", an environment whose episode has ended ignores its action and begins the
        next one, with reward 0. With "same_step" it has begun it in the step that ended the last.

        Args:
          state: of ``reset`` or ``step``.
          action: [N, A], or int [N] if discrete. It is not clipped: MuJoCo clamps what actuators
            get, and the reward is of what was asked for, as in Gymnasium.

        Raises:
          ValueError: the action has another shape or kind.
        """
        return self._advance(state, self._checked(action), False)

    def restart(self, state: VectorState, where: jax.Array) -> VectorState:
        """Returns the environments with new episodes where a mask [N] says so; others stay."""
        check_shape("the mask", where, (self.num_envs,))
        where = jnp.asarray(where, bool)
        # The others have taken a step in there, which is thrown away.
        new_state = self._advance(state, self._null_actions(), where)
        return jax.tree.map(
            lambda x, y: jnp.where(where.reshape(-1, *[1] * (x.ndim - 1)), x, y),
            new_state,
            state,
        )

    def sample_actions(self, key: jax.Array) -> jax.Array:
        """Returns random actions [N, A] or [N]: uniform, and normal where there is no bound."""
        check_key(key)
        space = self.action_space
        if isinstance(space, Discrete):
            return jax.random.randint(key, (self.num_envs,), 0, space.num_actions)
        shape = (self.num_envs, self.action_size)
        uniform_key, normal_key = jax.random.split(key)
        uniform = jax.random.uniform(uniform_key, shape)
        normal = jax.random.normal(normal_key, shape)
        # Unbounded entries are 0 to 1 here, so that nothing is computed with infinities; in the end
        # they are the normal ones.
        is_bounded = np.isfinite(space.low) & np.isfinite(space.high)
        low = np.where(is_bounded, space.low, 0)
        high = np.where(is_bounded, space.high, 1)
        box_actions = jnp.asarray(low) + uniform * (high - low)
        return jnp.where(is_bounded, box_actions, normal).astype(uniform.dtype)

    def check_state(self, state: object) -> None:
        """Raises ValueError for what is no state of these environments: machine code trusts it."""
        if not isinstance(state, VectorState):
            raise ValueError(
                f"the state must be what reset or step returned, got a {type(state).__name__}"
            )
        same_tree = jax.tree.structure(state) == jax.tree.structure(self._blank)
        pairs = zip(jax.tree.leaves(state), jax.tree.leaves(self._blank), strict=False)
        if not same_tree or any(
            jnp.shape(x) != (self.num_envs, *y.shape) or jnp.result_type(x) != y.dtype
            for x, y in pairs
        ):
            raise ValueError(f"the state is not of {self!r}, or was changed")

    def __repr__(self) -> str:
        return (
            f"VectorEnv({self.num_envs} x {self.env!r}, autoreset={self.autoreset}, "
            f"engine={self.engine.name})"
        )

    def _advance(self, state: VectorState, action: jax.Array, is_start: ArrayLike) -> VectorState:
        self.check_state(state)
        return self._call(state, action, jnp.broadcast_to(is_start, self.num_envs))

    def _null_actions(self) -> jax.Array:
        return jnp.zeros((self.num_envs, *self._null_action.shape), self._null_action.dtype)

    def _checked(self, action: ArrayLike) -> jax.Array:
        """Returns the actions, or raises ValueError where they are none."""
        check_shape("the actions", action, (self.num_envs, *self._null_action.shape))
        dtype = jnp.result_type(action)
        own_dtype = self._null_action.dtype
        if not jnp.can_cast(dtype, own_dtype, "same_kind"):
            raise ValueError(f"the actions must be {own_dtype}, got {dtype}")
        return jnp.asarray(action, own_dtype)

    def _check_memory(self) -> None:
        """Raises ValueError for more environments than there is memory for."""
        state_bytes = sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(self._blank))
        required_bytes = _STATE_COPIES * state_bytes * self.num_envs
        memory_bytes = _memory()
        if required_bytes > memory_bytes:
            raise ValueError(
                f"{self.num_envs:,} environments need {gigabytes(required_bytes)}, and there are "
                f"{gigabytes(memory_bytes)}; make at most "
                f"{int(memory_bytes / _STATE_COPIES / state_bytes):,}"
            )


def _memory() -> float:
    """Returns the bytes of memory of the device that JAX computes on."""
    # A CPU's devices have no statistics.
    stats = jax.devices()[0].memory_stats() or {}
    return float(stats.get("bytes_limit", host_memory()))


def make_vec(
    env: Environment,
    num_envs: int,
    *,
    autoreset: str | enum.Enum = "next_step",
    max_episode_steps: int | None = None,
    engine: str = "auto",
) -> VectorEnv:
    """Makes N environments that play at once, for any algorithm.

    Args:
      env: the environment; ``mjx_reinforce.make_vec`` takes an id too.
      num_envs: N.
      autoreset: when an environment whose episode has ended begins the next: "next_step" and
        "same_step" are Gymnasium's, whose ``AutoresetMode`` may be given; with "disabled" only
        ``restart`` does.
      max_episode_steps: the time limit in steps; by default the task's.
      engine: "auto", "native" (machine code), "vmap", or "mujoco" (C MuJoCo).

    Raises:
      ValueError: an argument makes no sense, the environment is none, or it does not fit in memory.

    Examples:
      >>> import mjx_reinforce as mr
      >>> mr.engine.make_vec(mr.envs.make("CartPole-v1"), num_envs=8)
      VectorEnv(8 x CartPole(), autoreset=next_step, engine=native)
    """
    check_count("num_envs", num_envs)
    mode = autoreset.name.lower() if isinstance(autoreset, enum.Enum) else autoreset
    check_name("autoreset", str(mode), dict.fromkeys(AUTORESETS))
    check_type("max_episode_steps", max_episode_steps, int | None)
    check_environment(env)
    if max_episode_steps is None:
        max_episode_steps = getattr(env, "max_episode_steps", None)
    else:
        check_count("max_episode_steps", max_episode_steps)
    return VectorEnv(env, num_envs, str(mode), max_episode_steps, engine)
