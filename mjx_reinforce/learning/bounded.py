"""Gaussian families that keep actions in a finite range: through a tanh, or truncated.

They need integrals of the Normal density over an interval, accurate even far out in its tails: a
truncated Normal needs ratios of them. Far from the mean both terms of a ratio are 0 in
floating point, and so is the usual difference of two distribution functions (Burkardt 2014, "The
truncated normal distribution"). Here every integral is taken relative to the density at an anchor:
the mean, or the bound next to it if the mean is outside the interval. With c the distance from the
mean to the anchor and t that from the anchor to x, both in standard deviations,

    exp(-x^2 / 2) = exp(-c^2 / 2) exp(-t^2 / 2 - c t),    x = c + t.

The first factor, which underflows, cancels in every ratio. What remains are integrals of the second
factor. Those over a half-line,

    F_n(c) = integral from 0 to infinity of t^n exp(-t^2 / 2 - c t) dt,

of which F_0 is the Mills ratio, are computed by Chebyshev series in (4 - c) / (4 + c), after
Shepherd and Laframboise (1981), "Chebyshev approximation of (1 + 2x) exp(x^2) erfc x in
0 <= x < infinity". A series needs only sums, products and quotients.
"""

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from numpy.polynomial import legendre

from mjx_reinforce.engine.base import Box, Discrete
from mjx_reinforce.learning.distributions import (
    LOG_SQRT_2PI,
    Distribution,
    GaussianOutputs,
    gaussian_outputs,
    middle_and_half_range,
    normal_entropy,
    normal_kl,
    normal_log_density,
)

# float32 cannot recover a z much beyond this from tanh(z).
_MAX_Z = 5.0
# Samples beyond ``_MAX_Z`` are all recorded as this.
_SATURATED_Z = 6.0
# The least standard deviation of z: float32 recovers z from tanh(z) to 1e-3 or better.
_LEAST_TANH_STD = 0.005
_SERIES_PIVOT = 4.0
# A bound farther away, in standard deviations, is treated as this far: it cuts off nothing either
# way, and the square stays finite in float32.
_MAX_C = 1e9


def tanh_normal(
    space: Box | Discrete,
    *,
    std: str = "parameter",
    initial_std: ArrayLike | None = None,
    rescale: bool = True,
) -> Distribution:
    """``normal`` through a tanh into the action's finite range (Haarnoja et al. 2018, appendix C).

    The action is middle + half tanh(z), where middle + half z is a sample of ``normal``:
    a small deviation from the middle is hardly changed. ``log_prob`` recovers z from the
    action, to a thousandth of a standard unit up to |z| = 5, which is within 5e-5 of the
    range from a bound. Samples beyond are all recorded as z = 6 or -6 and counted with
    the probability of that whole tail, so the expected score is zero however far the
    policy saturates. For that z must vary by more than float32 loses: a standard deviation below
    0.005 in z, a two-hundredth of half the range, is 0.005.

    ``kl`` is that of the Normals of z: exact, but that in the tails beyond 5 it also counts what no
    action shows. ``mode`` is the tanh of the mean: the median, as is usual, not the densest point.
    ``entropy`` is exact to 1e-7 nats up to a standard deviation of 1 in z, 3e-3 at 3.

    Examples:
      >>> import numpy as np
      >>> import mjx_reinforce as mr
      >>> mr.tanh_normal(mr.Box(-np.ones(2), np.ones(2)))
      Distribution(2 outputs, 2 constants)
    """
    gaussian = _bounded_outputs("tanh-normal", space, std, initial_std, rescale)
    middle, half_range = middle_and_half_range(gaussian.box)
    min_std = _LEAST_TANH_STD * half_range
    initial_std = gaussian.initial_std
    if isinstance(initial_std, np.ndarray) and np.any(initial_std < min_std):
        rounded = [float(f"{x:.6g}") for x in min_std]
        raise ValueError(
            f"tanh-normal needs an initial_std of {_LEAST_TANH_STD} of half the action's range or "
            f"more, here {rounded}, got {initial_std.tolist()}; or choose truncated-normal"
        )

    # The network's Normal is in the action's unit, as that of ``normal``; z is in half ranges.
    def to_z(mean, std):
        return (mean - middle) / half_range, jnp.maximum(std / half_range, _LEAST_TANH_STD)

    def sample(noise, mean, std):
        mean, std = to_z(mean, std)
        z = mean + std * noise
        # A saturated sample stands for the whole tail, whose probability ``log_prob`` then gives.
        z = jnp.where(jnp.abs(z) < _MAX_Z, z, jnp.sign(z) * _SATURATED_Z)
        return middle + half_range * jnp.tanh(z)

    def kl(mean, std, other_mean, other_std):
        # A one-to-one map of both variables leaves a divergence as it is.
        return normal_kl(*to_z(mean, std), *to_z(other_mean, other_std))

    family = gaussian.family(
        sample=sample,
        mode=lambda mean: middle + half_range * jnp.tanh((mean - middle) / half_range),
        log_density=lambda action, mean, std: _tanh_log_density(
            (action - middle) / half_range, *to_z(mean, std), half_range
        ),
        entropy=lambda mean, std: _tanh_entropy(*to_z(mean, std), half_range),
        kl=kl,
    )
    return family._replace(std=lambda outputs: half_range * to_z(*gaussian.split(outputs))[1])


