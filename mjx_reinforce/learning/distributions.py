"""Distributions of actions, whose parameters a policy network computes from the observation.

A distribution is a tuple of pure functions. ``outputs`` [..., K] holds its parameters: first
``num_outputs`` entries that the network computes, then one for each of ``constants``, which are
trained and the same for all observations. Sampling has two steps, ``noise`` and ``sample``: the
noise depends on the key alone, so that every engine gets the same actions from the same key.

A family is one function of the action space, ``initial_std`` (the standard deviation before
training, in the action's unit: a number, or [A] for each entry) and ``rescale`` (whether the
network's output is scaled to the action's range). It raises ValueError for a space that it does not
support.

All Gaussian families are one: an independent Normal in each entry of the action, and what is done
to a sample of it. ``normal`` leaves it; those of ``bounded`` keep it within the action's range.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from mjx_reinforce.engine.base import Box, Discrete
from mjx_reinforce.engine.checks import check_number, known_number

LOG_SQRT_2PI = 0.5 * math.log(2.0 * math.pi)
_MIN_STD = 1e-6
#: The standard deviation before training, as a share of half the action's range, where none is
#: asked for. So a policy explores the same whatever unit its actions have.
_STD_SHARE = 0.5


class Distribution(NamedTuple):
    """A family of distributions over actions.

    Attributes:
      num_outputs: entries of ``outputs`` that the network computes
      constants: [K - num_outputs] initial values of the entries that are the same in every state
      noise: (key, shape) -> [*shape, E] the noise that ``sample`` transforms; consumes the key
      sample: (outputs [..., K], noise [..., E]) -> action [..., A]; discrete: int32 [...]
      mode: (outputs [..., K]) -> action like ``sample``, the deterministic policy
      log_prob: (outputs [..., K], action [..., A]) -> [...], summed over entries
      entropy: (outputs [..., K]) -> [...], in nats
      std: (outputs [..., K]) -> [..., A] the standard deviation in the action's unit, before what
        the family does to keep actions in their range; None where there is none
      kl: (outputs, other outputs) -> [...] the divergence KL(first || second) in nats, if known
      clip: (action) -> the nearest that the environment's bounds allow: what is played of a trained
        policy. Learners and loaded policies have it in their mode, too, see
        ``policy.within_bounds``; training draws actions that are not clipped

    Examples:
      >>> import jax, jax.numpy as jnp
      >>> import mjx_reinforce as mr
      >>> family = mr.categorical(mr.Discrete(3))
      >>> noise = family.noise(jax.random.key(0), (5,))
      >>> family.sample(jnp.zeros((5, 3)), noise).shape
      (5,)
    """

    num_outputs: int
    constants: tuple[float, ...]
    noise: Callable[[jax.Array, tuple[int, ...]], jax.Array]
    sample: Callable[[jax.Array, jax.Array], jax.Array]
    mode: Callable[[jax.Array], jax.Array]
    log_prob: Callable[[jax.Array, jax.Array], jax.Array]
    entropy: Callable[[jax.Array], jax.Array]
    std: Callable[[jax.Array], jax.Array] | None = None
    kl: Callable[[jax.Array, jax.Array], jax.Array] | None = None
    clip: Callable[[jax.Array], jax.Array] = lambda action: action

    def __repr__(self) -> str:
        return f"Distribution({self.num_outputs} outputs, {len(self.constants)} constants)"


def default_distribution(space: Box | Discrete) -> Distribution:
    """Returns a Normal with a trained std, or a categorical distribution if discrete."""
    return categorical(space) if isinstance(space, Discrete) else normal(space)


def normal(
    space: Box | Discrete,
    *,
    std: str = "parameter",
    initial_std: ArrayLike | None = None,
    rescale: bool = True,
) -> Distribution:
    """An independent Normal in each entry, unbounded.

    The mean is the middle of the action's range plus half the range times the
    network's output, so that outputs between -1 and 1 cover the range; in an unbounded
    entry the mean is the output itself. Samples may fall outside the bounds, and the
    environment decides what then happens (MuJoCo clamps them in the actuator).

    float32 tells a sample from its mean while the standard deviation is above some 1e-6 of the
    mean. Below, the gradient is rounding; below 1e-18 of it, NaN, and the update is skipped.

    Args:
      space: the action bounds, [A] each.
      std: "parameter" for one trained log-std an entry, the same in all states
        (Schulman et al. 2015, arXiv:1502.05477); "softplus" for log(1 + exp(o))
        of a second network output (Gymnasium's REINFORCE tutorial); "sigmoid" for
        1 / (1 + exp(-o)), which stays below 1.
      initial_std: the standard deviation before training, in the action's unit, of all entries or
        [A] of each; by default ``default_std(space)``, for "sigmoid" 0.5 at most.
      rescale: False takes the network's output as the mean itself.

    Returns:
      The distribution, with A ("parameter") or 2A network outputs.

    Raises:
      ValueError: the space is discrete, ``std`` is unknown, or ``initial_std`` is
        not positive or, for "sigmoid", not below 1.

    Examples:
      >>> import jax.numpy as jnp, numpy as np
      >>> import mjx_reinforce as mr
      >>> family = mr.normal(mr.Box(-np.ones(2), np.ones(2)))
      >>> outputs = jnp.append(jnp.zeros(2), jnp.asarray(family.constants))
      >>> family.mode(outputs).tolist(), family.log_prob(outputs, jnp.zeros(2)).shape
      ([0.0, 0.0], ())
    """
    gaussian = gaussian_outputs("normal", space, std, initial_std, rescale)
    return gaussian.family(
        sample=lambda noise, mean, std: mean + std * noise,
        mode=lambda mean: mean,
        log_density=normal_log_density,
        entropy=lambda mean, std: normal_entropy(std),
        kl=normal_kl,
    )


def normal_softplus(
    space: Box | Discrete, *, initial_std: ArrayLike | None = None, rescale: bool = True
) -> Distribution:
    """``normal`` with a state-dependent softplus standard deviation."""
    return normal(space, std="softplus", initial_std=initial_std, rescale=rescale)


def normal_sigmoid(
    space: Box | Discrete, *, initial_std: ArrayLike | None = None, rescale: bool = True
) -> Distribution:
    """``normal`` with a state-dependent sigmoid standard deviation, below 1."""
    return normal(space, std="sigmoid", initial_std=initial_std, rescale=rescale)


def categorical(
    space: Box | Discrete, *, initial_std: ArrayLike | None = None, rescale: bool = True
) -> Distribution:
    """A softmax over the actions of a discrete space; an action is an int32 [...].

    The noise is Gumbel. The sample is the action with the greatest sum of logit and
    noise (Maddison et al. 2014, "A* sampling"). The network has an output for each action.

    Examples:
      >>> import jax.numpy as jnp
      >>> import mjx_reinforce as mr
      >>> family = mr.categorical(mr.Discrete(2))
      >>> family.mode(jnp.asarray([0.0, 1.0])).item()
      1
    """
    # All families are called alike, see ``registry.DISTRIBUTIONS``; this one has no deviation.
    del initial_std, rescale
    check_space("categorical", space)
    if not isinstance(space, Discrete):
        raise ValueError(
            "categorical needs a discrete action space, this one is continuous; choose normal"
        )
    size = space.num_actions

    def greatest(scores):
        return jnp.argmax(scores, axis=-1).astype(jnp.int32)

    def log_prob(outputs, action):
        # By a mask and not by an index: the gradient of a gather is a scatter, slow on GPUs.
        is_taken = jnp.arange(size) == action[..., None]
        return jnp.sum(jnp.where(is_taken, jax.nn.log_softmax(outputs), 0.0), axis=-1)

    def entropy(outputs):
        log_probs = jax.nn.log_softmax(outputs)
        return -jnp.sum(jnp.exp(log_probs) * log_probs, axis=-1)

    def kl(outputs, other_outputs):
        log_probs = jax.nn.log_softmax(outputs)
        log_ratio = log_probs - jax.nn.log_softmax(other_outputs)
        return jnp.sum(jnp.exp(log_probs) * log_ratio, axis=-1)

    return Distribution(
        num_outputs=size,
        constants=(),
        noise=lambda key, shape: jax.random.gumbel(key, (*shape, size)),
        sample=lambda outputs, noise: greatest(outputs + noise),
        mode=greatest,
        log_prob=log_prob,
        entropy=entropy,
        kl=kl,
    )


class GaussianOutputs(NamedTuple):
    """Where the outputs hold the means and standard deviations of a family's Normals.

    box: the action bounds, [A] each
    std: "parameter", "softplus" or "sigmoid"
    initial_std: the standard deviation before training, of all entries or [A] of each
    middle: [A] the mean where the network's output is 0
    half: [A] what a network output of 1 adds to it
    """

    box: Box
    std: str
    initial_std: np.ndarray | jax.Array
    middle: np.ndarray
    half: np.ndarray

    @property
    def size(self) -> int:
        """A."""
        return len(self.middle)

    def mean(self, outputs: jax.Array) -> jax.Array:
        """Returns the means [..., A]."""
        return outputs[..., : self.size] * self.half + self.middle

    def split(self, outputs: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Returns the means and standard deviations, [..., A] each."""
        raw_std = outputs[..., self.size :]
        initial_std = self.initial_std
        # A fresh network's outputs are near 0; the added constants make the std initial_std there.
        if self.std == "parameter":
            std = jnp.exp(raw_std)
        elif self.std == "softplus":
            # Of a large std, exp would overflow; the logarithm is then the std itself.
            offset = np.where(
                initial_std < 30, np.log(np.expm1(np.minimum(initial_std, 30))), initial_std
            )
            std = jax.nn.softplus(raw_std + offset.astype(raw_std.dtype)) + _MIN_STD
        else:
            # The inverse of the sigmoid at the initial std.
            offset = np.log(initial_std / (1.0 - initial_std))
            std = jax.nn.sigmoid(raw_std + offset.astype(raw_std.dtype)) + _MIN_STD
        return self.mean(outputs), std

    def family(
        self,
        *,
        sample: Callable[..., Any],
        mode: Callable[..., Any],
        log_density: Callable[..., Any],
        entropy: Callable[..., Any],
        kl: Callable[..., Any],
        noise: Callable[..., Any] = jax.random.normal,
    ) -> Distribution:
        """Returns the distribution of independent entries.

        Args:
          sample: (noise, mean, std) -> action, [..., A] each.
          mode: (mean) -> action.
          log_density: (action, mean, std) -> the log-probability of each entry.
          entropy: (mean, std) -> that of each entry, in nats.
          kl: (mean, std, other mean, other std) -> that of each entry, in nats.
          noise: (key, shape) -> what ``sample`` transforms.
        """
        # The network computes mean and std, or the mean alone. The entries of an action are
        # independent, so log-densities, entropies and divergences are sums over them.
        num_outputs = 2 * self.size
        constants = ()
        if self.std == "parameter":
            num_outputs = self.size
            constants = _logs(self.initial_std, self.size)
        return Distribution(
            num_outputs=num_outputs,
            constants=constants,
            noise=lambda key, shape: noise(key, (*shape, self.size)),
            sample=lambda outputs, noise: sample(noise, *self.split(outputs)),
            mode=lambda outputs: mode(self.mean(outputs)),
            log_prob=lambda outputs, action: jnp.sum(
                log_density(action, *self.split(outputs)), axis=-1
            ),
            entropy=lambda outputs: jnp.sum(entropy(*self.split(outputs)), axis=-1),
            std=lambda outputs: self.split(outputs)[1],
            kl=lambda outputs, other_outputs: jnp.sum(
                kl(*self.split(outputs), *self.split(other_outputs)), axis=-1
            ),
        )


def gaussian_outputs(
    name: str, space: Box | Discrete, std: str, initial_std: ArrayLike | None, rescale: bool
) -> GaussianOutputs:
    """Checks the arguments of a Gaussian family and returns the layout of its outputs.

    Args:
      name: the family's name, for the messages.
      space: the action bounds, [A] each.
      std: "parameter", "softplus" or "sigmoid", as in ``normal``.
      initial_std: the standard deviation before training, in the action's unit, of all entries or
        [A] of each; for "parameter" it may be traced, and is then taken on trust. None:
        ``default_std``.
      rescale: False takes the network's output as the mean itself.

    Raises:
      ValueError: the space is discrete, ``std`` is unknown, or ``initial_std`` is not positive or,
        for "sigmoid", not below 1.
    """
    check_space(name, space)
    if not isinstance(space, Box):
        raise ValueError(
            f"{name} needs a continuous action space, this one is discrete; choose categorical"
        )
    if std not in ("parameter", "softplus", "sigmoid"):
        raise ValueError(f"std must be 'parameter', 'softplus' or 'sigmoid', got {std!r}")
    middle, half_range = middle_and_half_range(space)
    if initial_std is None:
        initial_std = default_std(space)
        # A sigmoid stays below 1, whatever the action's range.
        if std == "sigmoid":
            initial_std = np.minimum(initial_std, _STD_SHARE)
    std_shape = np.shape(initial_std)
    if std_shape not in ((), middle.shape):
        raise ValueError(
            f"initial_std must be a number, or {list(middle.shape)}, one for each entry, "
            f"got {initial_std}"
        )
    # One by one: an entry may be traced, and is then taken on trust.
    for entry_std in initial_std if std_shape else (initial_std,):  # type: ignore[union-attr]
        check_number("initial_std", entry_std, positive=True)
        known_std = known_number(entry_std)
        if std == "sigmoid" and known_std is not None and known_std >= 1:
            raise ValueError(
                f"a sigmoid std stays below 1, got initial_std={known_std}, in the action's unit; "
                "give a smaller one, or choose normal"
            )
    if not rescale:
        middle = np.zeros_like(middle)
        half_range = np.ones_like(half_range)
    if not isinstance(initial_std, jax.core.Tracer):
        initial_std = np.asarray(initial_std, float)
    return GaussianOutputs(space, std, initial_std, middle, half_range)


def default_std(space: Box) -> np.ndarray:
    """Returns half of half the range of each entry, [A]; 0.5 where it is not bounded."""
    return _STD_SHARE * middle_and_half_range(space)[1].astype(float)


def _logs(std: Any, size: int) -> tuple[Any, ...]:
    """Returns the logarithms of standard deviations, rounded once where they are known."""
    if isinstance(std, jax.core.Tracer):
        return tuple(jnp.broadcast_to(jnp.log(std), size))
    return tuple(np.broadcast_to(np.log(std), size).tolist())


def normal_log_density(x: jax.Array, mean: jax.Array, std: jax.Array) -> jax.Array:
    """Returns the log-density [...] of a Normal at ``x``, entry by entry."""
    return -0.5 * ((x - mean) / std) ** 2 - jnp.log(std) - LOG_SQRT_2PI


def normal_entropy(std: jax.Array) -> jax.Array:
    """Returns the entropy [...] of a Normal in nats, entry by entry."""
    return jnp.log(std) + 0.5 + LOG_SQRT_2PI


def normal_kl(
    mean: jax.Array, std: jax.Array, other_mean: jax.Array, other_std: jax.Array
) -> jax.Array:
    """Returns KL(Normal(mean, std) || Normal(other_mean, other_std)) [...] in nats.

    That is log(q / p) + (p^2 + d^2) / (2 q^2) - 1/2 with the standard deviations p and q and the
    means d apart, arranged so that nearly equal ones do not cancel.
    """
    log_ratio = jnp.log(std / other_std)
    # What the standard deviations contribute: p^2 / (2 q^2) - 1/2 is half expm1(2 log(p / q)).
    width = 0.5 * jnp.expm1(2.0 * log_ratio) - log_ratio
    return width + 0.5 * ((mean - other_mean) / other_std) ** 2


def check_space(name: str, space: Box | Discrete) -> None:
    """Raises ValueError for what is no action space."""
    if not isinstance(space, Box | Discrete):
        raise ValueError(
            f"{name} needs an action space, such as env.action_space, or mjx_reinforce.Box(low, "
            f"high) with arrays [A], got a {type(space).__name__}"
        )


def middle_and_half_range(space: Box) -> tuple[np.ndarray, np.ndarray]:
    """Returns the center and half the width of each entry's range, [A] each.

    They are 0 and 1 for an entry that is not bounded on both sides.
    """
    low = np.asarray(space.low, np.float32)
    high = np.asarray(space.high, np.float32)
    # The range [-1, 1] has the center 0 and the half width 1.
    is_bounded = np.isfinite(low) & np.isfinite(high)
    low = np.where(is_bounded, low, -1.0)
    high = np.where(is_bounded, high, 1.0)
    return (low + high) / 2, (high - low) / 2
