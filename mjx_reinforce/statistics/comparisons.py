"""Which of two configurations is better, by how much, how sure that is, and with how many seeds."""

import itertools
import math
import warnings
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats

from mjx_reinforce.statistics import Estimate, alike, enough, wilson, worst_if_not_finite

#: Experiments that are drawn to see how often a test of few seeds is right.
_EXPERIMENTS = 2000
#: Up to so many seeds tests are drawn; beyond, means are as good as normal.
_DRAWN_SEEDS = 500
_MOST_SEEDS = 10_000


class Difference(NamedTuple):
    """How much higher the first of two configurations is, and how sure it is that they differ.

    value: the difference, first minus second, in units of return.
    low, high: its confidence interval.
    p_value: of no difference, two-sided.
    """

    value: Any
    low: Any
    high: Any
    p_value: Any


class Comparison(NamedTuple):
    """Two configurations, ``first`` and ``second`` being their places in the list.

    improvement: the probability that a seed of the first is better than one of the second.
    difference: how much higher the first's mean is, in units of return.
    p_value: of no difference, two-sided.
    adjusted: the same after Holm's correction for all pairs.
    """

    first: int
    second: int
    improvement: Estimate
    difference: Estimate
    p_value: float
    adjusted: float


def probability_of_improvement(
    x: ArrayLike, y: ArrayLike, *, paired: bool = False, confidence: float = 0.95
) -> Estimate:
    """Returns the probability that a value of x is above one of y, ties counting half.

    That of Agarwal et al. (2021, arXiv:2108.13264, section 4.3), which is Mann and Whitney's U
    over the number of pairs. The interval is Wilson's, at the number of trials that would give a
    rate the variance this estimate has (DeLong et al. 1988; Kottas et al. 2014, BMC Medical
    Research Methodology 14:26).

    Args:
      x: [..., S] values of one configuration; a seed that failed is worse than every other.
      y: [..., S'] values of another.
      paired: both have the same seeds in the same order. The value is that without, but the
        interval takes account of the luck that they share (Munzel 1999, Statistics in Medicine 18);
        too few show nothing of that luck, and count as one trial each.
      confidence: the interval's level.

    Raises:
      ValueError: paired values of different number.

    Examples:
      >>> import mjx_reinforce as mr
      >>> mr.probability_of_improvement([3.0, 4.0], [1.0, 2.0]).value.item()
      1.0
    """
    x = worst_if_not_finite(x)
    y = worst_if_not_finite(y)
    placements_x, placements_y = _placements(x, y)
    rate = placements_x.mean(axis=-1)
    if not paired:
        variance = _variance_of_mean(placements_x) + _variance_of_mean(placements_y)
    elif x.shape == y.shape:
        # Of the sums, seed by seed: luck that both share is in their covariance.
        variance = _variance_of_mean(placements_x + placements_y)
    else:
        raise ValueError(f"paired values must be as many: {x.shape[-1]} and {y.shape[-1]} given")
    min_seeds = min(x.shape[-1], y.shape[-1])
    # A variance of 1e-20 or less is rounding.
    estimable = (variance > 1e-20) & (rate > 0) & (rate < 1)
    estimable &= not paired or enough(min_seeds, confidence)
    # A rate of n trials has the variance rate (1 - rate) / n, which is solved for n.
    trials = np.where(estimable, rate * (1 - rate) / np.where(estimable, variance, 1), min_seeds)
    return wilson(rate * trials, trials, confidence)


def _variance_of_mean(values: np.ndarray) -> np.ndarray:
    """Returns how uncertain the mean of values [..., S] is, [...]; 0 for one."""
    return values.var(axis=-1) / max(values.shape[-1] - 1, 1)


