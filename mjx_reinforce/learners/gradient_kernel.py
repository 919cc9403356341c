"""The gradient of a small network over all samples as one kernel on a GPU.

XLA computes it in some 14 passes over arrays [samples, units]. This kernel reads each sample once:
forward pass, log-probability, entropy and backward pass stay in registers and shared memory. A
program of its grid goes over many tiles of samples, and adds up the gradient of all parameters in
registers. Its sums are added in a fixed order, so that the same samples give the same bits.

Matrices are multiplied on tensor cores, each number as the sum of two in bfloat16. Of the four
products the one of the two small parts is left out. The error of a product is below 2^-15 of it;
XLA's default for float32 on these GPUs, TF32, has 2^-10.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.experimental import pallas as pl
from jax.experimental.pallas import triton

from mjx_reinforce import fused
from mjx_reinforce.policies.policy import Policy

#: (outputs [..., K], action [..., A], weight [...], mask [...]) -> (the loss summed, sums of
#: metrics).
Loss = Callable[..., tuple[jax.Array, dict[str, jax.Array]]]

#: Samples of a tile, and warps that work on it.
TILE, WARPS = 128, 4
#: Programs that one multiprocessor is given at most, and tiles that a program is given at least.
PROGRAMS, LEAST_TILES = 4, 8
#: What is larger does not fit in registers.
_MOST_UNITS, _MOST_OBSERVATIONS, _MOST_OUTPUTS, _MOST_LAYERS = 64, 63, 8, 3
#: Tensor cores multiply matrices of so many rows and columns at least.
_LEAST = 16
#: XLA's name of what compiles and launches the kernel.
TRITON = "__gpu$xla.gpu.triton"
MULTIPLY = "bf16x3"
SKIP = True


class _Head(NamedTuple):
    """What is computed for a sample from the network's outputs on, written out in scalars.

    written: (outputs, action, weight, mask, *operands) -> (loss, metrics, derivative of the loss
      in the outputs).
    operands: what the loss closes over and jit or vmap trace.
    """

    written: fused.Scalarized
    operands: list[jax.Array]


def unsupported(policy: Policy, observation_size: int) -> str | None:
    """Returns why the kernel does not compute the gradient of a policy here, or None."""
    if jax.default_backend() != "gpu" or jax.devices()[0].platform != "gpu":
        return "it is for NVIDIA's GPUs"
    return unfit(policy, observation_size)


def unfit(policy: Policy, observation_size: int) -> str | None:
    """Returns why the kernel cannot compute the gradient of a policy, or None."""
    network = getattr(policy.apply, "network", None)
    if network is None:
        return "it is for policies of one network with tanh units"
    sizes = network.hidden_sizes
    if not 1 <= len(sizes) <= _MOST_LAYERS or max(sizes) > _MOST_UNITS:
        return "the network is too large, or linear"
    if observation_size > _MOST_OBSERVATIONS or network.num_outputs > _MOST_OUTPUTS:
        return "there are too many observations or outputs"
    if jax.config.values["jax_enable_x64"]:
        return "it computes in float32"
    return None


def gradient(
    policy: Policy, loss: Loss, params: Any, samples: tuple[jax.Array, ...], **options: Any
) -> tuple[jax.Array, Any, Any]:
    """Sums a loss, its gradient and its metrics over samples; ``unfit`` says for which policies.

    Args:
      policy: of one network.
      loss: of samples from the network's outputs on.
      params: the policy's.
      samples: observation [T, N, O], action [T, N, ...], weight [T, N] and mask [T, N].
      options: ``interpret`` computes without a GPU.

    Returns:
      The loss [], its gradient like ``params``, and the metrics.
    """
    observation, action, weight, mask = samples
    count = mask.size
    flat = (
        observation.reshape(count, -1),
        action.reshape(count, -1),
        weight.reshape(count),
        mask.reshape(count),
    )
    outputs = jax.ShapeDtypeStruct(
        (policy.distribution.num_outputs + len(policy.distribution.constants),), jnp.float32
    )
    head, metrics = _head(loss, outputs, jax.ShapeDtypeStruct(action.shape[2:], action.dtype))
    layers = [(layer["kernel"], layer["bias"]) for layer in params["network"]["params"].values()]
    given = *flat, params["constants"], layers, head.operands
    leaves, tree = jax.tree.flatten(given)

    @jax.custom_batching.custom_vmap
    def compute(*leaves):  # [S, ...]
        return _launch(head.written, *tree.unflatten(leaves), **options)

    @compute.def_vmap
    def _(size, mapped, *leaves):
        along = [
            x if is_mapped else jnp.broadcast_to(x, (size, *x.shape))
            for x, is_mapped in zip(leaves, mapped, strict=True)
        ]
        results = compute(*(x.reshape(-1, *x.shape[2:]) for x in along))
        sums, grads, layers = jax.tree.map(lambda x: x.reshape(size, -1, *x.shape[1:]), results)
        return (sums, grads, layers), jax.tree.map(lambda x: True, (sums, grads, layers))

    results = compute(*(x[None] for x in leaves))
    (value, *sums), constants, layers = jax.tree.map(lambda x: x[0], results)
    network = {
        name: {"kernel": kernel, "bias": bias}
        for name, (kernel, bias) in zip(params["network"]["params"], layers, strict=True)
    }
    grads = {"network": {"params": network}, "constants": constants}
    return value, grads, metrics.unflatten(sums)


def _head(loss: Loss, outputs: Any, action: Any) -> tuple[_Head, Any]:
    """Returns what is computed from the network's outputs on, and the structure of the metrics."""

    def differentiated(outputs, action, weight, mask):
        (value, metrics), slope = jax.value_and_grad(loss, has_aux=True)(
            outputs, action, weight, mask
        )
        return value, metrics, slope

    shape = jax.ShapeDtypeStruct
    examples = outputs, action, shape((), jnp.float32), shape((), bool)
    closed, shapes = jax.make_jaxpr(differentiated, return_shape=True)(*examples)
    traced = [k for k, x in enumerate(closed.consts) if isinstance(x, jax.core.Tracer)]
    operands = [closed.consts[k] for k in traced]

    def of_operands(outputs, action, weight, mask, *operands):
        consts = list(closed.consts)
        for k, operand in zip(traced, operands, strict=True):
            consts[k] = operand
        return jax.core.eval_jaxpr(closed.jaxpr, consts, outputs, action, weight, mask)

    written = fused.scalarize(
        of_operands, *examples, *(shape(x.shape, x.dtype) for x in operands), branch_cost=2**31
    )
    return _Head(written, operands), jax.tree.structure(shapes[1])


