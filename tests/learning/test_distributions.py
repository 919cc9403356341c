"""Every distribution: density, entropy, score and sampling agree with each other."""

import contextlib
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import special, stats

from mjx_reinforce import Box
from mjx_reinforce.engine import scalar
from mjx_reinforce.engine.base import Discrete
from mjx_reinforce.learning import bounded
from mjx_reinforce.learning.distributions import normal
from mjx_reinforce.registry import DISTRIBUTIONS, load_definition

LOW, HIGH = -3.0, 1.0
SPACE, ARMS = Box(np.array([LOW]), np.array([HIGH])), Discrete(4)
UNBOUNDED = Box(np.array([-np.inf]), np.array([1.0]))
NUM_SAMPLES = 200_000
TRANSFORM = jax.jit(bounded.truncated_sample)
LOG_DENSITY = jax.jit(bounded.truncated_log_density)
ENTROPY = jax.jit(bounded.truncated_entropy)


def build(name, space=SPACE, **settings):
    return load_definition(DISTRIBUTIONS[name])(space, **settings)


def supporting(space):
    """The families in the registry that can be built for an action space."""
    for name in sorted(DISTRIBUTIONS):
        with contextlib.suppress(ValueError):
            build(name, space)
            yield name


DISCRETE = list(supporting(ARMS))
CONTINUOUS = [name for name in supporting(SPACE) if name != "deterministic"]
BOUNDED = sorted(set(CONTINUOUS) - set(supporting(UNBOUNDED)))
#: Actions of positive probability; and the interval where there is a density, if it is not all of
#: the action's range.
ATOMS = {"tanh-normal": -1.0 + 2.0 * np.tanh([-6.0, 6.0])}
SUPPORT = {"tanh-normal": tuple(-1.0 + 2.0 * np.tanh([-5.0, 5.0]))}


def grid_of_actions(name):
    """Actions [20001, 1] over the interval where there is a density."""
    range_ = (LOW + 1e-6, HIGH - 1e-6) if name in BOUNDED else (-12.0, 12.0)
    return jnp.linspace(*SUPPORT.get(name, range_), 20_001)[:, None]


def some_outputs(distribution):
    free = jnp.linspace(-0.3, 0.6, distribution.num_outputs)
    return jnp.concatenate([free, jnp.asarray(distribution.constants)])


def draw(distribution, outputs):
    noise = distribution.noise(jax.random.key(0), (NUM_SAMPLES,))
    copies = jnp.broadcast_to(outputs, (NUM_SAMPLES, *outputs.shape))
    return jax.jit(distribution.sample)(copies, noise)


@pytest.fixture(
    params=[
        pytest.param(name, marks=pytest.mark.slow) if name == "truncated-normal" else name
        for name in CONTINUOUS
    ]
)
def name(request):
    return request.param


@pytest.fixture
def distribution(name):
    return build(name)


@pytest.fixture
def outputs(distribution):
    return some_outputs(distribution)


def test_probability_adds_up_to_one(name, distribution, outputs):
    grid = grid_of_actions(name)
    density = jnp.exp(distribution.log_prob(outputs, grid))
    atoms = jnp.asarray(ATOMS.get(name, []))[:, None]
    masses = jnp.exp(distribution.log_prob(outputs, atoms))
    total = np.trapezoid(density, grid[:, 0]) + np.sum(masses)
    assert total == pytest.approx(1.0, abs=1e-4)


def test_expected_score_is_zero(name, distribution, outputs):
    """Also at large outputs of a bounded family, where a Normal's mean is out of bounds."""
    cases = [(distribution, outputs)]
    if name in BOUNDED:
        wide = build(name, initial_std=3.0)
        cases += [(wide, jnp.array([mean, *wide.constants])) for mean in (-4.0, 3.0)]
    for family, given in cases:
        score = jax.jit(jax.vmap(jax.grad(family.log_prob), (None, 0)))(given, draw(family, given))
        error = np.std(score, axis=0) / np.sqrt(NUM_SAMPLES)
        assert np.all(np.abs(np.mean(score, axis=0)) < 4 * error)


def test_entropy_is_minus_the_mean_log_density(distribution, outputs):
    surprise = -distribution.log_prob(outputs, draw(distribution, outputs))
    error = float(np.std(surprise)) / np.sqrt(NUM_SAMPLES)
    assert np.mean(surprise) == pytest.approx(float(distribution.entropy(outputs)), abs=4 * error)


