"""The kernel of ``gradient``, in Pallas for Triton.

XLA computes the gradient in some 14 passes over arrays [samples, units]. This kernel reads each
sample once: forward pass, loss and backward pass of a tile of samples stay on a multiprocessor. A
program of the kernel's grid goes over many tiles, skips those without a sample inside the mask, and
adds up the gradient of all parameters.

Precision: matrices are multiplied on tensor cores, each number as the sum of two in bfloat16. Of
the four products the one of the two small parts is left out, and sums are in float32 (Henry, Tang
and Heinecke 2019, arXiv:1904.06376). The error of a product is below 2^-14 of it; TF32's is 2^-10.

Determinism: all sums are in a fixed order, so that the same samples give the same bits.

Triton needs sizes that are powers of two, and 16 for a factor. Widths W of layers are padded to
these: W[0] of the observation, whose entry after the last is 1, then of each hidden layer.
"""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jax.experimental import pallas as pl
from jax.experimental.pallas import triton

from mjx_reinforce import fused
from mjx_reinforce.engines.native.gpu.seam import in_one_launch

#: Samples of a tile, and warps that work on it. So an H100 went over 2.0e9 samples a second, of a
#: 64-64 network; with 128 samples over 1.0e9, 1.6e9 with 8 warps; with 32 samples over 1.3e9.
TILE, WARPS = 64, 4
#: Programs of a launch at most, four for each multiprocessor of an H100; tiles of each at least.
PROGRAMS, TILES = 528, 8
#: Rows and columns of a factor at least.
LEAST = 16


class Given(NamedTuple):
    """Samples, and parameters padded with zeros.

    observation, action, weight, mask: [B, O], [B, A], [B] and [B]
    kernels: [W[k], W[k + 1]] of each hidden layer; the first one's bias is its row O
    biases: [W[k + 1]] of each hidden layer after the first
    last: [K, W[-1]], the last layer's kernel transposed
    numbers: the last layer's bias, the policy's constants and the cost of entropy
    """

    observation: Any
    action: Any
    weight: Any
    mask: Any
    kernels: list[Any]
    biases: list[Any]
    last: Any
    numbers: Any


class Sums(NamedTuple):
    """Sums over samples.

    kernels: [W[k], W[k + 1]], the gradient for each hidden layer; row O is the first one's bias
    biases: [W[0], W[k + 1]] for each hidden layer after the first; row O is the bias
    last: [16, W[-1]], the gradient of the last layer's kernel transposed
    numbers: what ``head`` computes
    """

    kernels: list[Any]
    biases: list[Any]
    last: Any
    numbers: Any


