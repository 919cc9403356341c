"""Complete episodes in machine code: the whole rollout is one call.

``native_rollout`` is ``rollouts.vmap_rollout`` for CPUs and NVIDIA GPUs. Start states are drawn by
the same calls as everywhere, noise from the same keys, so the same key gives the same episodes, up
to rounding.
"""

import functools
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mjx_reinforce.engine import episode
from mjx_reinforce.engine.base import Act, Acts, Environment, PyTree, Trajectory
from mjx_reinforce.engine.contract import check_shape
from mjx_reinforce.engine.cpu import machine
from mjx_reinforce.engine.cpu import seam as cpu
from mjx_reinforce.engine.gpu import cubin
from mjx_reinforce.engine.gpu import seam as gpu
from mjx_reinforce.engine.play import available, c_mujoco
from mjx_reinforce.engine.play.counter import key_of_words
from mjx_reinforce.engine.play.program import (
    NativeProgram,
    build_program,
    machine_map,
    name_of,
    refusal,
    stored,
)
from mjx_reinforce.engine.scalar import TooLarge, UnsupportedPrimitive

_REMEDY = f'make keys with jax.random.key(seed, impl="{available.GENERATOR}"), or choose auto'


def native_rollout(
    env: Environment,
    act: Act,
    actor: PyTree,
    distribution: Acts,
    key: jax.Array,
    *,
    num_episodes: int,
    horizon: int,
    deterministic: bool | jax.Array = False,
    active: bool | jax.Array = True,
    limit: int | jax.Array | None = None,
    threads: int = 0,
) -> Trajectory:
    """Plays N episodes from fresh resets, as ``rollouts.vmap_rollout`` does.

    Vmapped over seeds it remains one call, in which no lane waits for another: an episode that is
    over makes room for the next, of whatever seed. One that is not played takes no lane.

    At most ``threads`` threads play; 0 stands for all that XLA has.

    Raises:
      ValueError: machine code cannot play this; see ``unsupported``.
    """
    if limit is None:
        limit = horizon
    episode.check_each(num_episodes, deterministic=deterministic, active=active, limit=limit)
    check_shape("threads", threads, ())
    if reason := against_key(key):
        raise ValueError(f"the native engine cannot play this: {reason}; {_REMEDY}")
    try:
        program = build_program(env, act, actor, distribution, episode.chunk_length(horizon))
    except (TooLarge, UnsupportedPrimitive) as error:
        raise ValueError(f"the native engine cannot play this: {error}") from error
    state, keys = _begin(env, program, episode.episode_keys(key, num_episodes))
    limits = episode.signed_limits(active, deterministic, jnp.minimum(limit, horizon))
    limits = jnp.broadcast_to(limits, num_episodes)
    words = jax.random.key_data(keys)
    # Empty leaves have no buffer: the kernels count buffers, see ``kernel.queue_text``.
    parameters = [x.reshape(-1) for x in jax.tree.leaves(actor) if x.size]
    starts = [stored(x).reshape(num_episodes, -1) for x in jax.tree.leaves(state) if x.size]
    if isinstance(program.code, machine.Code):
        shapes = _result_shapes(program, horizon, num_episodes)
        num_threads = jnp.int32(threads)
        outputs = cpu.call(program.code, shapes, limits, num_threads, words, *parameters, *starts)
    else:
        outputs = gpu.launch(
            program.code, program.record, horizon, limits, words, *parameters, *starts
        )
    return _trajectory(program, outputs, horizon, num_episodes)


def _trajectory(
    program: NativeProgram, outputs: Sequence[jax.Array], horizon: int, num_episodes: int
) -> Trajectory:
    """Returns the episodes that a call has recorded."""
    observation, action, rewards, length, is_broken, simulated = outputs
    num_rewards = 1 + len(program.terms)
    if program.episodes_last:  # [T, numbers, N]
        observation, action = (jnp.swapaxes(x, 1, 2) for x in (observation, action))
        rewards = rewards.reshape(horizon, num_rewards, num_episodes)
        reward, *term_rewards = jnp.unstack(rewards, axis=1)
    else:
        rewards = rewards.reshape(horizon, num_episodes, num_rewards)
        reward, *term_rewards = jnp.unstack(rewards, axis=-1)
    return Trajectory(
        observation=observation,
        action=action.reshape(horizon, num_episodes, *program.record[1].shape),
        reward=reward,
        mask=jnp.arange(horizon)[:, None] < length,
        nonfinite=is_broken != 0,
        simulated=simulated,
        terms=dict(zip(program.terms, term_rewards, strict=True)),
    )


def _begin(env: Environment, program: NativeProgram, keys: jax.Array) -> tuple[Any, jax.Array]:
    """Returns the starts of episodes by their keys [N], and the keys [N] of their noise."""
    vmap_begin = jax.vmap(functools.partial(episode.begin, env))
    has_team = program.episodes_last
    if isinstance(program.code, cubin.Kernel):
        has_team = program.code.launch.lanes > 1
    if not has_team and not _settles(env):
        return vmap_begin(keys)

    # Teams of lanes start a large model, too: in XLA's reset its sums would be atomic on a GPU, and
    # their bits would differ from run to run. A start that settles is as long as many env steps.
    def begin(words: jax.Array) -> tuple[Any, jax.Array]:
        state, noise_key = episode.begin(env, key_of_words(words))
        return state, jax.random.key_data(noise_key)

    words = jax.random.key_data(keys)
    try:
        native_begin = machine_map(begin, words[0], env=env, name=f"the start of {name_of(env)}")
    except (TooLarge, UnsupportedPrimitive, TypeError):
        return vmap_begin(keys)
    state, noise_words = native_begin(words)
    return state, jax.random.wrap_key_data(noise_words)


def _settles(env: Any) -> bool:
    """Returns whether an environment makes physics steps before an episode begins."""
    return getattr(c_mujoco.innermost(env), "settle_steps", 0) > 0


def against_key(key: jax.Array) -> str | None:
    """Returns why machine code cannot play from a key, or None: its noise is threefry2x32's."""
    implementation = str(jax.random.key_impl(key))
    if implementation == available.GENERATOR:
        return None
    return f"it draws noise as {available.GENERATOR} does, and the key is of {implementation}"


def unsupported(
    env: Environment, act: Act, actor: PyTree, distribution: Acts, horizon: int
) -> str | None:
    """Returns why machine code cannot play this here, or None; it is compiled if it can."""
    if reason := available.unavailable():
        return reason
    try:
        build_program(env, act, actor, distribution, episode.chunk_length(horizon))
    except Exception as error:  # whatever it is, another engine may play this
        return refusal(error)
    return None


def _result_shapes(
    program: NativeProgram, horizon: int, num_episodes: int
) -> list[jax.ShapeDtypeStruct]:
    """Returns the shapes of what a call returns; see ``handler.handler_text``."""
    shape = jax.ShapeDtypeStruct
    observation, action, reward = program.record
    sizes = [int(np.prod(x.shape, dtype=int)) for x in program.record]
    # The axes of an observation or an action beside those of steps.
    rows = [(size, num_episodes)[:: 1 if program.episodes_last else -1] for size in sizes]
    num_rewards = sizes[2]
    flags = shape((num_episodes,), jnp.int32)
    return [
        shape((horizon, *rows[0]), observation.dtype),
        shape((horizon, *rows[1]), action.dtype),
        # Of two axes: the handler reads T from it.
        shape((horizon, num_episodes * num_rewards), reward.dtype),
        flags,
        flags,
        shape((), jnp.int32),
    ]
