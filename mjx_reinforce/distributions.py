"""Action distributions, indexed by the outputs of a policy network.

A distribution is a tuple of pure functions. ``outputs`` [..., K] holds its
parameters: first ``num_outputs`` entries that the network computes from the
observation, then one for each of ``constants``, trained but the same in every
state. Sampling is split in two, ``noise`` and ``sample``, so that every engine
draws the same actions from the same key: noise may be drawn far from where it
is used.

Every family below takes the action space, ``initial_std``, the standard deviation
before training in the action's unit, and ``rescale``, so that all can be built
alike. A family that does not suit the space raises ValueError.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mjx_reinforce import truncated_normal as tn
from mjx_reinforce.types import Box, Discrete

_LOG_SQRT_2PI = 0.5 * float(np.log(2.0 * np.pi))
_MIN_STD = 1e-6
#: ``tanh_normal`` records what it draws beyond the first, before the tanh, as the second.
_SATURATED, _SATURATION = 5.0, 6.0


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


def normal(
    space: Box | Discrete,
    *,
    std: str = "parameter",
    initial_std: float = 0.5,
    rescale: bool = True,
) -> Distribution:
    """An independent Normal in each entry, unbounded.

    The mean is the middle of the action's range plus half the range times the
    network's output, so that an output of order one uses the range; unbounded
    entries are taken as they are. Samples may fall outside the bounds: the
    environment, not the policy, decides what that means (MuJoCo clamps inside
    the actuator).

    Args:
      space: the action bounds, [A] each.
      std: "parameter" for one trained log-std an entry, the same in all states
        (Schulman et al. 2015, arXiv:1502.05477); "softplus" for log(1 + exp(o))
        of a second network output (Gymnasium's REINFORCE tutorial); "sigmoid" for
        1 / (1 + exp(-o)), which stays below 1.
      initial_std: the standard deviation before training, in the action's unit.
      rescale: False takes the network's output as the mean itself.

    Returns:
      The distribution, with A ("parameter") or 2A network outputs.

    Raises:
      ValueError: the space is discrete, ``std`` is unknown, or ``initial_std`` is
        not positive or, for "sigmoid", not below 1.
    """
    base = _gaussian("normal", space, std, initial_std, rescale)

    def sample(outputs, noise):
        mean, scale = base.split(outputs)
        return mean + scale * noise

    def log_prob(outputs, action):
        return jnp.sum(_normal_log_density(action, *base.split(outputs)), axis=-1)

    def entropy(outputs):
        return jnp.sum(_normal_entropy(base.split(outputs)[1]), axis=-1)

    return base.distribution(sample, lambda outputs: base.split(outputs)[0], log_prob, entropy)


def normal_softplus(
    space: Box | Discrete, *, initial_std: float = 0.5, rescale: bool = True
) -> Distribution:
    """``normal`` with a state-dependent softplus standard deviation."""
    return normal(space, std="softplus", initial_std=initial_std, rescale=rescale)


def normal_sigmoid(
    space: Box | Discrete, *, initial_std: float = 0.5, rescale: bool = True
) -> Distribution:
    """``normal`` with a state-dependent sigmoid standard deviation, below 1."""
    return normal(space, std="sigmoid", initial_std=initial_std, rescale=rescale)


def truncated_normal(
    space: Box | Discrete,
    *,
    std: str = "parameter",
    initial_std: float = 0.5,
    rescale: bool = True,
) -> Distribution:
    """An independent Normal in each entry, restricted to the action's range.

    Density, entropy, their gradients and the sampling by inverse distribution
    function stay exact when the mean runs far out of the range; see
    ``mjx_reinforce.truncated_normal``. The noise is uniform in (0, 1).

    Args:
      space: the action bounds, [A] each, finite.
      std: of the Normal before it is restricted, as in ``normal``.
      initial_std: likewise.
      rescale: False takes the network's output as the mean itself.

    Raises:
      ValueError: as in ``normal``, or an entry is unbounded.
    """
    base = _gaussian("truncated-normal", space, std, initial_std, rescale)
    box = _finite_box("truncated-normal", space)

    def sample(outputs, noise):
        return tn.transform(noise, *base.split(outputs), *_bounds(box, outputs))

    def mode(outputs):
        return jnp.clip(base.split(outputs)[0], *_bounds(box, outputs))

    def log_prob(outputs, action):
        return jnp.sum(
            tn.log_density(action, *base.split(outputs), *_bounds(box, outputs)), axis=-1
        )

    def entropy(outputs):
        return jnp.sum(tn.entropy(*base.split(outputs), *_bounds(box, outputs)), axis=-1)

    return base.distribution(sample, mode, log_prob, entropy, noise=_open_uniform)


def clipped_normal(
    space: Box | Discrete,
    *,
    std: str = "parameter",
    initial_std: float = 0.5,
    rescale: bool = True,
) -> Distribution:
    """An independent Normal in each entry, clipped to the action's range.

    The environment sees only the clipped action, so its probability is what
    counts: a density inside, and at a bound the mass Phi of all that was clipped
    to it. That is the gradient of ``normal`` with less variance (Fujita and Maeda
    2018, arXiv:1802.07564, equation 8). The entropy is that of the clipped
    variable, -E[log_prob]: the integral inside and the two masses' terms.

    Args:
      space: the action bounds, [A] each, finite.
      std: of the Normal before it is clipped, as in ``normal``.
      initial_std: likewise.
      rescale: False takes the network's output as the mean itself.

    Raises:
      ValueError: as in ``normal``, or an entry is unbounded.
    """
    base = _gaussian("clipped-normal", space, std, initial_std, rescale)
    box = _finite_box("clipped-normal", space)

    def sample(outputs, noise):
        mean, scale = base.split(outputs)
        return jnp.clip(mean + scale * noise, *_bounds(box, outputs))

    def mode(outputs):
        return jnp.clip(base.split(outputs)[0], *_bounds(box, outputs))

    def log_prob(outputs, action):
        mean, scale = base.split(outputs)
        low, high = _bounds(box, outputs)
        inside = _normal_log_density(action, mean, scale)
        below, above = tn.log_tail((mean - low) / scale), tn.log_tail((high - mean) / scale)
        value = jnp.where(action <= low, below, jnp.where(action >= high, above, inside))
        return jnp.sum(value, axis=-1)

    def entropy(outputs):
        mean, scale = base.split(outputs)
        return jnp.sum(_clipped_entropy(mean, scale, *_bounds(box, outputs)), axis=-1)

    return base.distribution(sample, mode, log_prob, entropy)


def tanh_normal(
    space: Box | Discrete,
    *,
    std: str = "parameter",
    initial_std: float = 0.5,
    rescale: bool = True,
) -> Distribution:
    """A Normal squashed onto the action's range by a tanh (Haarnoja et al. 2018, appendix C).

    The action is middle + half tanh(z), half z drawn from ``normal`` about the
    middle: small deviations come out as they went in. ``log_prob`` recovers z
    from the action. That is exact to a thousandth of a standard unit up to
    |z| = 5, within 5e-5 of the range from a bound; all beyond is recorded as one
    outcome a side, z = 6, and counted with its probability, so that the score has
    mean zero however far the policy saturates.

    ``mode`` is the tanh of the mean: the median, as usual, not the densest point.
    ``entropy`` is that of the Normal plus E[log(1 - tanh(z)^2)] by Gauss-Hermite
    quadrature, exact to 1e-7 nats up to a standard deviation of 1 in z, 3e-3 at 3.

    Args:
      space: the action bounds, [A] each, finite.
      std: of the Normal before the tanh, as in ``normal``.
      initial_std: likewise.
      rescale: False takes the network's output as the mean itself.

    Raises:
      ValueError: as in ``normal``, or an entry is unbounded.
    """
    base = _gaussian("tanh-normal", space, std, initial_std, rescale)
    middle, half = _middle_and_half_range(_finite_box("tanh-normal", space))
    nodes, weights = np.polynomial.hermite_e.hermegauss(32)
    rule = list(zip(nodes.tolist(), (weights / np.sum(weights)).tolist(), strict=True))

    def split(outputs):
        mean, scale = base.split(outputs)
        return (mean - middle) / half, scale / half

    def sample(outputs, noise):
        mean, scale = split(outputs)
        z = mean + scale * noise
        z = jnp.where(jnp.abs(z) < _SATURATED, z, jnp.sign(z) * _SATURATION)
        return middle + half * jnp.tanh(z)

    def log_prob(outputs, action):
        mean, scale = split(outputs)
        squashed = (action - middle) / half
        saturated = jnp.abs(squashed) > 0.5 * (np.tanh(_SATURATED) + np.tanh(_SATURATION))
        z = jnp.arctanh(jnp.where(saturated, 0.0, squashed))
        inside = _normal_log_density(z, mean, scale) - _log_tanh_slope(z) - np.log(half)
        beyond = tn.log_tail((_SATURATED - jnp.sign(squashed) * mean) / scale)
        return jnp.sum(jnp.where(saturated, beyond, inside), axis=-1)

    def entropy(outputs):
        mean, scale = split(outputs)
        slopes = [w * _log_tanh_slope(mean + scale * x) for x, w in rule]
        return jnp.sum(_normal_entropy(scale) + sum(slopes) + np.log(half), axis=-1)

    def mode(outputs):
        return middle + half * jnp.tanh(split(outputs)[0])

    return base.distribution(sample, mode, log_prob, entropy)


def deterministic(
    space: Box | Discrete, *, initial_std: float | None = None, rescale: bool = True
) -> Distribution:
    """A point: the action is the output, rescaled as the mean of ``normal``.

    For methods that need no likelihood, such as ``ars``; ``log_prob`` raises
    ValueError.

    Args:
      space: the action bounds, [A] each.
      initial_std: taken so that all families are built alike, and not used.
      rescale: False takes the network's output as the action itself.
    """
    del initial_std
    base = _gaussian("deterministic", space, "parameter", 1.0, rescale)

    def mode(outputs):
        return base.mean(outputs)

    def log_prob(outputs, action):
        raise ValueError(
            "a deterministic policy has no log-probability; choose a stochastic one for REINFORCE"
        )

    return Distribution(
        num_outputs=base.size,
        constants=(),
        noise=lambda key, shape: jnp.zeros((*shape, 1)),
        sample=lambda outputs, noise: mode(outputs),
        mode=mode,
        log_prob=log_prob,
        entropy=lambda outputs: jnp.zeros(outputs.shape[:-1], outputs.dtype),
    )


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


class _Gaussian(NamedTuple):
    """How the outputs hold the means and standard deviations of a family's Normals.

    size: A
    std: "parameter", "softplus" or "sigmoid"
    initial_std: the standard deviation before training
    middle: [A] the mean at output 0
    half: [A] what an output of 1 adds to it
    """

    size: int
    std: str
    initial_std: float
    middle: np.ndarray
    half: np.ndarray

    def mean(self, outputs: jax.Array) -> jax.Array:
        """Returns the means [..., A]."""
        return outputs[..., : self.size] * self.half + self.middle

    def split(self, outputs: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Returns the means and standard deviations, [..., A] each."""
        raw, initial = outputs[..., self.size :], self.initial_std
        # The shifts make the std equal initial_std at output 0, where a fresh network starts.
        if self.std == "parameter":
            std = jnp.exp(raw)
        elif self.std == "softplus":
            std = jax.nn.softplus(raw + float(np.log(np.expm1(initial)))) + _MIN_STD
        else:
            std = jax.nn.sigmoid(raw + float(np.log(initial / (1.0 - initial)))) + _MIN_STD
        return self.mean(outputs), std

    def distribution(self, sample, mode, log_prob, entropy, noise=None) -> Distribution:
        """Returns the distribution; its noise is standard Normal unless given."""
        constant = self.std == "parameter"
        draw = jax.random.normal if noise is None else noise
        return Distribution(
            num_outputs=self.size if constant else 2 * self.size,
            constants=(float(np.log(self.initial_std)),) * self.size if constant else (),
            noise=lambda key, shape: draw(key, (*shape, self.size)),
            sample=sample,
            mode=mode,
            log_prob=log_prob,
            entropy=entropy,
            num_scales=0 if constant else self.size,
        )


def _gaussian(
    name: str, space: Box | Discrete, std: str, initial_std: float, rescale: bool
) -> _Gaussian:
    """Checks what all Gaussian families require, and lays out their outputs."""
    if not isinstance(space, Box):
        raise ValueError(
            f"{name} needs a continuous action space, this one is discrete; choose categorical"
        )
    if std not in ("parameter", "softplus", "sigmoid"):
        raise ValueError(f"std must be 'parameter', 'softplus' or 'sigmoid', got {std!r}")
    if not (np.isfinite(initial_std) and initial_std > 0):
        raise ValueError(f"initial_std must be positive and finite, got {initial_std}")
    if std == "sigmoid" and initial_std >= 1:
        raise ValueError(f"a sigmoid std stays below 1, got initial_std={initial_std}")
    size = len(space.low)
    middle, half = np.zeros(size, np.float32), np.ones(size, np.float32)
    if rescale:
        middle, half = _middle_and_half_range(space)
    return _Gaussian(size, std, initial_std, middle, half)


def _finite_box(name: str, space: Box | Discrete) -> Box:
    """Returns the action space if its bounds are finite, else raises ValueError."""
    if not isinstance(space, Box) or not np.all(np.isfinite(space.low) & np.isfinite(space.high)):
        raise ValueError(
            f"{name} needs finite action bounds, got {space}; "
            "choose normal, or declare bounds in the environment's action_space"
        )
    return space


def _bounds(box: Box, like: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Returns the bounds, [A] each, in the dtype of ``like``."""
    return jnp.asarray(box.low, like.dtype), jnp.asarray(box.high, like.dtype)


def _normal_log_density(x: jax.Array, mean: jax.Array, std: jax.Array) -> jax.Array:
    return -0.5 * ((x - mean) / std) ** 2 - jnp.log(std) - _LOG_SQRT_2PI


def _normal_entropy(std: jax.Array) -> jax.Array:
    return jnp.log(std) + 0.5 + _LOG_SQRT_2PI


def _clipped_entropy(mean: jax.Array, std: jax.Array, low: jax.Array, high: jax.Array) -> jax.Array:
    """Returns the entropy of a clipped Normal entry by entry.

    Inside, -log_prob is x^2 / 2 + log(std sqrt(2 pi)) with x = (action - mean) / std, and the
    integral of x^2 phi is P + a phi(a) - b phi(b) with P the probability.
    """
    a, b = (low - mean) / std, (high - mean) / std
    log_below, log_above = tn.log_tail(-a), tn.log_tail(b)
    below, above = jnp.exp(log_below), jnp.exp(log_above)
    edges = b * jnp.exp(-0.5 * b**2 - _LOG_SQRT_2PI) - a * jnp.exp(-0.5 * a**2 - _LOG_SQRT_2PI)
    inside = (1.0 - below - above) * _normal_entropy(std) - 0.5 * edges
    return inside - below * log_below - above * log_above


def _log_tanh_slope(z: jax.Array) -> jax.Array:
    """Returns log(1 - tanh(z)^2) without cancellation."""
    return 2.0 * (float(np.log(2.0)) - z - jax.nn.softplus(-2.0 * z))


def _open_uniform(key: jax.Array, shape: tuple[int, ...]) -> jax.Array:
    """Returns uniform noise that is never 0 or 1: the middles of the generator's cells."""
    noise = jax.random.uniform(key, shape)
    return noise + 0.5 * jnp.finfo(noise.dtype).eps


def _middle_and_half_range(space: Box) -> tuple[np.ndarray, np.ndarray]:
    """Returns the centre and half the width of each bounded entry, 0 and 1 for the others."""
    low, high = np.asarray(space.low, np.float32), np.asarray(space.high, np.float32)
    bounded = np.isfinite(low) & np.isfinite(high)
    low, high = np.where(bounded, low, -1.0), np.where(bounded, high, 1.0)
    return (low + high) / 2, (high - low) / 2
