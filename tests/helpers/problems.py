"""Problems for updates: samples of three episodes, and a loss that has no meaning."""

import jax.numpy as jnp
import numpy as np

from mjx_reinforce.learning.updates import Clock, Problem

LENGTHS = np.array([4, 1, 3])


MASK = np.arange(5)[:, None] < LENGTHS


PARAMS = {"w": jnp.array(0.7), "b": jnp.array(-0.4)}


#: Before the first update.
START = Clock(jnp.zeros(()), jnp.zeros(()))


def surrogate(params, samples):
    """Any function that is not linear in the parameters."""
    observation, action, weight, mask = samples
    entropy = jnp.cos(params["w"] * observation[..., 0])
    terms = weight * jnp.tanh(params["w"] * observation[..., 0] - action[..., 0] * params["b"])
    loss = -jnp.sum(jnp.where(mask, terms, 0.0))
    return loss, {"entropy": jnp.sum(jnp.where(mask, entropy, 0.0))}


def make_problem(optimizer, divisor=3, mask=MASK, seed=0):
    rng = np.random.default_rng(seed)
    observation, action = rng.normal(size=(2, *mask.shape, 1))
    weight = np.where(mask, rng.normal(size=mask.shape), 0.0)
    samples = tuple(map(jnp.asarray, (observation, action, weight, mask)))
    return Problem(surrogate, optimizer, samples, divisor, START)