def _launch(
    written: fused.Scalarized,
    observation: jax.Array,
    action: jax.Array,
    weight: jax.Array,
    mask: jax.Array,
    constants: jax.Array,
    layers: list[tuple[jax.Array, jax.Array]],
    operands: list[jax.Array],
    *,
    interpret: bool = False,
    tile: int | None = None,
    warps: int | None = None,
    programs: int | None = None,
    multiply: str | None = None,
    skip: bool | None = None,
) -> Any:
    """Returns sums [S, ...] of the loss and the metrics, and of the gradients."""
    tile = TILE if tile is None else tile
    multiply = MULTIPLY if multiply is None else multiply
    skip = SKIP if skip is None else skip
    seeds, count, observation_size = observation.shape
    if programs is None:
        processors = 132 if interpret else jax.devices()[0].core_count
        room = max(1, PROGRAMS * processors // seeds)
        programs = max(1, min(room, count // (LEAST_TILES * tile)))
    kernels = [kernel for kernel, _ in layers]
    widths = [_wide(observation_size + 1), *(_wide(x.shape[-1]) for x in kernels[:-1])]
    hidden = [_pad(x, widths[k], widths[k + 1]) for k, x in enumerate(kernels[:-1])]
    # The bias of the first layer is the weight of an entry that is 1.
    first, *biases = [bias for _, bias in layers[:-1]]
    hidden[0] = hidden[0].at[:, observation_size, : first.shape[-1]].set(first)
    biases = [jnp.pad(x, ((0, 0), (0, widths[k + 2] - x.shape[-1]))) for k, x in enumerate(biases)]
    last = jnp.swapaxes(_pad(kernels[-1], widths[-1], kernels[-1].shape[-1]), 1, 2)
    numbers = jnp.concatenate(
        [layers[-1][1], constants, *(x.reshape(seeds, -1) for x in operands)], axis=1
    ).astype(jnp.float32)
    num_outputs, num_constants = kernels[-1].shape[-1], constants.shape[-1]
    given = observation, action, weight, mask, *hidden, *biases, last, numbers
    metrics = len(written.outputs) - 1
    results = [
        *((w, widths[k + 1]) for k, w in enumerate(widths[:-1])),
        *((widths[0], w) for w in widths[2:]),
        (_LEAST, widths[-1]),
        (_wide(metrics + num_outputs + num_constants),),
    ]
    body = functools.partial(
        _kernel,
        written=written,
        widths=widths,
        num_outputs=num_outputs,
        num_constants=num_constants,
        operands=[x.shape[1:] for x in operands],
        tile=tile,
        programs=programs,
        multiply=multiply,
        skip=skip,
    )
    partial_sums = pl.pallas_call(
        body,
        grid=(seeds, programs),
        in_specs=[_of_seed(x.shape) for x in given],
        out_specs=[_of_program(shape) for shape in results],
        out_shape=[
            jax.ShapeDtypeStruct((seeds, programs, *shape), jnp.float32) for shape in results
        ],
        interpret=interpret,
        compiler_params=triton.CompilerParams(
            num_warps=WARPS if warps is None else warps, num_stages=1
        ),
    )(*given)
    *sums, numbers = [jnp.sum(x, axis=1) for x in partial_sums]
    depth = len(widths) - 1
    slopes = [x[:, observation_size] for x in (sums[0], *sums[depth : 2 * depth - 1])]
    own = [
        (total[:, : x.shape[1], : x.shape[2]], slope[:, : x.shape[2]])
        for x, total, slope in zip(kernels, sums, slopes, strict=False)
    ]
    own.append(
        (
            jnp.swapaxes(sums[-1][:, :num_outputs, : kernels[-1].shape[1]], 1, 2),
            numbers[:, metrics : metrics + num_outputs],
        )
    )
    slopes = numbers[:, metrics + num_outputs : metrics + num_outputs + num_constants]
    return [numbers[:, k] for k in range(metrics)], slopes, own


def _of_seed(shape: tuple[int, ...]) -> pl.BlockSpec:
    return pl.BlockSpec((None, *shape[1:]), lambda s, p: (s,) + (0,) * (len(shape) - 1))


def _of_program(shape: tuple[int, ...]) -> pl.BlockSpec:
    return pl.BlockSpec((None, None, *shape), lambda s, p: (s, p) + (0,) * len(shape))


def _wide(size: int) -> int:
    """Returns a power of two of at least that size, which Triton asks of arrays."""
    return max(_LEAST, 1 << (size - 1).bit_length())


def _pad(x: jax.Array, rows: int, columns: int) -> jax.Array:
    return jnp.pad(x, ((0, 0), (0, rows - x.shape[1]), (0, columns - x.shape[2])))


class _Factor:
    """A matrix that is a factor of products: itself, and its two parts in bfloat16."""

    def __init__(self, x: jax.Array, multiply: str):
        self.x, self.multiply = x, multiply
        if multiply == "bf16x3":
            self.large = x.astype(jnp.bfloat16)
            self.small = (x - self.large.astype(jnp.float32)).astype(jnp.bfloat16)


_PRECISIONS = {
    "ieee": lax.Precision.HIGHEST,
    "tf32": lax.DotAlgorithmPreset.TF32_TF32_F32,
    "tf32x3": lax.DotAlgorithmPreset.TF32_TF32_F32_X3,
}


def _product(a: _Factor, b: _Factor, contract: tuple[int, int]) -> jax.Array:
    """Returns a product in float32 of matrices, summed over these axes of the two."""
    dims = (((contract[0],), (contract[1],)), ((), ()))
    dot = functools.partial(
        lax.dot_general, dimension_numbers=dims, preferred_element_type=jnp.float32
    )
    if a.multiply != "bf16x3":
        return dot(a.x, b.x, precision=_PRECISIONS[a.multiply])
    return dot(a.large, b.small) + dot(a.small, b.large) + dot(a.large, b.large)


def _kernel(
    observation,
    action,
    weight,
    mask,
    *refs,
    written: fused.Scalarized,
    widths: Sequence[int],
    num_outputs: int,
    num_constants: int,
    operands: Sequence[tuple[int, ...]],
    tile: int,
    programs: int,
    multiply: str,
    skip: bool,
):
    """Sums over every ``programs``-th tile of samples."""
    program = pl.program_id(1)
    depth = len(widths) - 1
    hidden, refs = refs[:depth], refs[depth:]
    biases, refs = refs[: depth - 1], refs[depth - 1 :]
    last, numbers, *results = refs
    count, observation_size = observation.shape
    factor = functools.partial(_Factor, multiply=multiply)
    weights = [factor(ref[...]) for ref in hidden]
    biases = [ref[...] for ref in biases]
    last = [last[k, :] for k in range(num_outputs)]
    scalar = [numbers[k] for k in range(numbers.shape[0])]
    column = lax.broadcasted_iota(jnp.int32, (tile, widths[0]), 1)
    small = lax.broadcasted_iota(jnp.int32, (tile, _LEAST), 1)

    def add(k, sums):
        row = (program + k * programs) * tile + lax.iota(jnp.int32, tile)
        inside = row < count
        alive = triton.load(mask.at[row], mask=inside, other=False)
        if not skip:
            return add_alive(row, inside, alive, sums)
        return lax.cond(
            jnp.max(alive.astype(jnp.int32)) > 0,
            lambda: add_alive(row, inside, alive, sums),
            lambda: sums,
        )

    def add_alive(row, inside, alive, sums):
        seen = triton.load(
            observation.at[row[:, None], jnp.minimum(column, observation_size - 1)],
            mask=inside[:, None] & (column < observation_size),
            other=0.0,
        )
        units = [factor(jnp.where(column == observation_size, 1.0, seen))]
        values = []
        for k in range(depth):
            z = _product(units[k], weights[k], (1, 0))
            values.append(jnp.tanh(z if k == 0 else z + biases[k - 1][None, :]))
            units.append(factor(values[k]))
        outputs = [
            jnp.sum(values[-1] * row_of[None, :], axis=1) + scalar[k]
            for k, row_of in enumerate(last)
        ]
        read = _reader(
            outputs,
            scalar[num_outputs:],
            num_constants,
            lambda k: triton.load(action.at[row, k], mask=inside, other=0),
            triton.load(weight.at[row], mask=inside, other=0.0),
            alive,
            operands,
        )
        found = written.compile("xla", read=read, batch_shape=(tile,))
        *own, slopes = found
        lanes = jnp.zeros((tile,), jnp.float32)
        slopes = [lanes + x for x in slopes]
        own = [*(lanes + x for (x,) in own), *slopes]
        by_output = jnp.zeros((tile, _LEAST), jnp.float32)
        back = jnp.zeros((tile, widths[-1]), jnp.float32)
        for k in range(num_outputs):
            by_output = jnp.where(small == k, slopes[k][:, None], by_output)
            back += slopes[k][:, None] * last[k][None, :]
        grads, bias_grads = [], []
        for k in reversed(range(depth)):
            back = factor(back * (1.0 - values[k] * values[k]))
            grads.append(_product(units[k], back, (0, 0)))
            if k > 0:
                bias_grads.append(_product(units[0], back, (0, 0)))
                back = _product(back, weights[k], (1, 1))
        found = *grads[::-1], *bias_grads[::-1], _product(factor(by_output), units[-1], (0, 0))
        return [total + x for total, x in zip(sums, [*found, *own], strict=True)]

    own = len(written.outputs) - 1 + num_outputs + num_constants
    zeros = [
        *(jnp.zeros(result.shape, jnp.float32) for result in results[:-1]),
        *(jnp.zeros((tile,), jnp.float32) for _ in range(own)),
    ]
    tiles = pl.cdiv(count, tile)
    mine = (tiles - program + programs - 1) // programs
    sums = lax.fori_loop(0, mine, add, zeros)
    for result, total in zip(results[:-1], sums, strict=False):
        result[...] = total
    place = lax.iota(jnp.int32, results[-1].shape[0])
    totals = jnp.zeros(place.shape, jnp.float32)
    for k, total in enumerate(sums[len(results) - 1 :]):
        totals = jnp.where(place == k, jnp.sum(total), totals)
    results[-1][...] = totals


def _reader(outputs, scalars, num_constants, load_action, weight, mask, operands):
    """Returns a function from (number of the argument, position in it) to what it is."""
    outputs = [*outputs, *scalars[:num_constants]]
    starts = num_constants + np.cumsum([0, *(int(np.prod(x, dtype=int)) for x in operands)])
    actions = functools.cache(load_action)

    def read(place):
        number, position = place
        if number == 0:
            x = outputs[position]
            return jnp.zeros(mask.shape, jnp.float32) + x
        if number == 1:
            return actions(position)
        if number < 4:
            return (weight, mask)[number - 2]
        return jnp.zeros(mask.shape, jnp.float32) + scalars[starts[number - 4] + position]

    return read
