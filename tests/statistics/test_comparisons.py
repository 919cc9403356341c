"""Two configurations against hand counts, scipy and rliable; how many seeds they need."""

import numpy as np
import pytest
from rliable import metrics
from scipy import stats

from experiments.studies.seeds.answers import paired_rates
from mjx_reinforce.statistics.comparisons import (
    compare_all,
    failures_as_worst,
    holm,
    paired_difference,
    probability_of_improvement,
    seeds_needed,
    wrong_winner,
)


def test_holm_by_hand():
    np.testing.assert_allclose(holm([0.01, 0.04, 0.03, 0.005]), [0.03, 0.06, 0.06, 0.02])
    np.testing.assert_allclose(holm([0.5, 0.6]), [1.0, 1.0])
    assert holm([]).shape == (0,)


@pytest.mark.parametrize("ties", [False, True])
def test_improvement_is_that_of_rliable(ties):
    random = np.random.default_rng(1)
    x, y = random.normal(0.5, size=40), random.normal(size=50)
    if ties:
        x, y = np.round(x), np.round(y)
    expected = metrics.probability_of_improvement(x[:, None], y[:, None])
    assert probability_of_improvement(x, y).value == pytest.approx(expected, rel=1e-12)


def test_improvement_interval_by_hand():
    """DeLong's variance; Wilson's interval of as many trials as give a rate that variance."""
    x, y = np.array([1.0, 3.0, 5.0]), np.array([0.0, 2.0, 6.0])
    rate, of_x, of_y = 5 / 9, np.array([1, 2, 2]) / 3, np.array([3, 2, 0]) / 3
    trials = rate * (1 - rate) / (of_x.var(ddof=1) / 3 + of_y.var(ddof=1) / 3)
    z = stats.norm.ppf(0.975)
    ends = np.roots([1 + z**2 / trials, -2 * rate - z**2 / trials, rate**2])
    value, low, high = probability_of_improvement(x, y)
    np.testing.assert_allclose([low, high], np.sort(ends))
    assert value == pytest.approx(rate)


@pytest.mark.parametrize(
    ("counts", "low", "high"),
    [
        ((36, 12, 2, 0), 0.0569, 0.3404),  # Newcombe 1998, table II
        ((14, 5, 0, 22), 0.011, 0.226),  # Altman et al. 2000, Statistics with Confidence, chapter 6
        ((1, 1, 7, 12), -0.507, -0.026),  # Fagerland et al. 2014, of Bentur et al.
    ],
)
def test_paired_rates_as_published(counts, low, high):
    x, y = np.repeat([1, 1, 0, 0], counts), np.repeat([1, 0, 1, 0], counts)
    found = paired_rates(x, y)
    assert [found.low, found.high] == pytest.approx([low, high], abs=10.0 ** -len(f"{low}"[3:]) / 2)
    assert found.value == pytest.approx(np.mean(x) - np.mean(y))
    expected = stats.binomtest(counts[1], counts[1] + counts[2]).pvalue
    assert found.p_value == pytest.approx(expected)
    mirrored = paired_rates(y, x)
    assert (mirrored.low, mirrored.high) == pytest.approx((-found.high, -found.low))


def test_paired_rates_have_width_where_all_seeds_agree():
    """As far as Wilson's interval of one rate, for either may be the lower one."""
    solved = np.ones((2, 512), bool)
    found = paired_rates(solved, solved)
    wilson = stats.binomtest(512, 512).proportion_ci(method="wilson")
    np.testing.assert_allclose(found.high, 1 - wilson.low)
    np.testing.assert_array_equal(found.low, -found.high)
    np.testing.assert_array_equal((found.value, found.p_value), ([0, 0], [1, 1]))


def test_paired_interval_by_hand():
    """What a seed adds to both shares varies less where its luck is the same."""
    x, y = np.array([1.0, 3.0, 5.0]), np.array([0.0, 2.0, 6.0])
    rate, of_both = 5 / 9, np.array([1 + 3, 2 + 2, 2 + 0]) / 3
    trials = rate * (1 - rate) / (of_both.var(ddof=1) / 3)
    z = stats.norm.ppf(0.875)
    ends = np.roots([1 + z**2 / trials, -2 * rate - z**2 / trials, rate**2])
    found = probability_of_improvement(x, y, paired=True, confidence=0.75)
    np.testing.assert_allclose(found[1:], np.sort(ends))


def test_improvement_of_all_over_all():
    value, low, high = probability_of_improvement(np.arange(5) + 10.0, np.arange(5.0))
    interval = stats.binomtest(5, 5).proportion_ci(method="wilson")
    np.testing.assert_allclose([value, low, high], [1.0, *interval])


def test_improvement_of_one_seed():
    """Wilson's interval of one trial."""
    for paired in (False, True):
        value, low, high = probability_of_improvement([3.0], [1.0], paired=paired)
        interval = stats.binomtest(1, 1).proportion_ci(method="wilson")
        np.testing.assert_allclose([value, low, high], [1.0, *interval])


def test_failed_seeds_lose_and_tie_among_themselves():
    x, y = np.array([np.nan, 5.0]), np.array([-7.0, np.inf])
    assert probability_of_improvement(x, y).value == pytest.approx((0 + 0.5 + 1 + 1) / 4)


def test_paired_difference_is_that_of_the_t_test():
    random = np.random.default_rng(1)
    x, y = random.normal(size=(2, 30))
    expected = stats.ttest_rel(x, y)
    found = paired_difference(x, y)
    np.testing.assert_allclose(found.value, np.mean(x - y))
    np.testing.assert_allclose(found[1:3], expected.confidence_interval())
    assert found.p_value == pytest.approx(expected.pvalue, rel=1e-9)


