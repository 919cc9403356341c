"""Every distribution: density, entropy, score and sampling agree with each other."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from mjx_reinforce import Box
from mjx_reinforce.registry import DISTRIBUTIONS, load

SPACE = Box(np.array([-3.0]), np.array([1.0]))
NUM_SAMPLES = 200_000


@pytest.fixture(params=sorted(DISTRIBUTIONS))
def distribution(request):
    return load(DISTRIBUTIONS[request.param])(SPACE)


@pytest.fixture
def outputs(distribution):
    free = jnp.linspace(-0.3, 0.6, distribution.num_outputs)
    return jnp.concatenate([free, jnp.asarray(distribution.constants)])


def draw(distribution, outputs):
    noise = distribution.noise(jax.random.key(0), (NUM_SAMPLES,))
    return distribution.sample(jnp.broadcast_to(outputs, (NUM_SAMPLES, *outputs.shape)), noise)


def test_density_integrates_to_one(distribution, outputs):
    grid = jnp.linspace(-12.0, 12.0, 20_001)[:, None]
    density = jnp.exp(distribution.log_prob(outputs, grid))
    assert np.trapezoid(density, grid[:, 0]) == pytest.approx(1.0, abs=1e-4)


def test_expected_score_is_zero(distribution, outputs):
    actions = draw(distribution, outputs)
    score = jax.vmap(jax.grad(distribution.log_prob), (None, 0))(outputs, actions)
    error = np.std(score, axis=0) / np.sqrt(NUM_SAMPLES)
    assert np.all(np.abs(np.mean(score, axis=0)) < 4 * error)


def test_entropy_is_minus_the_mean_log_density(distribution, outputs):
    surprise = -distribution.log_prob(outputs, draw(distribution, outputs))
    error = float(np.std(surprise)) / np.sqrt(NUM_SAMPLES)
    assert np.mean(surprise) == pytest.approx(float(distribution.entropy(outputs)), abs=4 * error)


def test_mode_has_the_greatest_density(distribution, outputs):
    grid = jnp.linspace(-12.0, 12.0, 20_001)[:, None]
    best = grid[jnp.argmax(distribution.log_prob(outputs, grid))]
    np.testing.assert_allclose(distribution.mode(outputs), best, atol=2e-3)


def test_normal_against_scipy():
    distribution = load(DISTRIBUTIONS["normal"])(SPACE)
    outputs, action = jnp.array([0.25, np.log(0.7)]), jnp.array([0.4])
    expected = stats.norm(-1.0 + 2.0 * 0.25, 0.7)
    assert float(distribution.log_prob(outputs, action)) == pytest.approx(expected.logpdf(0.4))
    assert float(distribution.entropy(outputs)) == pytest.approx(expected.entropy())


def test_initial_std(distribution):
    fresh = jnp.concatenate(
        [jnp.zeros(distribution.num_outputs), jnp.asarray(distribution.constants)]
    )
    assert np.std(draw(distribution, fresh)) == pytest.approx(0.5, rel=0.01)


def test_nonsense_is_refused():
    normal = load(DISTRIBUTIONS["normal"])
    with pytest.raises(ValueError, match="initial_std must be positive"):
        normal(SPACE, initial_std=-1.0)
    with pytest.raises(ValueError, match="'parameter' or 'softplus'"):
        normal(SPACE, std="exp")