def _tanh_log_density(
    squashed: jax.Array, mean: jax.Array, std: jax.Array, half_range: np.ndarray
) -> jax.Array:
    """Returns the log-probability [..., A] of half_range * tanh(z), where z is Normal.

    Args:
      squashed: [..., A] tanh(z).
      mean: [..., A] of z.
      std: [..., A] of z.
      half_range: [A] half the width of the action's range.
    """
    # No sample lies between the two values of tanh, so rounding cannot confuse the cases.
    saturated = jnp.abs(squashed) > 0.5 * (np.tanh(_MAX_Z) + np.tanh(_SATURATED_Z))
    # 0 in place of a saturated value, whose infinite slope would make the gradient NaN, though
    # ``where`` takes the other case.
    z = jnp.arctanh(jnp.where(saturated, 0.0, squashed))
    # The change of variables: the density of z over the slope of half tanh(z).
    log_density = normal_log_density(z, mean, std) - _log_tanh_slope(z) - np.log(half_range)
    log_tail_mass = log_tail((_MAX_Z - jnp.sign(squashed) * mean) / std)
    return jnp.where(saturated, log_tail_mass, log_density)


def _tanh_entropy(mean: jax.Array, std: jax.Array, half_range: np.ndarray) -> jax.Array:
    """Returns the differential entropy [..., A] in nats of half_range * tanh(z), as above.

    It is the entropy of z plus E[log(1 - tanh(z)^2)] + log(half_range), the expectation by
    Gauss-Hermite quadrature.
    """
    nodes, weights = np.polynomial.hermite_e.hermegauss(32)
    # Its weights belong to exp(-x^2 / 2); over their sum, sqrt(2 pi), they are probabilities.
    quadrature = zip(nodes.tolist(), (weights / np.sum(weights)).tolist(), strict=True)
    slopes = [weight * _log_tanh_slope(mean + std * node) for node, weight in quadrature]
    return normal_entropy(std) + sum(slopes) + np.log(half_range)


def _log_tanh_slope(z: jax.Array) -> jax.Array:
    """Returns log(1 - tanh(z)^2) [...] without cancellation."""
    return 2.0 * (float(np.log(2.0)) - z - jax.nn.softplus(-2.0 * z))


def truncated_normal(
    space: Box | Discrete,
    *,
    std: str = "parameter",
    initial_std: ArrayLike | None = None,
    rescale: bool = True,
) -> Distribution:
    """``normal``, restricted to the action's range, which must be finite.

    Density, entropy, KL and their gradients stay exact when the mean is far outside the range, and
    so does the sampling, by the inverse distribution function. The noise is uniform in (0, 1).

    Examples:
      >>> import numpy as np
      >>> import mjx_reinforce as mr
      >>> mr.truncated_normal(mr.Box(-np.ones(2), np.ones(2)))
      Distribution(2 outputs, 2 constants)
    """
    gaussian = _bounded_outputs("truncated-normal", space, std, initial_std, rescale)

    def restricted(function):
        """Returns a function that hands the bounds on, after its own arguments."""
        return lambda *arguments: function(*arguments, *_bounds(gaussian, arguments[-1]))

    return gaussian.family(
        sample=restricted(truncated_sample),
        mode=restricted(jnp.clip),
        log_density=restricted(truncated_log_density),
        entropy=restricted(truncated_entropy),
        kl=restricted(truncated_kl),
        noise=_open_uniform,
    )


