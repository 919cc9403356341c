"""Env steps to a threshold against hand counts."""

import math
from decimal import Decimal, localcontext
from fractions import Fraction

import numpy as np
import pytest
from scipy import stats

from mjx_reinforce.statistics.survival import (
    collapses,
    kaplan_meier,
    log_rank,
    mean_while_training,
    median_steps,
    restricted_mean,
    time_to_threshold,
)


def test_time_to_threshold_is_the_first_time_or_the_last_known():
    returns = np.array([[0.0, np.nan, 9.0, np.inf], [10.0, 2.0, 11.0, 1.0], [3.0, 4.0, 1.0, 1.0]])
    steps = np.array([[0, 0, 5, 0], [50, 60, 70, 80], [100, 120, 140, 160]])
    found, solved = time_to_threshold(returns, steps, 9.0)
    assert found.tolist() == [50, 120, 5, 160]
    assert solved.tolist() == [True, False, True, False]


def test_collapse_is_to_have_solved_and_not_to_at_the_end():
    returns = np.array([[9.0, 9.0, 0.0, 0.0, 9.0], [0.0, 9.0, 0.0, 9.0, np.nan]])
    assert collapses(returns, 9.0).tolist() == [True, False, False, False, True]


def test_kaplan_meier_by_hand():
    """Two of six are still unsolved when their training ends at 6; one ended unsolved at 3."""
    curve = kaplan_meier([1, 2, 2, 3, 5, 6], [True, True, True, False, True, False])
    np.testing.assert_allclose(curve.steps, [1, 2, 3, 5, 6])
    np.testing.assert_allclose(curve.probability, [5 / 6, 1 / 2, 1 / 2, 1 / 4, 1 / 4])


def test_band_by_hand():
    """Log-log with Greenwood's variance: after two of four, S = 1/2, sum of 1/12 and 1/6."""
    curve = kaplan_meier([1, 2, 3, 4], [True, True, False, False])
    spread = stats.norm.ppf(0.975) * np.sqrt(1 / 12 + 1 / 6) / np.log(0.5)
    np.testing.assert_allclose(curve.low[1], 0.5 ** np.exp(-spread))
    np.testing.assert_allclose(curve.high[1], 0.5 ** np.exp(spread))


def test_median_by_hand():
    steps, solved = [10, 20, 30, 40, 50, 60], np.array([True, True, True, False, True, False])
    assert median_steps(steps, solved).value == 30
    value, low, high = median_steps(steps, solved & (np.arange(6) < 2))
    assert np.isnan(value)
    assert low == 10  # so few could be the half
    assert np.isnan(high)


def counted_curve(steps, solved):
    """Yields each time at which seeds solve, the share left after it, and Greenwood's sum."""
    share, spread = Fraction(1), Fraction(0)
    for time in sorted({t for t, done in zip(steps, solved, strict=True) if done}):
        risk = sum(t >= time for t in steps)
        events = sum(done and t == time for t, done in zip(steps, solved, strict=True))
        share *= Fraction(risk - events, risk)
        spread += Fraction(events, risk * (risk - events)) if risk > events else 0
        yield time, share, spread


def exact_median(steps, solved, confidence=0.95):
    """The median and its ends (Brookmeyer and Crowley, log-log), without rounding the share."""
    found = [math.nan] * 3
    z = Decimal(stats.norm.ppf((1 + confidence) / 2))
    with localcontext(prec=60):
        for time, share, spread in counted_curve(steps, solved):
            ends = (share, share)
            if share > 0:
                log = (Decimal(share.numerator) / share.denominator).ln()
                width = z * (Decimal(spread.numerator) / spread.denominator).sqrt() / -log
                ends = ((log * width.exp()).exp(), (log * (-width).exp()).exp())
            for place, value in enumerate((share, *ends)):
                if math.isnan(found[place]) and value <= Fraction(1, 2):
                    found[place] = time
    return found


