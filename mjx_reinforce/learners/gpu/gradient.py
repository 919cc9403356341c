"""The gradient of a small policy over all samples, in one kernel on a GPU.

It is taken for policies of ``mlp_policy``, in float32, with one to three layers of at most 64 tanh
units, up to 63 observations and 8 outputs, and any distribution that ``fused`` writes out in
scalars, on the GPU that it was measured on.
``accumulate_gradient`` computes all others; also where JAX has no Pallas for Triton, which JAX 0.12
deprecates.
"""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mjx_reinforce import fused
from mjx_reinforce.engines.native import look
from mjx_reinforce.policies.policy import Policy

#: XLA's name of what compiles and launches the kernel.
TRITON = "__gpu$xla.gpu.triton"
#: Compute capability of the GPUs that it was measured on, H100 and H200.
MEASURED = "9.0"
#: Fewer samples take XLA less than 0.4 ms (computed from the rate of many): a kernel saves little.
LEAST_SAMPLES = 2**18
#: What is larger does not fit in registers.
_MOST_UNITS, _MOST_OBSERVATIONS, _MOST_OUTPUTS, _MOST_LAYERS = 64, 63, 8, 3

#: (outputs [..., K], action [...], weight [...], mask [...], entropy_cost []) -> (the loss summed,
#: sums of metrics).
Loss = Callable[..., tuple[jax.Array, dict[str, jax.Array]]]


def in_one_kernel(
    policy: Policy,
    loss: Loss,
    entropy_cost: float | jax.Array,
    params: Any,
    samples: tuple[jax.Array, ...],
    *,
    seeds: int = 1,
) -> tuple[jax.Array, Any, Any] | None:
    """Sums a loss, its gradient and its metrics over samples, or returns None: XLA is to do it.

    Args:
      policy: any.
      loss: of samples from the policy's outputs on.
      entropy_cost: [].
      params: the policy's.
      samples: observation [T, N, O], action [T, N, ...], weight [T, N] and mask [T, N].
      seeds: how many learn at once, vmapped.

    Returns:
      The loss [], its gradient like ``params``, and the metrics.
    """
    if seeds * samples[-1].size < LEAST_SAMPLES or _capability() != MEASURED:
        return None
    if not is_supported(policy, samples[0].shape[-1]):
        return None
    program = jax.jit(functools.partial(kernel_gradient, loss))
    given = params, samples, jnp.asarray(entropy_cost, jnp.float32)
    shapes = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), given)
    try:
        program.trace(*shapes).lower(lowering_platforms=("cuda",))
    except Exception as error:  # whatever it is, XLA computes it too
        look.say(f"gradient by XLA: {type(error).__name__}: {error}")
        return None
    look.say("gradient in one kernel")
    return program(*given)


def is_supported(policy: Policy, observation_size: int) -> bool:
    """Returns whether the kernel is for a policy."""
    whose, network = getattr(policy.apply, "network", (None, None))
    return (
        whose is policy.apply
        and network is not None
        and 1 <= len(network.hidden_sizes) <= _MOST_LAYERS
        and max(network.hidden_sizes) <= _MOST_UNITS
        and network.num_outputs <= _MOST_OUTPUTS
        and observation_size <= _MOST_OBSERVATIONS
        and not jax.config.values["jax_enable_x64"]
    )


def kernel_gradient(
    loss: Loss, params: Any, samples: tuple[jax.Array, ...], entropy_cost: jax.Array
) -> tuple[jax.Array, Any, Any]:
    """Returns what ``in_one_kernel`` does, of a policy that fits."""
    from mjx_reinforce.learners.gpu import kernel  # imports Pallas, which takes 0.2 s

    observation, action, weight, mask = (x.reshape(samples[-1].size, -1) for x in samples)
    network, constants = params["network"]["params"], params["constants"]
    *hidden, (last, last_bias) = [(layer["kernel"], layer["bias"]) for layer in network.values()]
    size, num_outputs = observation.shape[1], len(last_bias)
    shape, number = jax.ShapeDtypeStruct, jax.ShapeDtypeStruct((), jnp.float32)
    head = fused.scalarize(
        jax.value_and_grad(loss, has_aux=True),
        shape((num_outputs + len(constants),), jnp.float32),
        shape(samples[1].shape[2:], action.dtype),
        *(number, shape((), bool), number),
        branch_cost=2**31,  # a branch is for a tile, not for a sample
    )

    padded = kernel.padded
    widths = [padded(size + 1), *(padded(len(bias)) for _, bias in hidden)]
    kernels = [_pad(x, *widths[k : k + 2]) for k, (x, _) in enumerate(hidden)]
    biases = [_pad(bias, width) for (_, bias), width in zip(hidden, widths[1:], strict=True)]
    sums = kernel.launch(
        head,
        kernel.Given(
            observation=observation,
            action=action,
            weight=weight[:, 0],
            mask=mask[:, 0],
            kernels=[kernels[0].at[size].set(biases[0]), *kernels[1:]],
            biases=biases[1:],
            last=_pad(last.T, num_outputs, widths[-1]),
            numbers=jnp.concatenate([last_bias, constants, entropy_cost[None]]),
        ),
    )

    ends = np.cumsum([aval.size for aval in head.out_avals])
    leaves = [
        x.reshape(aval.shape)
        for x, aval in zip(jnp.split(sums.numbers, ends), head.out_avals, strict=False)
    ]
    (value, metrics), slopes = head.out_tree.unflatten(leaves)
    of_kernels = [*sums.kernels, sums.last.T]
    of_biases = [*(x[size] for x in (sums.kernels[0], *sums.biases)), slopes]
    layers = {
        name: {"kernel": _cut(weights, layer["kernel"]), "bias": _cut(bias, layer["bias"])}
        for (name, layer), weights, bias in zip(network.items(), of_kernels, of_biases, strict=True)
    }
    return value, {"network": {"params": layers}, "constants": slopes[num_outputs:]}, metrics


def _capability() -> str:
    return str(getattr(jax.devices()[0], "compute_capability", ""))


def _pad(x: jax.Array, *shape: int) -> jax.Array:
    return jnp.pad(x, [(0, most - size) for size, most in zip(x.shape, shape, strict=True)])


def _cut(x: jax.Array, like: jax.Array) -> jax.Array:
    return x[tuple(map(slice, like.shape))]