def _open_uniform(key: jax.Array, shape: tuple[int, ...]) -> jax.Array:
    """Returns uniform noise that is never 0 or 1.

    The generator returns multiples of the dtype's epsilon, 0 among them; half an
    epsilon is added.
    """
    noise = jax.random.uniform(key, shape)
    return noise + 0.5 * jnp.finfo(noise.dtype).eps


def _bounded_outputs(
    name: str, space: Box | Discrete, std: str, initial_std: ArrayLike | None, rescale: bool
) -> GaussianOutputs:
    """Returns ``gaussian_outputs``; raises ValueError besides where an entry is unbounded."""
    gaussian = gaussian_outputs(name, space, std, initial_std, rescale)
    if not np.all(np.isfinite(gaussian.box.low) & np.isfinite(gaussian.box.high)):
        raise ValueError(
            f"{name} needs finite action bounds, got {space}; "
            "choose normal, or declare bounds in the environment's action_space"
        )
    return gaussian


def _bounds(gaussian: GaussianOutputs, outputs: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Returns the lower and upper bounds, [A] each, in the dtype of ``outputs``."""
    return jnp.asarray(gaussian.box.low, outputs.dtype), jnp.asarray(
        gaussian.box.high, outputs.dtype
    )


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def half_line(order: int, c: jax.Array) -> jax.Array:
    """Returns F_n(c) for c >= 0, to a few units in the last place; its derivative is -F_{n+1}(c).

    Args:
      order: n.
      c: [...] distance of the anchor from the mean, in standard deviations.
    """
    coefficients = _series(order, float(jnp.finfo(c.dtype).eps))
    # From [0, inf) to (-1, 1], where Chebyshev polynomials live.
    series_argument = (_SERIES_PIVOT - c) / (_SERIES_PIVOT + c)
    # Clenshaw's recurrence, from the highest coefficient down to the second.
    term = previous_term = jnp.zeros_like(c)
    for coefficient in coefficients[:0:-1]:
        next_term = 2.0 * series_argument * term - previous_term + coefficient
        previous_term = term
        term = next_term
    series_sum = series_argument * term - previous_term + coefficients[0]
    # The series is that of (1 + c)^(n + 1) F_n(c), which stays finite for all c.
    scale = 1.0 / (1.0 + c)
    return series_sum * scale ** (order + 1)


@half_line.defjvp
def _half_line_jvp(order, primals, tangents):
    (c,) = primals
    (slope,) = tangents
    return half_line(order, c), -half_line(order + 1, c) * slope


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def segment(order: int, c: jax.Array, width: jax.Array) -> jax.Array:
    """Returns the integral of t^n exp(-t^2 / 2 - c t) over t from 0 to ``width``.

    A long segment is the difference of two half-lines. If the density falls by less than a factor e
    over the segment, that difference would cancel; there Gauss-Legendre quadrature is used, whose
    error is below the rounding error.

    Args:
      order: n.
      c: [...] at least 0, except that it may be anything where ``width`` is 0.
      width: [...] at least 0.
    """
    c = jnp.maximum(c, 0.0)
    width = jnp.minimum(width, _MAX_C)
    # Minus the logarithm of the factor by which the density falls over the segment.
    log_drop = width * (0.5 * width + c)
    is_short = log_drop < 1.0
    # What lies beyond the segment: the half-line from t = width, with t = width + u and the
    # binomial theorem for t^n.
    tail_integral = sum(
        math.comb(order, k) * width ** (order - k) * half_line(k, c + width)
        for k in range(order + 1)
    )
    difference = half_line(order, c) - jnp.exp(-log_drop) * tail_integral
    # 0 where the result is not used, so that nothing there overflows.
    width = jnp.where(is_short, width, 0.0)
    nodes, weights = _legendre(6 if c.dtype == jnp.float32 else 12)
    quadrature = sum(
        weight * node**order * jnp.exp(-node * width * (0.5 * node * width + c))
        for node, weight in zip(nodes.tolist(), weights.tolist(), strict=True)
    )
    return jnp.where(is_short, quadrature * width ** (order + 1), difference)


@segment.defjvp
def _segment_jvp(order, primals, tangents):
    c, width = primals
    c_slope, width_slope = tangents
    # In ``width`` the derivative is the integrand there, in c minus the next integral.
    edge_slope = jnp.minimum(width, _MAX_C) ** order * jnp.exp(-width * (0.5 * width + c))
    slope = edge_slope * width_slope - segment(order + 1, c, width) * c_slope
    return segment(order, c, width), slope


def log_tail(x: jax.Array) -> jax.Array:
    """Returns the log-probability [...] that a standard Normal exceeds ``x`` [...]."""
    upper = x >= 0
    distance = jnp.where(upper, x, -x)
    # Of the smaller tail, which is exact; the larger is one minus it.
    log_small = -0.5 * distance**2 + jnp.log(half_line(0, distance)) - LOG_SQRT_2PI
    return jnp.where(upper, log_small, jnp.log1p(-jnp.exp(log_small)))


def anchor(
    mean: jax.Array, std: jax.Array, low: jax.Array, high: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """Returns the anchor, its distance c from the mean, and those to the lower and upper bound.

    The anchor is the truncated Normal's mode: the mean, and then c is 0, or the bound next to it.
    The distances are in standard deviations. The results of the functions below do not depend on
    which point is the anchor, so no gradient is taken through it.
    """
    mode = jax.lax.stop_gradient(jnp.clip(mean, low, high))
    return mode, (mode - mean) / std, (mode - low) / std, (high - mode) / std


def truncated_log_density(
    action: jax.Array, mean: jax.Array, std: jax.Array, low: jax.Array, high: jax.Array
) -> jax.Array:
    """Returns the log-density [...] of a Normal restricted to [low, high]; -inf outside."""
    mode, c, to_low, to_high = anchor(mean, std, low, high)
    t = (action - mode) / std
    # One of the two segments has no width, unless c is 0.
    mass = segment(0, -c, to_low) + segment(0, c, to_high)
    log_density = -t * (0.5 * t + c) - jnp.log(std) - jnp.log(mass)
    return jnp.where((action >= low) & (action <= high), log_density, -jnp.inf)


def truncated_entropy(
    mean: jax.Array, std: jax.Array, low: jax.Array, high: jax.Array
) -> jax.Array:
    """Returns the differential entropy [...] in nats of a Normal restricted to [low, high].

    It is log(std W) + E[t^2 / 2 + c t], where W is the integral of exp(-t^2 / 2 - c t) between the
    bounds. By partial integration the expectation is (1 + c E[t] - boundary terms) / 2, and these
    terms stay of order one far out.
    """
    _, c, to_low, to_high = anchor(mean, std, low, high)
    mass = segment(0, -c, to_low) + segment(0, c, to_high)
    # E[t]: to the left of the anchor t is negative, and c has the other sign.
    offset = (segment(1, c, to_high) - segment(1, -c, to_low)) / mass
    # The boundary terms: the distance of each bound times the relative density there.
    low_term = to_low * jnp.exp(-to_low * (0.5 * to_low - c))
    high_term = to_high * jnp.exp(-to_high * (0.5 * to_high + c))
    boundary_terms = low_term + high_term
    return jnp.log(std) + jnp.log(mass) + 0.5 * (1.0 + c * offset - boundary_terms / mass)


def truncated_kl(
    mean: jax.Array,
    std: jax.Array,
    other_mean: jax.Array,
    other_std: jax.Array,
    low: jax.Array,
    high: jax.Array,
) -> jax.Array:
    """Returns KL(first || second) [...] in nats of two Normals restricted to [low, high].

    With t as above of the first, and r t + a that of the second, it is log(s' W' / (s W)) plus the
    mean under the first of (r t + a)^2 / 2 + c' (r t + a) - t^2 / 2 - c t. The terms are small
    where the two are nearly equal.
    """
    mode, c, to_low, to_high = anchor(mean, std, low, high)
    other_mode, other_c, other_to_low, other_to_high = anchor(other_mean, other_std, low, high)
    # W and W' of the docstring, then E[t] and E[t^2] under the first.
    mass = segment(0, -c, to_low) + segment(0, c, to_high)
    other_mass = segment(0, -other_c, other_to_low) + segment(0, other_c, other_to_high)
    offset = (segment(1, c, to_high) - segment(1, -c, to_low)) / mass
    second_moment = (segment(2, c, to_high) + segment(2, -c, to_low)) / mass
    # r and a of the docstring.
    ratio = std / other_std
    shift = (mode - other_mode) / other_std
    log_ratio = jnp.log(other_mass / mass) - jnp.log(ratio)
    # What multiplies t and t^2 in the mean: small where the two Normals are nearly equal.
    slope = ratio * (other_c + shift) - c
    curvature = 0.5 * (ratio - 1.0) * (ratio + 1.0)
    kl = log_ratio + curvature * second_moment + slope * offset + shift * (0.5 * shift + other_c)
    # Rounding may leave less than 0. It is lifted without a gradient: the derivatives of the
    # divergence of nearly equal Normals count in the natural gradient.
    return kl + jax.lax.stop_gradient(jnp.maximum(-kl, 0.0))


def truncated_sample(
    uniform: jax.Array, mean: jax.Array, std: jax.Array, low: jax.Array, high: jax.Array
) -> jax.Array:
    """Returns the inverse distribution function [...] of a Normal restricted to [low, high].

    The function that is inverted is the integral from the anchor to the sample, to the left or to
    the right, so a sample in a far tail is as exact as one near the mean.
    """
    mode, c, to_low, to_high = anchor(mean, std, low, high)
    low_mass = segment(0, -c, to_low)
    # What lies between the anchor and the sample; negative where the sample is below.
    mass = uniform * (low_mass + segment(0, c, to_high)) - low_mass
    distance = _invert(jnp.abs(c), jnp.abs(mass))
    return jnp.clip(mode + std * jnp.where(mass < 0, -distance, distance), low, high)


def _invert(c: jax.Array, mass: jax.Array) -> jax.Array:
    """Returns the t with ``segment(0, c, t) == mass``, by Halley's method on the log of the tail.

    With the hazard h = 1 / F_0, minus that log has slope h(c + t) and curvature h (h - c - t),
    between 2 / pi and 1. The first guess takes slope and curvature from the anchor; it is never
    too small.
    """
    eps = float(jnp.finfo(c.dtype).eps)
    hazard = 1.0 / half_line(0, c)
    # Minus the log of the share of the half-line that lies beyond t; never infinite.
    log_drop = -jnp.log1p(-jnp.minimum(mass * hazard, 1.0 - 0.5 * eps))
    curvature = jnp.clip(hazard * (hazard - c), 2.0 / math.pi, 1.0)
    guess = 2.0 * log_drop / (hazard + jnp.sqrt(hazard**2 + 2.0 * curvature * log_drop))
    t = guess
    # Halley's method triples the number of correct digits in each step.
    for _ in range(2 if c.dtype == jnp.float32 else 3):
        mills = half_line(0, c + t)
        newton_step = (t * (0.5 * t + c) - jnp.log(mills * hazard) - log_drop) * mills
        halley_factor = jnp.clip(1.0 / mills - c - t, 0.0, 0.8)
        t = t - newton_step / (1.0 - 0.5 * halley_factor * newton_step)
    # A small drop loses its digits in the rounding of the logarithm; the guess does not, and its
    # error is only of the third order in the drop.
    return jnp.where(log_drop < eps ** (1 / 3), guess, t)


@functools.cache
def _series(order: int, eps: float) -> tuple[float, ...]:
    """Returns the Chebyshev coefficients of (1 + c)^(n + 1) F_n(c), those above a dtype's rounding.

    With t = s / (1 + c) and z = 1 / (1 + c) it is the integral over s of
    s^n exp(-(s z)^2 / 2 - s (1 - z)), a smooth function of z in [0, 1]. No term is negative, so
    nothing cancels.
    """
    nodes, weights = _legendre(12)
    # s from 0 to 50, in panels of 1/2: beyond, the integrand is far below the rounding of float64.
    panels = np.arange(100)[:, None]
    s = 0.5 * (panels + nodes).ravel()
    ds = 0.5 * np.tile(weights, 100)

    # Chebyshev points in (-1, 1), and the discrete cosine transform of the values there.
    num_points = 71
    odd_numbers = 2 * np.arange(num_points) + 1
    index = np.arange(num_points)[:, None]
    c = _SERIES_PIVOT * np.tan(0.25 * np.pi * odd_numbers / num_points) ** 2
    z = 1.0 / (1.0 + c[:, None])
    integrals = np.sum(ds * s**order * np.exp(-0.5 * (s * z) ** 2 - s * (1.0 - z)), axis=1)
    cosines = np.cos(0.5 * np.pi / num_points * (index * odd_numbers % (4 * num_points)))
    coefficients = cosines @ integrals * (2.0 / num_points)
    coefficients[0] /= 2.0
    large_indices = np.nonzero(np.abs(coefficients) > max(0.1 * eps, 1e-15) * coefficients[0])[0]
    return tuple(coefficients[: large_indices[-1] + 1].tolist())


@functools.cache
def _legendre(num_nodes: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns the nodes and weights of Gauss-Legendre quadrature on [0, 1]."""
    nodes, weights = legendre.leggauss(num_nodes)
    return 0.5 * (nodes + 1.0), 0.5 * weights
