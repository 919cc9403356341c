"""Complete episodes in one GPU kernel: each thread plays one, its state in registers.

`rollout` is `rollouts.rollout` for NVIDIA GPUs. One step of one episode (policy, sampling, physics,
reward, end of the episode) is written out in scalars by `fused.scalarize`, and one Pallas kernel
repeats it for a chunk of steps. Only what a `Trajectory` records is written to memory. Start states
and noise are drawn outside by the same calls as everywhere, so the same key gives the same
episodes, up to rounding.
"""

import functools
from typing import Any

import jax
import jax.numpy as jnp
from flax import linen as nn
from jax.experimental import pallas as pl

from mjx_reinforce.engines import episode
from mjx_reinforce.engines.chunks import chunk_length, play_chunks
from mjx_reinforce.engines.pallas_block import BLOCK, WARP, Progress, chunk_player, record_shapes
from mjx_reinforce.engines.unit_by_unit import unit_by_unit
from mjx_reinforce.fused import UnsupportedPrimitive, scalarized
from mjx_reinforce.policies.distribution import Distribution
from mjx_reinforce.types import Environment, Trajectory

#: A step of more scalar operations than this compiles for minutes and spills its registers.
MAX_OPERATIONS = 20_000
#: Branches are computed, not skipped: a block has some lane that needs them soon enough, and the
#: branch alone costs registers.
_BRANCH_COST = 10_000
#: Loops stay loops: a compiler takes more than twice as long for twice the straight code.
_UNROLLED = 1
_DTYPES = (jnp.float32, jnp.int32)


def rollout(
    env: Environment,
    act: episode.Act,
    actor: Any,
    distribution: Distribution,
    key: jax.Array,
    *,
    num_episodes: int,
    horizon: int,
    num_deterministic: int = 0,
    active: bool | jax.Array = True,
    interpret: bool = False,
) -> Trajectory:
    """Plays N episodes from fresh resets; arguments and result are those of `rollouts.rollout`.

    A block of episodes that are all over costs no more than writing zeros, and chunks of steps
    that no episode needs are not played. ``interpret`` runs the kernel as ordinary JAX, on any
    platform, for tests.

    Raises:
      ValueError: the kernel cannot hold this environment and policy; see ``unsupported``.
    """
    reason = _unsupported_state(env)
    if reason:
        raise ValueError(f"the kernel engine cannot play this: {reason}")
    block = min(BLOCK, max(WARP, pl.next_power_of_2(num_episodes)))
    episodes = jnp.arange(pl.cdiv(num_episodes, block) * block)
    begin = functools.partial(episode.begin, env, key)
    state, noise_keys = jax.vmap(begin, out_axes=(-1, 0))(episodes)
    step = _write_out(env, act, actor, distribution)
    none = jnp.zeros(episodes.size, jnp.int32)
    progress = Progress(
        state=[x.reshape(-1, episodes.size) for x in jax.tree.leaves(state)],
        alive=((episodes < num_episodes) & active).astype(jnp.int32),
        steps=none,
        nonfinite=none,
    )
    shapes = record_shapes(step, horizon, episodes.size)
    length = chunk_length(horizon)
    progress, records, simulated = play_chunks(
        chunk_player(step, actor, length, block, num_deterministic, interpret),
        distribution,
        noise_keys,
        progress,
        [jnp.zeros(x.shape, x.dtype) for x in shapes],
        episode_axis=-1,
    )
    observation, action, reward = (x[..., :num_episodes] for x in records)
    return Trajectory(
        observation=jnp.swapaxes(observation, 1, 2),
        action=jnp.moveaxis(action.reshape(horizon, *step.out_avals[1].shape, num_episodes), -1, 1),
        reward=reward[:, 0],
        mask=jnp.arange(horizon)[:, None] < progress.steps[:num_episodes],
        nonfinite=progress.nonfinite[:num_episodes] != 0,
        simulated=simulated,
    )


def unsupported(
    env: Environment, act: episode.Act, actor: Any, distribution: Distribution
) -> str | None:
    """Returns why the kernel cannot play this, or None; nothing is simulated or compiled."""
    reason = _unsupported_state(env)
    if reason:
        return reason
    try:
        written = _write_out(env, act, actor, distribution)
    except UnsupportedPrimitive as error:
        return str(error)
    if written.captures:
        return "the environment or the policy holds a value that JAX is tracing, as under jax.vmap"
    operations = sum(written.operations.values())
    if operations > MAX_OPERATIONS:
        return f"one step takes {operations} scalar operations, more than {MAX_OPERATIONS}"
    return None


def _unsupported_state(env: Environment) -> str | None:
    """Returns which entry of the environment's state does not fit into registers, if any."""
    state = jax.eval_shape(env.reset, jax.random.key(0))
    for path, leaf in jax.tree_util.tree_leaves_with_path(state):
        if leaf.dtype not in _DTYPES or not leaf.size:
            name = jax.tree_util.keystr(path)
            return f"its state{name} is {leaf.dtype}{list(leaf.shape)}, not float32 or int32"
    return None


def _write_out(
    env: Environment, act: episode.Act, actor: Any, distribution: Distribution
) -> scalarized.Scalarized:
    """Writes one step of one episode out in scalars; the actor is shared by all episodes."""

    def step(actor, state, noise, deterministic, alive):
        with nn.intercept_methods(unit_by_unit):
            return episode.step(
                env.step, act, distribution, actor, state, noise, alive, deterministic
            )

    flag = jax.ShapeDtypeStruct((), bool)
    state = jax.eval_shape(env.reset, jax.random.key(0))
    noise = jax.eval_shape(lambda: distribution.noise(jax.random.key(0), ()))
    actor = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), actor)
    examples = (actor, state, noise, flag, flag)
    num_leaves = len(jax.tree.leaves(examples))
    num_shared = len(jax.tree.leaves(actor))
    varying = [number >= num_shared for number in range(num_leaves)]
    return scalarized.build(step, examples, varying, _BRANCH_COST, _UNROLLED)
