"""The observation normalizer against numpy."""

import jax.numpy as jnp
import numpy as np
import pytest

from mjx_reinforce.learning import normalize

RNG = np.random.default_rng(0)
FIRST, SECOND = RNG.normal([3.0, -100.0], [2.0, 0.5], size=(2, 5, 3, 2))
MASK = np.arange(5)[:, None] < np.array([5, 1, 3])


def merged(*batches, at_most=1e9):
    normalizer = normalize.init(2)
    for observation in batches:
        poisoned = np.where(MASK[..., None], observation, np.nan)
        normalizer = normalize.update(
            normalizer, jnp.asarray(poisoned), jnp.asarray(MASK), max_count=at_most
        )
    return normalizer


def assert_counts(normalizer, samples):
    assert float(normalizer.count) == len(samples)
    np.testing.assert_allclose(normalizer.mean, samples.mean(axis=0), rtol=1e-5)
    squares = np.sum((samples - samples.mean(axis=0)) ** 2, axis=0)
    np.testing.assert_allclose(normalizer.m2, squares, rtol=1e-4)


def test_one_batch_counts_what_the_mask_holds():
    assert_counts(merged(FIRST), FIRST[MASK])


def test_batches_merge_to_the_statistics_of_all():
    assert_counts(merged(FIRST, SECOND), np.concatenate([FIRST[MASK], SECOND[MASK]]))
    both = np.concatenate([FIRST[MASK], SECOND[MASK], FIRST[MASK]])
    assert_counts(merged(FIRST, SECOND, FIRST), both)


@pytest.mark.parametrize(("at_most", "batches"), [(0, 0), (1, 1), (9, 1), (9.5, 2), (10, 2)])
def test_a_batch_is_merged_while_fewer_are_counted(at_most, batches):
    """Each holds 9; the last one that is merged is merged whole."""
    normalizer = merged(FIRST, SECOND, FIRST, at_most=at_most)
    if not batches:
        assert float(normalizer.count) == 0
    else:
        assert_counts(normalizer, np.concatenate([FIRST[MASK], SECOND[MASK]][:batches]))


def test_an_empty_batch_changes_nothing():
    before = merged(FIRST)
    after = normalize.update(
        before, jnp.full((5, 3, 2), jnp.nan), jnp.zeros((5, 3), bool), max_count=1e9
    )
    for name in ("count", "mean", "m2"):
        np.testing.assert_array_equal(getattr(after, name), getattr(before, name))


def test_nothing_counted_is_the_identity():
    observation = jnp.array([[50.0, -3.0]])
    np.testing.assert_array_equal(normalize.apply(normalize.init(2), observation), observation)
    nothing = normalize.update(
        normalize.init(2), jnp.ones((1, 1, 2)), jnp.zeros((1, 1), bool), max_count=1e9
    )
    np.testing.assert_array_equal(normalize.apply(nothing, observation), observation)


def test_scaled_by_the_standard_deviation_and_clipped_at_ten():
    normalizer = normalize.Normalizer(
        count=jnp.array(4.0), mean=jnp.array([1.0, 2.0]), m2=jnp.array([16.0, 1.0])
    )  # standard deviations of 2 and 0.5
    observation = jnp.array([[1.0, 2.0], [4.0, 1.0], [20.9, 6.9], [21.1, 7.1], [-30.0, -1e9]])
    expected = [[0.0, 0.0], [1.5, -2.0], [9.95, 9.8], [10.0, 10.0], [-10.0, -10.0]]
    np.testing.assert_allclose(normalize.apply(normalizer, observation), expected, rtol=1e-5)


def test_one_observation_is_normalised_by_the_least_deviation():
    """The deviation of one is 0 and counts as 1e-4: a constant entry stays small."""
    normalizer = normalize.update(
        normalize.init(1), jnp.full((1, 1, 1), 0.25), jnp.ones((1, 1), bool), max_count=1
    )
    assert float(normalizer.count) == 1
    scaled = normalize.apply(normalizer, jnp.array([[0.25], [0.25 + 2.0**-12]]))
    np.testing.assert_allclose(scaled[:, 0], [0.0, 2.0**-12 / 1e-4], rtol=1e-5)


def test_deviations_stay_accurate_far_from_zero():
    """In float32 the difference of mean square and squared mean would be all rounding."""
    far = FIRST + 1e4
    got = np.asarray(merged(far, far).m2)
    exact = 2 * np.sum((far[MASK] - far[MASK].mean(axis=0)) ** 2, axis=0)
    np.testing.assert_allclose(got, exact, rtol=0.01)


@pytest.mark.parametrize("min_std", [0.0, 0.3, 5.0])
def test_a_small_deviation_is_raised_to_the_least(min_std):
    """After every batch, of each entry by itself; the mean stays."""
    normalizer, mean, count, m2 = normalize.init(2), np.zeros(2), 0, np.zeros(2)
    for observation in (FIRST, SECOND):
        normalizer = normalize.update(
            normalizer, jnp.asarray(observation), jnp.asarray(MASK), 1e9, min_std
        )
        new = observation[MASK]
        merged = (count * mean + new.sum(axis=0)) / (count + len(new))
        m2 = m2 + count * (mean - merged) ** 2 + ((new - merged) ** 2).sum(axis=0)
        mean, count = merged, count + len(new)
        m2 = np.maximum(m2, count * min_std**2)
        std = normalize.standard_deviation(normalizer)
        assert np.all(std >= min_std * (1 - 1e-6))
        np.testing.assert_allclose(std, np.sqrt(m2 / count), rtol=1e-4)
        np.testing.assert_allclose(normalizer.mean, mean, rtol=1e-5)
