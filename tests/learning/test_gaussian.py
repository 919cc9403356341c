"""What the Gaussian families share, and the range of actions, against SciPy and by hand."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy import integrate, stats

from mjx_reinforce.engine.base import Box, Discrete
from mjx_reinforce.learning.distributions.distribution import (
    check_space,
    continuous_box,
    middle_and_half_range,
)
from mjx_reinforce.learning.distributions.gaussian import (
    gaussian_outputs,
    normal,
    normal_entropy,
    normal_kl,
    normal_log_density,
)

BOX = Box(np.float32([-1, 0]), np.float32([1, 4]))
HALF = Box(np.array([-2.0, -np.inf, 1.0]), np.array([4.0, 5.0, np.inf]))


def test_the_middle_of_what_is_not_bounded_on_both_sides_is_0_and_half_of_it_1():
    middle, half = middle_and_half_range(HALF)
    assert (middle.tolist(), half.tolist()) == ([1, 0, 0], [3, 1, 1])
    assert middle.dtype == half.dtype == np.float32


def test_bounds_are_of_the_dtype_that_is_asked_for():
    layout = gaussian_outputs("normal", BOX, "parameter", 0.3, rescale=True, bounded=True)
    low, high = layout.bounds(jnp.zeros((), jnp.float16))
    assert (low.dtype, high.dtype) == (jnp.float16, jnp.float16)
    assert (low.tolist(), high.tolist()) == ([-1, 0], [1, 4])


def test_a_space_of_the_family_passes():
    assert continuous_box("normal", HALF) is HALF
    check_space("categorical", Discrete(2))


@pytest.mark.parametrize("std", ["parameter", "softplus", "sigmoid"])
def test_a_fresh_network_has_the_initial_std(std):
    """Its outputs are zero; a parameter is a constant that is appended to them."""
    layout = gaussian_outputs("normal", BOX, std, 0.3, rescale=True)
    raw = np.log([0.3, 0.3]) if std == "parameter" else np.zeros(2)
    mean, found = layout.split(jnp.concatenate([jnp.zeros(2), jnp.asarray(raw)]))
    np.testing.assert_allclose(found, 0.3, rtol=1e-4)
    np.testing.assert_array_equal(mean, [0, 2])  # the middle


@pytest.mark.parametrize(("rescale", "mean"), [(True, [0.5, 1.0]), (False, [0.5, -0.5])])
def test_means_are_in_units_of_half_the_range_or_as_they_are(rescale, mean):
    layout = gaussian_outputs("normal", BOX, "parameter", 1.0, rescale)
    np.testing.assert_allclose(layout.mean(jnp.array([0.5, -0.5, 9.0, 9.0])), mean)


def test_a_std_that_depends_on_the_state_is_an_output():
    free, made = (normal(BOX, std=std, initial_std=0.3) for std in ("parameter", "softplus"))
    assert (free.num_outputs, free.num_scales) == (2, 0)
    assert np.exp(free.constants).tolist() == pytest.approx([0.3, 0.3])
    assert (made.num_outputs, made.num_scales, made.constants) == (4, 2, ())


@pytest.mark.parametrize(
    ("space", "std", "initial", "said"),
    [
        ((-1, 1), "parameter", 0.3, "normal needs an action space, .* got a tuple"),
        (Discrete(2), "parameter", 0.3, "normal needs a continuous action space.* categorical"),
        (HALF, "parameter", 0.3, "normal needs finite action bounds"),
        (BOX, "exp", 0.3, "std must be 'parameter', 'softplus' or 'sigmoid', got 'exp'"),
        (BOX, "softplus", 0.0, "initial_std must be positive"),
        (BOX, "sigmoid", 1.0, "a sigmoid std stays below 1, got initial_std=1.0"),
    ],
)
def test_nonsense_is_refused(space, std, initial, said):
    with pytest.raises(ValueError, match=said):
        gaussian_outputs("normal", space, std, initial, rescale=True, bounded=True)


def test_density_and_entropy_are_scipys():
    x, mean, std = np.array([[-1.0, 0.5, 30.0], [0.2, 0.5, 2.0], [0.1, 3.0, 7.0]])
    density = normal_log_density(*map(jnp.asarray, (x, mean, std)))
    np.testing.assert_allclose(density, stats.norm.logpdf(x, mean, std), rtol=1e-5)
    np.testing.assert_allclose(normal_entropy(jnp.asarray(std)), stats.norm.entropy(0, std), 1e-5)


def test_the_divergence_is_its_integral():
    p, q = stats.norm(0.3, 0.5), stats.norm(1.0, 0.8)
    want = integrate.quad(lambda x: p.pdf(x) * (p.logpdf(x) - q.logpdf(x)), -8, 8)[0]
    assert normal_kl(*map(jnp.float32, (0.3, 0.5, 1.0, 0.8))) == pytest.approx(want, rel=1e-4)
    near = normal_kl(*map(jnp.float32, (0.3, 0.5, 0.3, 0.5 * (1 + 1e-3))))
    assert near == pytest.approx(1e-6, rel=1e-2)  # no difference of nearly equal numbers
