"""How augmented random search moves: by the paper's rule, or by that of a published notebook."""

from typing import Any

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from optax import Params

from mjx_reinforce.policies.policy import Policy
from mjx_reinforce.types import PyTree


def paper_increment(directions: Params, returns: jax.Array, top: int) -> Any:
    """Returns the sum in the module's formula over b sigma; zero where sigma is.

    Args:
      directions: like the params, with a leading axis [D].
      returns: [2, D] forwards and backwards.
      top: b.
    """
    best = jnp.argsort(-jnp.max(returns, axis=0))[:top]
    gain = _over_std(returns[0, best] - returns[1, best], returns[:, best]) / top
    return jax.tree.map(lambda d: _weighted_sum(gain, d[best]), directions)


def document_increment(directions: Params, returns: jax.Array, noise_std: ArrayLike) -> Any:
    """Returns the increment of a published notebook, mistakes included, for reproducing it.

    Its ``np.sum`` without an axis adds up the entries of the direction too, so all parameters move
    by the same number; it does not divide by how many directions there are, and multiplies by
    ``noise_std``. The bias is overwritten besides, see ``overwrite_bias``. Not reproduced: where
    all returns are equal it divides 0 by 0, and its parameters are NaN for good.
    """
    totals = sum(jnp.sum(d.reshape(len(d), -1), axis=1) for d in jax.tree.leaves(directions))
    increment = noise_std * jnp.sum(_over_std(returns[0] - returns[1], returns) * totals)
    return jax.tree.map(lambda d: jnp.full(d.shape[1:], increment, d.dtype), directions)


def overwrite_bias(params: PyTree) -> Any:
    """Returns a linear policy's params with the first A weights in place of the bias [A].

    The notebook writes the same first entries of its flat vector into every parameter.
    """
    layer = params["network"]["params"]["Dense_0"]
    # PyTorch stores weights as [A, O], flax as [O, A].
    bias = layer["kernel"].T.reshape(-1)[: layer["bias"].size]
    return params | {"network": {"params": {"Dense_0": layer | {"bias": bias}}}}


def check_linear(policy: Policy) -> None:
    """Raises ValueError for a policy whose bias ``overwrite_bias`` does not find."""
    params = jax.eval_shape(policy.init, jax.random.key(0))
    if set(params) != {"network", "constants"} or set(params["network"]["params"]) != {"Dense_0"}:
        raise ValueError("update='document' is for linear policies: pass one with hidden_sizes=()")


def _over_std(x: jax.Array, returns: jax.Array) -> jax.Array:
    """Returns ``x`` over the standard deviation of all returns, 0 if they are all equal."""
    std = jnp.std(returns)
    return jnp.where(std > 0, x / jnp.where(std > 0, std, 1.0), 0.0)


def _weighted_sum(weight: jax.Array, x: jax.Array) -> jax.Array:
    """Returns the sum over the first axis of ``x`` [D, ...] times ``weight`` [D]."""
    return jnp.sum(weight.reshape(-1, *(1,) * (x.ndim - 1)) * x, axis=0)