def launch(head: fused.Scalarized, given: Given, *, interpret: bool = False) -> Sums:
    """Returns sums over all samples; vmapped, it remains one launch.

    Args:
      head: (outputs of the policy, action, weight, mask, cost of entropy) -> any numbers, after
        which come the derivatives of the loss in the outputs.
      given: as in ``Given``.
      interpret: whether to compute without a GPU, for tests.
    """
    leaves, tree = jax.tree.flatten(given)
    first = given.kernels[0].shape[0]
    results = Sums(
        kernels=[x.shape for x in given.kernels],
        biases=[(first, *x.shape) for x in given.biases],
        last=(LEAST, given.last.shape[1]),
        numbers=(padded(sum(map(len, head.outputs))),),
    )
    shapes, result_tree = jax.tree.flatten(results, is_leaf=lambda x: type(x) is tuple)

    def run(*leaves):  # [S, ...] each
        seeds, tiles = len(leaves[0]), leaves[0].shape[1] // TILE
        programs = max(1, min(PROGRAMS // seeds, tiles // TILES))

        def body(*refs):
            k = len(leaves)
            _kernel(head, programs, tree.unflatten(refs[:k]), result_tree.unflatten(refs[k:]))

        each = pl.pallas_call(
            body,
            grid=(seeds, programs),
            in_specs=[_block(1, x.shape[1:]) for x in leaves],
            out_specs=[_block(2, shape) for shape in shapes],
            out_shape=[jax.ShapeDtypeStruct((seeds, programs, *x), jnp.float32) for x in shapes],
            compiler_params=triton.CompilerParams(num_warps=WARPS, num_stages=1),
            interpret=interpret,
        )(*leaves)
        return [jnp.sum(x, axis=1) for x in each]

    stacked = in_one_launch(run)(*(x[None] for x in leaves))
    return result_tree.unflatten(x[0] for x in stacked)


def padded(size: int) -> int:
    """Returns the size that an axis is padded to."""
    return max(LEAST, 1 << (size - 1).bit_length())


def _block(axes: int, shape: tuple[int, ...]) -> pl.BlockSpec:
    """Returns a program's part of an array whose first axes are those of the grid."""
    return pl.BlockSpec((None,) * axes + shape, lambda *at: at[:axes] + (0,) * len(shape))


class _Split(NamedTuple):
    """A matrix as the sum of two in bfloat16."""

    large: jax.Array
    small: jax.Array


def _split(x: jax.Array) -> _Split:
    large = x.astype(jnp.bfloat16)
    return _Split(large, (x - large.astype(jnp.float32)).astype(jnp.bfloat16))


def _product(a: _Split, b: _Split, over: tuple[int, int]) -> jax.Array:
    """Returns a product of matrices in float32, summed over these axes of the two."""
    dot = functools.partial(
        lax.dot_general,
        dimension_numbers=(((over[0],), (over[1],)), ((), ())),
        precision=lax.Precision.HIGHEST,
        preferred_element_type=jnp.float32,
    )
    return dot(a.large, b.small) + dot(a.small, b.large) + dot(a.large, b.large)


def _kernel(head: fused.Scalarized, programs: int, given: Given, results: Sums) -> None:
    """Sums over every ``programs``-th tile of samples."""
    count, size = given.observation.shape
    kernels = [_split(x[...]) for x in given.kernels]
    biases = [None, *(x[...] for x in given.biases)]
    last = [given.last[k, :] for k in range(given.last.shape[0])]
    numbers = [given.numbers[k] for k in range(given.numbers.shape[0])]
    column = lax.broadcasted_iota(jnp.int32, (TILE, given.kernels[0].shape[0]), 1)
    output = lax.broadcasted_iota(jnp.int32, (TILE, LEAST), 1)
    program = pl.program_id(1)

    def add(k, sums):
        row = (program + k * programs) * TILE + lax.iota(jnp.int32, TILE)
        alive = triton.load(given.mask.at[row], mask=row < count, other=False)
        return lax.cond(
            jnp.max(alive.astype(jnp.int32)) > 0,
            lambda: jax.tree.map(jnp.add, sums, of_tile(row, alive)),
            lambda: sums,
        )

    def of_tile(row, alive):
        load = functools.partial(triton.load, mask=row < count, other=0)
        seen = triton.load(
            given.observation.at[row[:, None], jnp.minimum(column, size - 1)],
            mask=(row < count)[:, None] & (column < size),
            other=0.0,
        )
        units, values = [_split(jnp.where(column == size, 1.0, seen))], []
        for kernel, bias in zip(kernels, biases, strict=True):
            z = _product(units[-1], kernel, (1, 0))
            values.append(jnp.tanh(z if bias is None else z + bias[None, :]))
            units.append(_split(values[-1]))

        shared = [jnp.full(TILE, x) for x in numbers]
        outputs = [
            jnp.sum(values[-1] * x[None, :], axis=1) + bias
            for x, bias in zip(last, shared, strict=False)
        ]
        arguments = (
            [*outputs, *shared[len(last) : -1]],
            [load(given.action.at[row, k]) for k in range(given.action.shape[1])],
            [load(given.weight.at[row])],
            [alive],
            shared[-1:],
        )
        found = head.compile("xla", read=lambda at: arguments[at[0]][at[1]], batch_shape=(TILE,))
        found = [jnp.zeros(TILE) + x for leaf in found for x in leaf]

        slopes, back = jnp.zeros((TILE, LEAST)), jnp.zeros(values[-1].shape)
        for k, slope in enumerate(found[-len(arguments[0]) :][: len(last)]):
            slopes = jnp.where(output == k, slope[:, None], slopes)
            back += slope[:, None] * last[k][None, :]
        of_kernels, of_biases = [], []
        for k in reversed(range(len(kernels))):
            back = _split(back * (1.0 - values[k] * values[k]))
            of_kernels.append(_product(units[k], back, (0, 0)))
            if k > 0:
                of_biases.append(_product(units[0], back, (0, 0)))
                back = _product(back, kernels[k], (1, 1))
        of_last = _product(_split(slopes), units[-1], (0, 0))
        return Sums(of_kernels[::-1], of_biases[::-1], of_last, found)

    zeros = jax.tree.map(lambda x: jnp.zeros(x.shape), results)
    lanes = [jnp.zeros(TILE) for leaf in head.outputs for _ in leaf]
    own = (pl.cdiv(count, TILE) - program + programs - 1) // programs
    sums = lax.fori_loop(0, own, add, zeros._replace(numbers=lanes))
    numbers, at = zeros.numbers, lax.iota(jnp.int32, zeros.numbers.size)
    for k, lane in enumerate(sums.numbers):
        numbers = jnp.where(at == k, jnp.sum(lane), numbers)

    def write(result, total):
        result[...] = total

    jax.tree.map(write, results, sums._replace(numbers=numbers))
