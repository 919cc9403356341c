"""Complete episodes in one GPU kernel: each thread plays one, its state in registers.

`rollout` is `rollouts.rollout` for NVIDIA GPUs. One step of one episode (policy, sampling, physics,
reward, end of the episode) is written out in scalars by `fused.scalarize`, and one Pallas kernel
repeats it for a chunk of steps. Only what a `Trajectory` records is written to memory. Start states
and noise are drawn outside by the same calls as everywhere, so the same key gives the same
episodes, up to rounding.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen as nn
from jax import lax
from jax.experimental import pallas as pl
from jax.experimental.pallas import triton as pltriton

from mjx_reinforce.engines.loops import largest_divisor, while_any
from mjx_reinforce.engines.rollouts import CHUNK_STEPS, begin, draw_noise
from mjx_reinforce.fused import UnsupportedPrimitive, scalarized
from mjx_reinforce.policies.distribution import Distribution
from mjx_reinforce.policies.networks import MLP
from mjx_reinforce.types import Environment, Trajectory

#: Episodes a block, one a thread.
BLOCK = 128
#: Threads that run in step on an NVIDIA GPU.
_WARP = 32
#: A step of more scalar operations than this compiles for minutes and spills its registers.
MAX_OPERATIONS = 20_000
#: Branches are computed, not skipped: a block has some lane that needs them soon enough, and the
#: branch alone costs registers.
_BRANCH_COST = 10_000

#: Loops stay loops: a compiler takes more than twice as long for twice the straight code.
_UNROLLED = 1

_DTYPES = (jnp.float32, jnp.int32)

Act = Callable[[Any, jax.Array], jax.Array]


class _Progress(NamedTuple):
    """Where the lanes are between two chunks.

    state: for each leaf of the environment's state, [size, lanes]
    alive: [lanes] 1 while the episode runs
    steps: [lanes] how many steps it took so far
    nonfinite: [lanes] 1 where the simulation left the finite numbers
    """

    state: list[Any]
    alive: Any
    steps: Any
    nonfinite: Any


def rollout(
    env: Environment,
    act: Act,
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
    """Plays N episodes from fresh resets; arguments and result as in `rollouts.rollout`.

    A block of episodes that are all over costs no more than writing zeros, and chunks of steps
    that no episode needs are not played.

    Args:
      env: what is played.
      act: (actor, observation [O]) -> outputs [K] of the distribution.
      actor: what ``act`` reads.
      distribution: what the outputs index.
      key: consumed.
      num_episodes: N.
      horizon: T, the time limit in steps.
      num_deterministic: how many episodes, the first ones, take the mode.
      active: [] False plays nothing, for a seed that stands still among others.
      interpret: run the kernel as ordinary JAX, on any platform; for tests.

    Raises:
      ValueError: the kernel cannot hold this environment and policy; see ``unsupported``.
    """
    reason = _unsupported_state(env)
    if reason:
        raise ValueError(f"the kernel engine cannot play this: {reason}")
    block = min(BLOCK, max(_WARP, pl.next_power_of_2(num_episodes)))
    episodes = jnp.arange(pl.cdiv(num_episodes, block) * block)
    state, noise_keys = jax.vmap(functools.partial(begin, env, key), out_axes=(-1, 0))(episodes)
    length = largest_divisor(horizon, CHUNK_STEPS)
    step = _write_out(env, act, actor, distribution)
    play = _chunk(step, actor, length, block, num_deterministic, interpret)

    def advance(carry):
        chunk, keys, progress, records = carry
        keys, noise = jax.vmap(
            functools.partial(draw_noise, distribution, length), out_axes=(0, -1)
        )(keys)
        progress, new = play(noise, progress)
        records = jax.tree.map(
            lambda old, x: lax.dynamic_update_slice_in_dim(old, x, chunk * length, 0), records, new
        )
        return chunk + 1, keys, progress, records

    def unfinished(carry):
        chunk, _, progress, _ = carry
        return (chunk < horizon // length) & jnp.any(progress.alive != 0)

    none = jnp.zeros(episodes.size, jnp.int32)
    progress = _Progress(
        state=[x.reshape(-1, episodes.size) for x in jax.tree.leaves(state)],
        alive=((episodes < num_episodes) & active).astype(jnp.int32),
        steps=none,
        nonfinite=none,
    )
    records = [
        jnp.zeros((horizon, _size(x), episodes.size), x.dtype) for x in step.out_avals[:_RECORDS]
    ]
    init = (jnp.zeros((), jnp.int32), noise_keys, progress, records)
    _, _, progress, records = while_any(unfinished, advance, init)
    observation, action, reward = (x[..., :num_episodes] for x in records)
    return Trajectory(
        observation=jnp.swapaxes(observation, 1, 2),
        action=jnp.moveaxis(action.reshape(horizon, *step.out_avals[1].shape, num_episodes), -1, 1),
        reward=reward[:, 0],
        mask=jnp.arange(horizon)[:, None] < progress.steps[:num_episodes],
        nonfinite=progress.nonfinite[:num_episodes] != 0,
    )


def unsupported(env: Environment, act: Act, actor: Any, distribution: Distribution) -> str | None:
    """Returns why the kernel cannot play this, or None; nothing is simulated or compiled."""
    reason = _unsupported_state(env)
    if reason:
        return reason
    try:
        operations = sum(_write_out(env, act, actor, distribution).operations.values())
    except UnsupportedPrimitive as error:
        return str(error)
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


#: The first leaves of what a step returns are recorded: observation, action, reward.
_RECORDS = 3


def _write_out(
    env: Environment, act: Act, actor: Any, distribution: Distribution
) -> scalarized.Scalarized:
    """Writes one step of one episode out in scalars; the actor is shared by all episodes."""

    def step(actor, state, noise, deterministic, alive):
        observation = jnp.where(alive, state.obs, 0.0)
        with nn.intercept_methods(_unit_by_unit):
            outputs = act(actor, observation)
        action = jnp.where(
            deterministic, distribution.mode(outputs), distribution.sample(outputs, noise)
        )
        after = env.step(state, action)
        broken = alive & ~(jnp.all(jnp.isfinite(after.obs)) & jnp.isfinite(after.reward))
        reward = jnp.where(alive & ~broken, after.reward, 0.0)
        action = jnp.where(alive, action, jnp.zeros_like(action))
        alive = alive & ~broken & (after.done == 0)
        return observation, action, reward, alive, broken, after

    flag = jax.ShapeDtypeStruct((), bool)
    state = jax.eval_shape(env.reset, jax.random.key(0))
    noise = jax.eval_shape(lambda: distribution.noise(jax.random.key(0), ()))
    actor = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), actor)
    examples = (actor, state, noise, flag, flag)
    num_leaves = len(jax.tree.leaves(examples))
    num_shared = len(jax.tree.leaves(actor))
    varying = [number >= num_shared for number in range(num_leaves)]
    return scalarized.build(step, examples, varying, _BRANCH_COST, _UNROLLED)


def _unit_by_unit(
    call: Callable[..., Any], args: tuple[Any, ...], kwargs: dict[str, Any], context: Any
) -> Any:
    """Computes an `MLP` of one observation two layers at a time, as a loop; for flax to call.

    Each unit of the first layer is computed and at once added to all units of the second. Written
    out, a network of 64 and 64 units would be a program of 9,000 operations.
    """
    network = context.module
    if not (isinstance(network, MLP) and context.method_name == "__call__" and args[0].ndim == 1):
        return call(*args, **kwargs)
    params = network.variables["params"]
    layers = [params[f"Dense_{i}"] for i in range(len(params))]
    x = args[0]

    def add_unit(sums, weights):
        into, bias, out = weights
        return sums + jnp.tanh(jnp.dot(x, into) + bias) * out, None

    while len(layers) > 1:
        first, second, *layers = layers
        x, _ = lax.scan(
            add_unit, second["bias"], (first["kernel"].T, first["bias"], second["kernel"])
        )
        x = jnp.tanh(x) if layers else x
    return jnp.dot(x, layers[0]["kernel"]) + layers[0]["bias"] if layers else x


def _chunk(
    step: scalarized.Scalarized,
    actor: Any,
    length: int,
    block: int,
    num_deterministic: int,
    interpret: bool,
) -> Callable[[jax.Array, _Progress], tuple[_Progress, list[jax.Array]]]:
    """Returns (noise [length, E, lanes], progress) -> progress and records of a chunk of steps."""
    # A block must not be empty; an empty leaf is never read.
    weights = [jnp.reshape(x, -1) if x.size else jnp.zeros(1) for x in jax.tree.leaves(actor)]

    def play(noise, progress):
        inputs, tree = jax.tree.flatten((weights, noise, progress))
        lanes = noise.shape[-1]
        records = [
            jax.ShapeDtypeStruct((length, _size(x), lanes), x.dtype)
            for x in step.out_avals[:_RECORDS]
        ]

        def kernel(*refs):
            weights, noise, progress = tree.unflatten(refs[: len(inputs)])
            *records, after = _split(refs[len(inputs) :], _RECORDS)
            _play_block(step, weights, noise, progress, records, after, num_deterministic)

        outputs = pl.pallas_call(
            kernel,
            grid=(lanes // block,),
            in_specs=[
                *(pl.BlockSpec(x.shape, lambda i: (0,)) for x in weights),
                *(_block_spec(x, block) for x in inputs[len(weights) :]),
            ],
            out_specs=[_block_spec(x, block) for x in [*records, *jax.tree.leaves(progress)]],
            out_shape=[
                *records,
                *(jax.ShapeDtypeStruct(x.shape, x.dtype) for x in jax.tree.leaves(progress)),
            ],
            compiler_params=pltriton.CompilerParams(num_warps=block // _WARP, num_stages=1),
            interpret=interpret,
        )(*inputs)
        *new, after = _split(outputs, _RECORDS)
        return jax.tree.unflatten(jax.tree.structure(progress), after), new

    return play


def _play_block(
    step: scalarized.Scalarized,
    weights: Sequence[Any],
    noise: Any,
    progress: _Progress,
    records: Sequence[Any],
    after: Sequence[Any],
    num_deterministic: int,
) -> None:
    """The kernel: plays one block of episodes from ``progress`` on; all arguments are refs.

    Writes ``records`` (observation, action, reward) of every step, zeros where an episode is over,
    and in ``after`` what ``progress`` is at the end.
    """
    length, _, block = noise.shape
    sizes = [ref.shape[0] for ref in progress.state]
    episode = pl.program_id(0) * block + lax.broadcasted_iota(jnp.int32, (block,), 0)
    deterministic = episode < num_deterministic

    def live(t, carry):
        state, alive, steps, nonfinite = carry
        lanes = _split_by(state, sizes)

        def read(place):
            leaf, k = place
            if leaf < len(weights):
                return weights[leaf][k]
            leaf -= len(weights)
            if leaf < len(lanes):
                return lanes[leaf][k]
            return (lambda: noise[t, k, :], lambda: deterministic, lambda: alive != 0)[
                leaf - len(lanes)
            ]()

        values = [
            [scalarized.full(x, (block,)) for x in leaf]
            for leaf in step.emit(read, (block,), _any_lane, read_anywhere=True)
        ]
        for ref, leaf in zip(records, values, strict=False):
            for k, x in enumerate(leaf):
                ref[t, k, :] = x
        (goes_on,), (broken,), *new = values[_RECORDS:]
        return (
            [x for leaf in new for x in leaf],
            goes_on.astype(jnp.int32),
            steps + alive,
            nonfinite | broken.astype(jnp.int32),
        )

    def over(t, carry):
        for ref in records:
            for k in range(ref.shape[1]):
                ref[t, k, :] = jnp.zeros((block,), ref.dtype)
        return carry

    def body(t, carry):
        return lax.cond(_any_lane(carry[1] != 0), live, over, t, carry)

    carry = (
        [ref[k, :] for ref in progress.state for k in range(ref.shape[0])],
        progress.alive[...],
        progress.steps[...],
        progress.nonfinite[...],
    )
    state, *flags = lax.fori_loop(0, length, body, carry)
    *state_refs, alive_ref, steps_ref, nonfinite_ref = after
    for ref, leaf in zip(state_refs, _split_by(state, sizes), strict=True):
        for k, x in enumerate(leaf):
            ref[k, :] = x
    for ref, x in zip((alive_ref, steps_ref, nonfinite_ref), flags, strict=True):
        ref[...] = x


def _any_lane(x: jax.Array) -> jax.Array:
    """Returns whether any entry is True; a Triton kernel has no `jnp.any`."""
    return jnp.max(x.astype(jnp.int32)) > 0


def _block_spec(x: Any, block: int) -> pl.BlockSpec:
    """Cuts the last axis, that of the lanes, into blocks."""
    ndim = len(x.shape)
    return pl.BlockSpec((*x.shape[:-1], block), lambda i: (*(0,) * (ndim - 1), i))


def _size(x: Any) -> int:
    return int(np.prod(x.shape, dtype=int))


def _split(items: Sequence[Any], count: int) -> list[Any]:
    """Returns the first items one by one, then the list of the others."""
    return [*items[:count], list(items[count:])]


def _split_by(items: Sequence[Any], sizes: Sequence[int]) -> list[Sequence[Any]]:
    """Cuts a list into pieces of the given sizes."""
    ends = np.cumsum(sizes).tolist()
    return [items[end - size : end] for end, size in zip(ends, sizes, strict=True)]