def test_mode(name, distribution, outputs):
    """The densest point, but for the tanh, where it is the median."""
    if name == "tanh-normal":
        best = np.median(draw(distribution, outputs), axis=0)
    else:
        grid = grid_of_actions(name)
        best = grid[jnp.argmax(distribution.log_prob(outputs, grid))]
    np.testing.assert_allclose(distribution.mode(outputs), best, atol=6e-3)


def test_initial_std(name):
    """Within a range that is wide beside it; a fresh network's outputs are zero."""
    distribution = build(name, Box(np.array([-100.0]), np.array([100.0])), initial_std=0.7)
    fresh = jnp.array([0.0] * distribution.num_outputs + list(distribution.constants))
    assert np.std(draw(distribution, fresh)) == pytest.approx(0.7, rel=0.01)


def test_one_vector_and_many_entries(name):
    space = Box(np.array([-1.0, -2.0, 0.0]), np.array([1.0, 2.0, 3.0]))
    distribution = build(name, space)
    outputs = some_outputs(distribution)
    noise = distribution.noise(jax.random.key(1), (5, 2))
    actions = distribution.sample(jnp.broadcast_to(outputs, (5, 2, outputs.size)), noise)
    assert actions.shape == (5, 2, 3)
    np.testing.assert_allclose(distribution.sample(outputs, noise[0, 0]), actions[0, 0], rtol=1e-5)
    assert distribution.log_prob(outputs, actions).shape == (5, 2)
    assert distribution.entropy(outputs).shape == ()
    assert distribution.mode(outputs).shape == (3,)


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(DISTRIBUTIONS))
def test_the_fused_engine_writes_out_sample_and_mode(name):
    space = ARMS if name in DISCRETE else SPACE
    distribution = build(name, space)
    outputs = jax.random.normal(jax.random.key(2), (len(some_outputs(distribution)), 64))
    noise = distribution.noise(jax.random.key(3), (64,)).T
    written = scalar.vmap(distribution.sample, in_axes=-1, out_axes=-1)(outputs, noise)
    plain = jax.vmap(distribution.sample, in_axes=-1, out_axes=-1)(outputs, noise)
    np.testing.assert_allclose(written, plain, rtol=1e-4, atol=1e-5)
    assert written.dtype == plain.dtype
    written = scalar.vmap(distribution.mode, in_axes=-1, out_axes=-1)(outputs)
    np.testing.assert_allclose(written, jax.vmap(distribution.mode, -1, -1)(outputs), rtol=1e-5)


@pytest.mark.parametrize(
    "name",
    ["tanh-normal", pytest.param("truncated-normal", marks=pytest.mark.slow)],
)
def test_far_out_samples_stay_inside_and_gradients_finite(name):
    """At means up to 10,000 standard deviations beyond either bound."""
    distribution = build(name)
    sample = jax.jit(distribution.sample)
    score = jax.jit(jax.vmap(jax.value_and_grad(distribution.log_prob), (None, 0)))
    entropy = jax.jit(jax.value_and_grad(distribution.entropy))
    noise = jnp.array([[0.0], [1e-7], [0.5], [1.0]])
    if name != "truncated-normal":
        noise = 12.0 * noise - 6.0
    for std, distance in itertools.product([1e-3, 1.0, 1e3], [-1e4, -30, -1, 0, 3, 100, 1e4]):
        bound = HIGH if distance > 0 else LOW
        outputs = jnp.array([(bound + distance * std + 1.0) / 2.0, np.log(std)])
        actions = sample(jnp.broadcast_to(outputs, (4, 2)), noise)
        assert np.all((actions >= LOW) & (actions <= HIGH))
        actions = jnp.concatenate([actions, jnp.array([[LOW], [HIGH]])])
        values = score(outputs, actions), entropy(outputs)
        assert all(np.all(np.isfinite(x)) for x in jax.tree.leaves(values)), (std, distance)