def _placements(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the share of y below each of x [..., S] and of x above each of y [..., S']."""
    # A rank among all values, less the rank in the value's own group, counts the others below it.
    # Ties have mean ranks, so that they count a half.
    ranks = stats.rankdata(np.concatenate([x, y], axis=-1), axis=-1)
    num_x = x.shape[-1]
    num_y = y.shape[-1]
    placements_x = (ranks[..., :num_x] - stats.rankdata(x, axis=-1)) / num_y
    placements_y = (ranks[..., num_x:] - stats.rankdata(y, axis=-1)) / num_x
    return placements_x, 1 - placements_y


def failures_as_worst(x: ArrayLike, y: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """Returns x and y [..., S], the worst finite value of both for each that is not finite."""
    x = np.asarray(x, float)
    y = np.asarray(y, float)
    values = np.concatenate([x, y], axis=-1)
    worst_value = np.min(values, axis=-1, keepdims=True, initial=np.inf, where=np.isfinite(values))
    # Where all failed, the two are alike, whatever number stands for them.
    worst_value = np.where(np.isfinite(worst_value), worst_value, 0.0)
    return np.where(np.isfinite(x), x, worst_value), np.where(np.isfinite(y), y, worst_value)


def _of_order_one(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns x and y over a power of two, so that no sum and no square overflows or vanishes.

    What does not depend on the unit keeps every bit.
    """
    _, exponent = np.frexp(max(np.max(np.abs(x)), np.max(np.abs(y))))
    return np.ldexp(x, -exponent), np.ldexp(y, -exponent)


def paired_difference(x: ArrayLike, y: ArrayLike, confidence: float = 0.95) -> Difference:
    """Returns how much higher the mean of x is than that of y on the same seeds: paired t-test.

    The test knows only the pairs that it can tell apart, those that differ. That all K of them
    favor the same one has the probability 2^(1 - K) without any difference, so p is no less.

    Args:
      x: [..., S] values of one configuration. A seed that failed counts as the worst finite value
        of both configurations, so the difference it makes is understated.
      y: [..., S] values of another, with the same seeds in the same order.
      confidence: the interval's level.

    Returns:
      Arrays [...]. The interval is NaN for fewer than six seeds, and where all differences are
      equal, because they do not show how far others would lie from them.

    Raises:
      ValueError: x and y differ in number.

    Examples:
      >>> import numpy as np
      >>> import mjx_reinforce as mr
      >>> seeds = np.arange(20.0)
      >>> mr.paired_difference(seeds + 1, seeds).value.item()
      1.0
    """
    if np.shape(x) != np.shape(y):
        raise ValueError(f"paired values must be as many: {np.size(x)} and {np.size(y)} given")
    x, y = failures_as_worst(x, y)
    difference = x - y
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore", RuntimeWarning)  # of equal differences, for which see below
        test = stats.ttest_1samp(difference, 0, axis=-1)
        low, high = test.confidence_interval(confidence)
    # NaN is the p value of equal differences: all pairs favor the same one, or all are ties.
    num_unequal = np.sum(difference != 0, axis=-1)
    min_p = np.minimum(2.0 ** (1 - num_unequal), 1)
    p_value = np.maximum(np.nan_to_num(np.asarray(test[1])), min_p)
    # Differences of large returns have the rounding of the returns.
    size = np.max(np.maximum(np.abs(x), np.abs(y)), axis=-1)
    is_undefined = alike(difference, size) | (not enough(difference.shape[-1], confidence))
    low, high = (np.where(is_undefined, np.nan, end)[()] for end in (low, high))
    return Difference(difference.mean(axis=-1), low, high, p_value[()])


def least_p(first: int, second: int) -> float:
    """Returns the least two-sided p value of a test of two groups of so many seeds, in any order.

    Without a difference, all orders are alike, and in two of them a group is all above the other.
    """
    return 2 / math.comb(first + second, first)


def compare_all(
    values: Sequence[np.ndarray],
    seeds: Sequence[np.ndarray] | None = None,
    confidence: float = 0.95,
) -> list[Comparison]:
    """Compares every pair of configurations, p values corrected after Holm.

    Args:
      values: [S] of each configuration; an entry that is not finite is of a seed that failed.
      seeds: [S] of each configuration the numbers of its seeds, ascending: a pair is compared on
        those that both have. By default all have the same seeds.
      confidence: the level of each interval (which is not corrected).

    Examples:
      >>> import numpy as np
      >>> import mjx_reinforce as mr
      >>> seeds = np.arange(20.0)
      >>> len(mr.compare_all([seeds, seeds + np.sin(seeds), seeds + 5]))  # three pairs
      3
    """
    pairs = list(itertools.combinations(range(len(values)), 2))
    shared = [(values[i], values[j]) for i, j in pairs]
    if seeds is not None:
        shared = [
            (values[i][np.isin(seeds[i], seeds[j])], values[j][np.isin(seeds[j], seeds[i])])
            for i, j in pairs
        ]
    differences = [paired_difference(*pair, confidence=confidence) for pair in shared]
    holm_p_values = holm([difference.p_value for difference in differences])
    return [
        Comparison(
            i,
            j,
            probability_of_improvement(*pair, paired=True, confidence=confidence),
            Estimate(difference.value, difference.low, difference.high),
            difference.p_value,
            float(holm_p_value),
        )
        for (i, j), pair, difference, holm_p_value in zip(
            pairs, shared, differences, holm_p_values, strict=True
        )
    ]


def holm(p_values: ArrayLike) -> np.ndarray:
    """Returns p values [K] corrected for there being K of them (Holm 1979).

    To call significant what is below a level then wrongly does so once or more with at most that
    probability, whatever the tests' dependence.
    """
    p_values = np.asarray(p_values, float)
    order = np.argsort(p_values)
    scaled = p_values[order] * np.arange(len(p_values), 0, -1)
    holm_p_values = np.empty_like(p_values)
    # No p value may come out below that of a pair which is surer.
    holm_p_values[order] = np.minimum(np.maximum.accumulate(scaled), 1.0)
    return holm_p_values


def seeds_needed(
    x: ArrayLike, y: ArrayLike, *, power: float = 0.8, alpha: float = 0.05
) -> int | None:
    """Returns how many seeds each of two configurations needs to be told apart.

    It is the least number at which Welch's t-test of so many seeds, drawn with replacement from x
    and from y, names the better one at the level ``alpha`` with the probability ``power``; four
    at 5%, or more, because of fewer no order is rare enough.

    Args:
      x: [S] values of one configuration, of many seeds; a seed that failed counts as the worst
        finite value of both.
      y: [S'] values of another.
      power: how often the test is to find the difference.
      alpha: the level of the two-sided test.

    Returns:
      None if 10,000 seeds are not enough, or the two have the same mean.
    """
    x, y = _of_order_one(*failures_as_worst(x, y))
    if np.mean(x) == np.mean(y):
        return None
    sufficient_counts = np.flatnonzero(_power_by_seeds(x, y, alpha) >= power)
    if len(sufficient_counts):
        return int(sufficient_counts[0]) + 2
    num_seeds = _by_normal_approximation(x, y, power, alpha)
    return num_seeds if num_seeds <= _MOST_SEEDS else None


def _power_by_seeds(x: np.ndarray, y: np.ndarray, alpha: float) -> np.ndarray:
    """Returns how often the test of 2, 3, ..., 500 seeds each names the better one."""
    random = np.random.default_rng(0)
    count = np.arange(2, _DRAWN_SEEDS + 1)
    middle = np.mean(x)
    means = []
    variances = []
    for values in (x, y):
        # About the middle, so that a sum of squares less a square of sums keeps its digits.
        samples = values[random.integers(0, len(values), (_EXPERIMENTS, _DRAWN_SEEDS))] - middle
        # An experiment of n seeds is the first n draws of a row: one set of draws for all n.
        sums, squares = (np.cumsum(power, axis=1)[:, 1:] for power in (samples, samples**2))
        means.append(sums / count)
        spread = np.maximum(squares - sums**2 / count, 0)
        variances.append(spread / (count - 1) / count)  # of the mean
    difference = (means[0] - means[1]) * np.sign(np.mean(x) - np.mean(y))
    with np.errstate(invalid="ignore", divide="ignore"):
        freedom = (count - 1) * sum(variances) ** 2 / (variances[0] ** 2 + variances[1] ** 2)
        t = difference / np.sqrt(sum(variances))
    # Student's quantile takes long for a million numbers; it is smooth between whole ones.
    degrees = np.arange(1, 2 * _DRAWN_SEEDS)
    freedom = np.where(np.isnan(freedom), 1.0, freedom)  # where nothing varies
    critical_value = np.interp(freedom, degrees, stats.t.isf(alpha / 2, degrees))
    rare_enough = np.array([least_p(n, n) <= alpha for n in count.tolist()])
    return np.mean(t > critical_value, axis=0) * rare_enough


def _by_normal_approximation(x: np.ndarray, y: np.ndarray, power: float, alpha: float) -> int:
    """Returns the seeds needed where the means are normal and their variances known."""
    quantiles = stats.norm.isf(alpha / 2) + stats.norm.ppf(power)
    return math.ceil(quantiles**2 * (np.var(x) + np.var(y)) / (np.mean(x) - np.mean(y)) ** 2)


def wrong_winner(x: ArrayLike, y: ArrayLike, num_seeds: int, draws: int = 10_000) -> float:
    """Returns how often the means of few seeds name the wrong one of two configurations.

    Args:
      x: [S] values of one configuration, of many seeds; a seed that failed counts as the worst
        finite value of both.
      y: [S'] values of another.
      num_seeds: the seeds of each that are drawn, with replacement, and compared.
      draws: how often that is done.

    Returns:
      The share of draws whose winner is not that of all seeds; a draw without a winner counts
      half. NaN where all seeds together have no winner.
    """
    x, y = _of_order_one(*failures_as_worst(x, y))
    random = np.random.default_rng(0)
    drawn_values = [v[random.integers(0, len(v), (draws, num_seeds))] for v in (x, y)]
    truth = np.sign(np.mean(x) - np.mean(y))
    if not truth:
        return math.nan
    # 1 where the draw agrees, -1 where it does not, 0 without a winner.
    agreement = np.sign(drawn_values[0].mean(axis=1) - drawn_values[1].mean(axis=1)) * truth
    return float(np.mean(1 - agreement) / 2)
