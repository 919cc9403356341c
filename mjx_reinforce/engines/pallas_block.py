"""One block of episodes in a Pallas kernel for NVIDIA GPUs, for a chunk of steps."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.experimental import pallas as pl
from jax.experimental.pallas import triton as pltriton

from mjx_reinforce.fused import scalarized

#: Episodes a block, one a thread.
BLOCK = 128
#: Threads that run in step on an NVIDIA GPU.
WARP = 32
#: The first leaves of what a step returns are recorded: observation, action, reward.
NUM_RECORDS = 3


class Progress(NamedTuple):
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


def chunk_player(
    step: scalarized.Scalarized,
    actor: Any,
    length: int,
    block: int,
    num_deterministic: int,
    interpret: bool,
) -> Callable[[jax.Array, Progress], tuple[Progress, list[jax.Array]]]:
    """Returns what plays a chunk: (noise [length, E, lanes], progress) -> progress and records.

    Args:
      step: one step of one episode, written out in scalars.
      actor: what it reads first of all.
      length: steps of the chunk.
      block: episodes a block; the number of lanes is a multiple of it.
      num_deterministic: how many episodes, the first ones, take the mode.
      interpret: run the kernel as ordinary JAX.
    """
    # A block must not be empty; an empty leaf is never read.
    weights = [jnp.reshape(x, -1) if x.size else jnp.zeros(1) for x in jax.tree.leaves(actor)]

    def play(noise, progress):
        inputs, tree = jax.tree.flatten((weights, noise, progress))
        lanes = noise.shape[-1]
        records = record_shapes(step, length, lanes)

        def kernel(*refs):
            weights, noise, progress = tree.unflatten(refs[: len(inputs)])
            *records, after = _split(refs[len(inputs) :], NUM_RECORDS)
            _play_block(step, weights, noise, progress, records, after, num_deterministic)

        shapes = [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in jax.tree.leaves(progress)]
        outputs = pl.pallas_call(
            kernel,
            grid=(lanes // block,),
            in_specs=[
                *(pl.BlockSpec(x.shape, lambda i: (0,)) for x in weights),
                *(_block_spec(x, block) for x in inputs[len(weights) :]),
            ],
            out_specs=[_block_spec(x, block) for x in [*records, *shapes]],
            out_shape=[*records, *shapes],
            compiler_params=pltriton.CompilerParams(num_warps=block // WARP, num_stages=1),
            interpret=interpret,
        )(*inputs)
        *new, after = _split(outputs, NUM_RECORDS)
        return jax.tree.unflatten(jax.tree.structure(progress), after), new

    return play


def record_shapes(
    step: scalarized.Scalarized, length: int, lanes: int
) -> list[jax.ShapeDtypeStruct]:
    """Returns the shapes [length, size, lanes] of what is recorded of so many steps."""
    return [
        jax.ShapeDtypeStruct((length, int(np.prod(x.shape, dtype=int)), lanes), x.dtype)
        for x in step.out_avals[:NUM_RECORDS]
    ]


def _play_block(
    step: scalarized.Scalarized,
    weights: Sequence[Any],
    noise: Any,
    progress: Progress,
    records: Sequence[Any],
    after: Sequence[Any],
    num_deterministic: int,
) -> None:
    """The kernel: plays one block of episodes from ``progress`` on; all arguments are refs.

    Writes ``records`` (observation, action, reward) of every step, zeros where an episode is over,
    and in ``after`` what ``progress`` is at the end.
    """
    length, _, block = noise.shape
    episode = pl.program_id(0) * block + lax.broadcasted_iota(jnp.int32, (block,), 0)
    deterministic = episode < num_deterministic
    sizes = [ref.shape[0] for ref in progress.state]

    def live(t, carry):
        state, alive, steps, nonfinite = carry
        state = _split_by(state, sizes)
        after = _play_step(step, weights, state, noise, t, deterministic, alive, records)
        state, goes_on, broken = after
        return state, goes_on, steps + alive, nonfinite | broken

    def over(t, carry):
        for ref in records:
            for k in range(ref.shape[1]):
                ref[t, k, :] = jnp.zeros((block,), ref.dtype)
        return carry

    carry = (
        [ref[k, :] for ref in progress.state for k in range(ref.shape[0])],
        progress.alive[...],
        progress.steps[...],
        progress.nonfinite[...],
    )
    state, *flags = lax.fori_loop(
        0, length, lambda t, carry: lax.cond(_any_lane(carry[1] != 0), live, over, t, carry), carry
    )
    *state_refs, alive_ref, steps_ref, nonfinite_ref = after
    for ref, leaf in zip(state_refs, _split_by(state, sizes), strict=True):
        for k, x in enumerate(leaf):
            ref[k, :] = x
    for ref, x in zip((alive_ref, steps_ref, nonfinite_ref), flags, strict=True):
        ref[...] = x


def _play_step(
    step: scalarized.Scalarized,
    weights: Sequence[Any],
    state: Sequence[Any],
    noise: Any,
    t: Any,
    deterministic: Any,
    alive: Any,
    records: Sequence[Any],
) -> tuple[list[Any], Any, Any]:
    """Plays step t of a block and writes its records.

    Returns:
      The next state, one row a scalar; whether each episode goes on and whether it broke, int32.
    """
    block = alive.shape
    noise_leaf, deterministic_leaf = len(weights) + len(state), len(weights) + len(state) + 1

    def read(place):
        leaf, k = place
        if leaf < len(weights):
            return weights[leaf][k]
        if leaf < noise_leaf:
            return state[leaf - len(weights)][k]
        if leaf == noise_leaf:
            return noise[t, k, :]
        return deterministic if leaf == deterministic_leaf else alive != 0

    values = [
        [scalarized.full(x, block) for x in leaf]
        for leaf in step.emit(read, block, _any_lane, read_anywhere=True)
    ]
    for ref, leaf in zip(records, values, strict=False):
        for k, x in enumerate(leaf):
            ref[t, k, :] = x
    (goes_on,), (broken,), *new = values[NUM_RECORDS:]
    state = [x for leaf in new for x in leaf]
    return state, goes_on.astype(jnp.int32), broken.astype(jnp.int32)


def _any_lane(x: jax.Array) -> jax.Array:
    """Returns whether any entry is True; a Triton kernel has no `jnp.any`."""
    return jnp.max(x.astype(jnp.int32)) > 0


def _block_spec(x: Any, block: int) -> pl.BlockSpec:
    """Cuts the last axis, that of the lanes, into blocks."""
    ndim = len(x.shape)
    return pl.BlockSpec((*x.shape[:-1], block), lambda i: (*(0,) * (ndim - 1), i))


def _split(items: Sequence[Any], count: int) -> list[Any]:
    """Returns the first items one by one, then the list of the others."""
    return [*items[:count], list(items[count:])]


def _split_by(items: Sequence[Any], sizes: Sequence[int]) -> list[Sequence[Any]]:
    """Cuts a list into pieces of the given sizes."""
    ends = np.cumsum(sizes).tolist()
    return [items[end - size : end] for end, size in zip(ends, sizes, strict=True)]