def test_standard_deviations():
    """A sigmoid's at initial_std 0.5 is sigmoid(o); without rescaling the mean is the output."""
    distribution = normal(SPACE, std="sigmoid", rescale=False)
    for o in (-2.0, 0.0, 1.0):
        expected = stats.norm(0.3, special.expit(o) + 1e-6).logpdf(-0.4)
        got = distribution.log_prob(jnp.array([0.3, o]), jnp.array([-0.4]))
        assert float(got) == pytest.approx(expected, rel=1e-5)
    softplus = normal(SPACE, std="softplus", initial_std=np.log(2.0), rescale=False)
    expected = stats.norm(0.3, np.log1p(np.exp(0.8)) + 1e-6).logpdf(-0.4)
    got = softplus.log_prob(jnp.array([0.3, 0.8]), jnp.array([-0.4]))
    assert float(got) == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize("std", [0.05, 0.5, 20.0])
@pytest.mark.parametrize("distance", [-100.0, -30.0, -5.0, -0.5, 0.0, 2.0, 10.0, 100.0])
def test_truncated_normal_against_scipy(std, distance):
    """Measured from the nearer bound in standard deviations; to 1e-10 in float64."""
    with jax.enable_x64(True):
        mean = -1.0 if distance == 0 else (HIGH if distance > 0 else LOW) + distance * std
        expected = stats.truncnorm((LOW - mean) / std, (HIGH - mean) / std, mean, std)
        settings = [jnp.asarray(x) for x in (mean, std, LOW, HIGH)]
        uniform = np.array([1e-6, 0.01, 0.4, 0.95, 1 - 1e-6])
        actions = TRANSFORM(jnp.asarray(uniform), *settings)
        np.testing.assert_allclose(expected.cdf(actions), uniform, rtol=1e-9, atol=1e-10)
        for action in actions:
            got = LOG_DENSITY(action, *settings)
            assert float(got) == pytest.approx(expected.logpdf(action), rel=1e-12, abs=1e-10)
        if abs(distance) < 50:  # scipy's entropy is NaN farther out, and worse on the left.
            mirrored = -2.0 - mean if mean < -1.0 else mean
            expected = stats.truncnorm(*((np.array([LOW, HIGH]) - mirrored) / std), mirrored, std)
            got = ENTROPY(*settings)
            assert float(got) == pytest.approx(expected.entropy(), abs=1e-10)


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("distance", [-1e6, 1e4])
def test_truncated_normal_far_out_is_exponential(distance, dtype):
    """With rate c / std from the nearer bound, up to a relative 1 / c^2."""
    with jax.enable_x64(dtype == np.float64):
        std = dtype(0.5)
        bound = HIGH if distance > 0 else LOW
        mean = dtype(bound + distance * std)
        scale = 1.0 / abs(distance)
        settings = [jnp.asarray(x, dtype) for x in (mean, std, LOW, HIGH)]
        tolerance = 4 / distance**2 + (1e-10 if dtype == np.float64 else 5e-6)

        def log_density(mean, log_std, action):
            return bounded.truncated_log_density(action, mean, jnp.exp(log_std), *settings[2:])

        scored = jax.jit(jax.value_and_grad(log_density, (0, 1)))
        for uniform in (0.02, 0.5, 0.9):
            action = TRANSFORM(jnp.asarray(uniform, dtype), *settings)
            t = abs(float(action) - bound) / 0.5
            density = stats.expon(scale=scale).logpdf(t) - np.log(0.5)

            got, score = scored(mean, jnp.log(std), action)
            assert float(got) == pytest.approx(density, rel=tolerance, abs=tolerance)
            # The score by the mean is (t - E[t]) / std, by the log of the std 2 c (t - E[t]).
            sign = -1 if distance > 0 else 1
            assert float(score[0]) * 0.5 / scale == pytest.approx(
                sign * (t / scale - 1.0), abs=tolerance
            )
            assert float(score[1]) == pytest.approx(2.0 * (t / scale - 1.0), abs=10 * tolerance)
        entropy, slope = jax.jit(jax.value_and_grad(bounded.truncated_entropy))(*settings)
        assert float(entropy) == pytest.approx(1.0 + np.log(0.5 * scale), abs=tolerance)
        assert abs(float(slope)) * 0.5 == pytest.approx(scale, rel=tolerance)