def half_solved(num_seeds):
    """Half solve it one after another, the others never."""
    return range(1, num_seeds + 1), [place < num_seeds // 2 for place in range(num_seeds)]


@pytest.mark.parametrize("num_seeds", [24, 38, 44, 46, 54, 62, 66, 74, 88, 102, 104, 128, 1000])
def test_the_median_where_exactly_half_solved_it(num_seeds):
    assert median_steps(*half_solved(num_seeds)).value == num_seeds // 2


@pytest.mark.parametrize("censored", [(13,), (7, 8, 9)])
def test_the_median_where_seeds_before_it_are_censored(censored):
    num_seeds, expected = (24, 12) if censored == (13,) else (15, 10)
    steps = np.arange(1, num_seeds + 1)
    assert median_steps(steps, ~np.isin(steps, censored)).value == expected


def test_median_and_ends_are_those_of_fractions():
    """Of all sizes to 40, with ties and censoring of every share; an exact half in 30 or more."""
    random, halves = np.random.default_rng(5), 0
    for num_seeds in range(6, 41):
        for censored in (0.0, 0.1, 0.3, 0.5, 0.7):
            for most in (num_seeds, 8):
                steps = random.integers(1, most + 1, num_seeds).tolist()
                solved = (random.random(num_seeds) >= censored).tolist()
                halves += any(x == Fraction(1, 2) for _, x, _ in counted_curve(steps, solved))
                found = median_steps(steps, solved)
                np.testing.assert_array_equal(found, exact_median(steps, solved))
    assert halves >= 30


def test_median_interval_is_between_order_statistics():
    """Of a hundred, the 40th and the 61st cover with 96.5%, the 41st and the 60th with 94.3%."""
    value, low, high = median_steps(np.arange(1, 101), np.full(100, True))
    assert value == 50
    assert low in (40, 41)
    assert high in (60, 61)


def test_restricted_mean_without_censoring_before_the_end_is_the_mean():
    times = np.random.default_rng(1).exponential(size=30)
    steps = np.minimum(times, 1.2)
    found = restricted_mean(steps, times <= 1.2, 1.2)
    low, high = stats.ttest_1samp(steps, 0).confidence_interval()
    np.testing.assert_allclose(found, [steps.mean(), low, high])


def test_restricted_mean_by_hand():
    """One of four is lost at 2: after 1 the share is 3/4, after 3, of two left, it is 3/8."""
    value, low, high = restricted_mean([1, 2, 3, 4], [True, False, True, False], 4, 0.8)
    assert value == pytest.approx(1 + 0.75 * 2 + 0.375)
    error = np.sqrt((1.875**2 / (4 * 3) + 0.375**2 / (2 * 1)) * 4 / 3)
    half = stats.t.ppf(0.9, 3) * error
    np.testing.assert_allclose([low, high], [max(value - half, 0), min(value + half, 4)])


def test_restricted_mean_ends_where_training_does():
    with pytest.raises(ValueError, match="until: 9 env steps, but the longest seed has 4"):
        restricted_mean([1, 4], [True, False], 9)


def test_no_seed_or_every_seed_solves():
    never = np.zeros(6, bool)
    assert np.all(np.isnan(median_steps(np.full(6, 100), never)))
    assert restricted_mean(np.full(6, 100), never, 100).value == 100
    np.testing.assert_allclose(median_steps(np.full(6, 100), ~never), 100)
    assert restricted_mean(np.full(6, 100), ~never, 100).value == 100


def expected_less_observed(steps, solved, others, others_solved):
    """Mantel's statistic by its definition: a table of two rows at each time that a seed solves."""
    difference = variance = 0.0
    for when in np.unique(np.concatenate([steps[solved], others[others_solved]])):
        left, right = np.sum(steps >= when), np.sum(others >= when)
        events = np.sum(steps[solved] == when) + np.sum(others[others_solved] == when)
        total = left + right
        difference += np.sum(steps[solved] == when) - events * left / total
        if total > 1:
            variance += events * left * right * (total - events) / (total**2 * (total - 1))
    return difference / np.sqrt(variance)


def test_log_rank_is_mantels():
    random = np.random.default_rng(4)
    steps, others = random.integers(1, 30, 25), random.integers(5, 40, 31)
    solved, others_solved = random.random(25) < 0.7, random.random(31) < 0.6
    found = log_rank(steps, solved, others, others_solved)
    by_hand = expected_less_observed(steps, solved, others, others_solved)
    assert found.statistic == pytest.approx(by_hand)
    assert found.statistic > 0  # the first solve it sooner
    assert found.p_value == pytest.approx(2 * stats.norm.sf(abs(by_hand)))
    turned = log_rank(others, others_solved, steps, solved)
    assert turned.statistic == pytest.approx(-found.statistic)


def test_log_rank_of_what_does_not_differ():
    none, all_of_them = np.zeros(4, bool), np.ones(4, bool)
    for solved in (none, all_of_them):
        assert log_rank([7] * 4, solved, [7] * 4, solved) == (0.0, 1.0)


def test_mean_while_training_is_the_area_by_the_width():
    steps = np.array([[0, 0, 0], [10, 10, 10], [30, 10, 30]])
    returns = np.array([[0.0, 4.0, 1.0], [10.0, 8.0, np.nan], [10.0, 8.0, 1.0]])
    whole = mean_while_training(returns, steps, 30)
    assert whole[:2].tolist() == pytest.approx([(50 + 200) / 30, 6.0])  # the second stood still
    assert np.isnan(whole[2])
    assert mean_while_training(returns, steps, 5)[0] == pytest.approx(2.5)
    assert mean_while_training(returns[:1], steps[:1], 5).tolist() == [0.0, 4.0, 1.0]