def test_a_failed_seed_counts_as_the_worst_of_both():
    x, y = np.array([np.nan, 5.0, 6.0, 9.0]), np.array([4.0, 3.0, np.inf, 2.0])
    assert paired_difference(x, y, 0.5) == paired_difference([2.0, 5, 6, 9], [4.0, 3, 2, 2], 0.5)


def test_every_pair_is_compared_and_corrected():
    random = np.random.default_rng(1)
    values = [random.normal(mean, size=40) for mean in (0.0, 0.5, 2.0)]
    found = compare_all(values)
    assert [(pair.first, pair.second) for pair in found] == [(0, 1), (0, 2), (1, 2)]
    raw = [stats.ttest_rel(values[p.first], values[p.second]).pvalue for p in found]
    np.testing.assert_allclose([pair.p_value for pair in found], raw)
    np.testing.assert_allclose([pair.adjusted for pair in found], holm(raw))
    assert found[2].difference.high < 0
    assert found[2].improvement.high < 0.5


def test_pairs_of_unlike_length_are_refused():
    with pytest.raises(ValueError, match="as many: 3 and 2"):
        probability_of_improvement([1, 2, 3], [1, 2], paired=True)
    with pytest.raises(ValueError, match="as many: 3 and 2"):
        paired_difference([1, 2, 3], [1, 2])


def test_the_worst_is_that_of_each_row():
    """Of whole numbers too, and 0 where nothing is finite."""
    x = np.array([[1.0, np.nan, 5.0], [-7.0, 2.0, np.inf], [np.nan] * 3])
    y = np.array([[4.0, 3.0, 9.0], [np.nan, 8.0, 6.0], [np.nan] * 3])
    one, other = failures_as_worst(x, y)
    np.testing.assert_array_equal(one, [[1, 1, 5], [-7, 2, -7], [0, 0, 0]])
    np.testing.assert_array_equal(other, [[4, 3, 9], [-7, 8, 6], [0, 0, 0]])
    assert failures_as_worst([1, 2], [3, 4])[1].dtype == float


NORMAL = stats.norm.ppf((np.arange(2000) + 0.5) / 2000)


@pytest.mark.parametrize(("effect", "expected"), [(1.0, 17), (-0.5, 64), (0.3, 176)])
def test_seeds_needed_are_those_of_the_t_test(effect, expected):
    """Cohen (1988), table 2.4: 17, 64 and 175 of each for a power of 80% at 5%.

    Power is estimated from 2000 draws, so it is 0.009 off, and the seeds are by 2.3%.
    """
    found = seeds_needed(NORMAL + effect, NORMAL)
    assert found == pytest.approx(expected, rel=0.07, abs=1)


def test_more_power_and_a_stricter_level_need_more():
    """Normal approximations: 16, 26 and 35, and a few more for variances that are not known."""
    assert seeds_needed(NORMAL + 1, NORMAL) in range(16, 19)
    assert seeds_needed(NORMAL + 1, NORMAL, power=0.95) in range(26, 30)
    assert seeds_needed(NORMAL + 1, NORMAL, alpha=0.001) in range(35, 42)


def test_small_effects_need_many_seeds_or_too_many():
    expected = 2 * (stats.norm.ppf(0.975) + stats.norm.ppf(0.8)) ** 2 / 0.05**2
    assert seeds_needed(NORMAL + 0.05, NORMAL) == pytest.approx(expected, rel=0.01)
    assert seeds_needed(NORMAL + 0.03, NORMAL) is None
    assert seeds_needed(NORMAL, NORMAL) is None


@pytest.mark.parametrize("scale", [1e-300, 1e300])
def test_no_unit_changes_what_many_seeds_say(scale):
    """Although squares of such returns overflow, or vanish."""
    x, y = scale * (NORMAL + 1), scale * NORMAL
    assert seeds_needed(x, y) == seeds_needed(NORMAL + 1, NORMAL)
    assert wrong_winner(x, y, 3) == wrong_winner(NORMAL + 1, NORMAL, 3)


def test_seeds_needed_at_the_ends_of_the_numbers():
    """Two constants need four, whose orders are rare enough; one huge value is mostly noise."""
    assert seeds_needed([1e300] * 8, [-1e300] * 8) == 4
    assert seeds_needed([1e308] * 8, [-1e308] * 8) == 4
    outlier = [1.0, *[0.0] * 7]
    expected = seeds_needed(outlier, [0.0] * 8)
    assert seeds_needed([1e308, 1, 2, 3, 4, 5, 6, 7], [0.0] * 8) == expected > 4


def test_failed_seeds_are_the_worst():
    x, y = np.full(100, 10.0), np.full(100, 10.0)
    y[:50] = np.nan
    y[50:60] = 0.0
    with_zeros = np.where(np.isfinite(y), y, 0.0)
    assert seeds_needed(x, y) == seeds_needed(x, with_zeros)
    assert wrong_winner(x, y, 3) == wrong_winner(x, with_zeros, 3)


@pytest.mark.parametrize("num_seeds", [1, 3, 10])
def test_wrong_winner_of_normal_values(num_seeds):
    expected = stats.norm.cdf(-0.5 * np.sqrt(num_seeds / 2))
    error = float(np.sqrt(expected * (1 - expected) / 10_000))
    for sign in (1, -1):
        found = wrong_winner(NORMAL + 0.5 * sign, NORMAL, num_seeds)
        assert found == pytest.approx(expected, abs=4 * error)


def test_a_draw_without_a_winner_counts_half():
    """One seed of each: the better one wins half of the time, else both have 0."""
    found = wrong_winner(np.array([0.0, 1.0]), np.array([0.0, 0.0]), 1)
    assert found == pytest.approx(0.25, abs=0.02)
    assert np.isnan(wrong_winner(np.ones(3), np.ones(3), 1))