def test_the_probabilities_of_a_categorical():
    """Entropy, mode, score and the frequencies of samples follow from them: a softmax."""
    distribution = build("categorical", ARMS)
    outputs = jnp.array([0.3, -1.0, 2.0, 0.0])
    log_probs = distribution.log_prob(outputs, jnp.arange(4))
    probabilities = np.exp(np.asarray(log_probs, float))
    assert np.sum(probabilities) == pytest.approx(1.0, rel=1e-6)
    assert float(distribution.entropy(outputs)) == pytest.approx(stats.entropy(probabilities))
    assert int(distribution.mode(outputs)) == np.argmax(probabilities)
    actions = draw(distribution, outputs)
    assert actions.dtype == jnp.int32
    assert actions.shape == (NUM_SAMPLES,)
    counts = np.bincount(actions, minlength=4)
    assert stats.chisquare(counts, NUM_SAMPLES * probabilities / probabilities.sum()).pvalue > 1e-4
    scores = jax.vmap(jax.grad(distribution.log_prob), (None, 0))(outputs, jnp.arange(4))
    np.testing.assert_allclose(probabilities @ np.asarray(scores), 0.0, atol=1e-6)
    softmax = special.softmax(np.asarray(outputs, float))
    np.testing.assert_allclose(probabilities, softmax, rtol=1e-6)


def test_deterministic_has_no_density():
    distribution = build("deterministic")
    outputs = jnp.array([[0.25], [0.5]])
    noise = distribution.noise(jax.random.key(0), (2,))
    np.testing.assert_allclose(distribution.sample(outputs, noise), [[-0.5], [0.0]])
    np.testing.assert_array_equal(distribution.entropy(outputs), 0.0)
    with pytest.raises(ValueError, match="choose a stochastic one"):
        distribution.log_prob(outputs, outputs)


@pytest.mark.parametrize(
    "name", ["normal", "normal-softplus", "tanh-normal", "truncated-normal", "categorical"]
)
def test_the_divergence_is_the_mean_log_ratio(name):
    distribution = build(name, ARMS if name in DISCRETE else SPACE)
    one = some_outputs(distribution)
    other, actions = 1.3 * one, draw(distribution, one)
    ratio = distribution.log_prob(one, actions) - distribution.log_prob(other, actions)
    error = float(np.std(ratio)) / np.sqrt(NUM_SAMPLES)
    assert float(distribution.kl(one, other)) == pytest.approx(np.mean(ratio), abs=4 * error)


def test_the_divergence_of_nearly_equal_normals_is_no_difference_of_nearly_equal_numbers():
    one = jnp.array([0.3, -0.7])
    near = build("normal").kl(one, one + jnp.array([0.0, 1e-3]))
    assert float(near) == pytest.approx(1e-6, rel=1e-2)


def test_means_are_in_units_of_half_the_range_or_as_they_are():
    """Where a bound is missing, the middle is 0 and half the range 1."""
    space = Box(np.array([-2.0, -np.inf, 1.0]), np.array([4.0, 5.0, np.inf]))
    for rescale, mode in ((True, [2.5, 0.5, 0.5]), (False, [0.5, 0.5, 0.5])):
        distribution = build("normal", space, rescale=rescale)
        outputs = jnp.array([0.5] * 3 + list(distribution.constants))
        np.testing.assert_allclose(distribution.mode(outputs), mode)


@pytest.mark.parametrize(
    ("space", "settings", "said"),
    [
        ((-1, 1), {}, "normal needs an action space, .* got a tuple"),
        (SPACE, {"std": "exp"}, "std must be 'parameter', 'softplus' or 'sigmoid', got 'exp'"),
        (SPACE, {"initial_std": 0.0}, "initial_std must be positive"),
        (SPACE, {"std": "sigmoid", "initial_std": 1.0}, "a sigmoid std stays below 1, got"),
    ],
)
def test_nonsense_is_refused(space, settings, said):
    with pytest.raises(ValueError, match=said):
        normal(space, **settings)


def test_actions_that_a_family_cannot_have_are_refused():
    with pytest.raises(ValueError, match="categorical needs a discrete action space"):
        build("categorical")
    for name in [*CONTINUOUS, "deterministic"]:
        with pytest.raises(ValueError, match=r"continuous action space.*choose categorical"):
            build(name, ARMS)
    for name in BOUNDED:
        with pytest.raises(ValueError, match=r"finite action bounds.*choose normal"):
            build(name, UNBOUNDED)


def test_every_family_is_tested():
    """The lists above leave out a family that cannot be built."""
    assert {*CONTINUOUS, *DISCRETE, "deterministic"} == set(DISTRIBUTIONS)
