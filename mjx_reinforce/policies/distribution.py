"""Action distributions, indexed by the outputs of a policy network.

A distribution is a tuple of pure functions. ``outputs`` [..., K] holds its
parameters: first ``num_outputs`` entries that the network computes from the
observation, then one for each of ``constants``, trained but the same in every
state. Sampling is split in two, ``noise`` and ``sample``, so that every engine
draws the same actions from the same key: noise may be drawn far from where it
is used.

Every family, here, in ``normals`` and in ``bounded``, takes the action space,
``initial_std``, the standard deviation before training in the action's unit, and
``rescale``, so that all can be built alike. A family that does not suit the space
raises ValueError.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from mjx_reinforce.types import Box, Discrete


class Distribution(NamedTuple):
    """A family of distributions over actions.

    num_outputs: entries of ``outputs`` that the network computes
    constants: [K - num_outputs] initial values of the entries no state changes
    noise: (key, shape) -> [*shape, E] what ``sample`` transforms; consumes the key
    sample: (outputs [..., K], noise [..., E]) -> action [..., A]; discrete: int32 [...]
    mode: (outputs [..., K]) -> action like ``sample``, the deterministic policy
    log_prob: (outputs [..., K], action [..., A]) -> [...], summed over entries
    entropy: (outputs [..., K]) -> [...], in nats
    num_scales: the last so many of ``num_outputs`` say how wide the distribution is
      and may come from a network of their own
    """

    num_outputs: int
    constants: tuple[float, ...]
    noise: Callable[[jax.Array, tuple[int, ...]], jax.Array]
    sample: Callable[[jax.Array, jax.Array], jax.Array]
    mode: Callable[[jax.Array], jax.Array]
    log_prob: Callable[[jax.Array, jax.Array], jax.Array]
    entropy: Callable[[jax.Array], jax.Array]
    num_scales: int = 0


def categorical(
    space: Box | Discrete, *, initial_std: float | None = None, rescale: bool = True
) -> Distribution:
    """A softmax over the actions of a discrete space; an action is an int32 [...].

    The noise is Gumbel, and the greatest sum of logit and noise is the sample
    (Maddison et al. 2014, "A* sampling").

    Args:
      space: how many actions there are.
      initial_std: taken so that all families are built alike, and not used.
      rescale: likewise.

    Raises:
      ValueError: the space is continuous.
    """
    del initial_std, rescale
    if not isinstance(space, Discrete):
        raise ValueError(
            "categorical needs a discrete action space, this one is continuous; choose normal"
        )
    size = space.num_actions

    def greatest(scores):
        return jnp.argmax(scores, axis=-1).astype(jnp.int32)

    def log_prob(outputs, action):
        chosen = jnp.arange(size) == action[..., None]
        return jnp.sum(jnp.where(chosen, jax.nn.log_softmax(outputs), 0.0), axis=-1)

    def entropy(outputs):
        log_probs = jax.nn.log_softmax(outputs)
        return -jnp.sum(jnp.exp(log_probs) * log_probs, axis=-1)

    return Distribution(
        num_outputs=size,
        constants=(),
        noise=lambda key, shape: jax.random.gumbel(key, (*shape, size)),
        sample=lambda outputs, noise: greatest(outputs + noise),
        mode=greatest,
        log_prob=log_prob,
        entropy=entropy,
    )
