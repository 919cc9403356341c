"""Statistics over seeds: what a few numbers can and cannot say of a distribution."""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy import special

from mjx_reinforce.statistics.bootstrap import expanded_tail, percentiles, resampled_trim_means

#: What an interquartile mean leaves out at each end.
_QUARTER = 0.25
#: Points whose resamples are in memory at once.
_POINTS = 400


class Estimate(NamedTuple):
    """A statistic and the ends of its confidence interval: numbers, or arrays of one shape."""

    value: Any
    low: Any
    high: Any


def enough(num_seeds: int, confidence: float = 0.95) -> bool:
    """Returns whether so many seeds can bear an interval: at 95%, six can.

    All seeds lie on one side of the truth, if a seed is as likely to lie on either, with the
    probability 2^(1 - n). No interval within the range of fewer holds the truth as often as it
    says, and no test of signs rejects.
    """
    return 2.0 ** (1 - num_seeds) <= 1 - confidence


def alike(values: np.ndarray, size: Any = 0.0) -> np.ndarray:
    """Returns where values [..., S] differ by no more than the rounding of float32 numbers, [...].

    Args:
      values: finite or -inf.
      size: [...] of the numbers that were rounded, where that is more than the values'.
    """
    low = np.min(values, axis=-1)
    high = np.max(values, axis=-1)
    magnitude = np.maximum(np.maximum(np.abs(low), np.abs(high)), size)
    # Where a value is -inf, the difference is inf or NaN, and never within the tolerance.
    with np.errstate(invalid="ignore"):  # where all failed
        return high - low <= np.finfo(np.float32).eps * np.where(magnitude < np.inf, magnitude, 0.0)


def worst_if_not_finite(values: ArrayLike) -> np.ndarray:
    """Returns the values, -inf for those that are not finite: a seed that failed is the worst."""
    values = np.asarray(values, float)
    return np.where(np.isfinite(values), values, -np.inf)


def iqm(values: np.ndarray, axis: int = -1) -> np.ndarray:
    """Returns the interquartile mean: the mean of the middle half (Agarwal et al. 2021).

    It is robust to a few failed or lucky seeds and uses more data than the median
    (arXiv:2108.13264, section 4.3). Fewer than four values are averaged whole.

    A value that is not finite is of a seed that failed, and counts as worse than every other,
    whatever the sign of returns. Where so many failed that they reach the middle half, there is
    no mean: it is NaN.

    Examples:
      >>> import mjx_reinforce as mr
      >>> mr.iqm([0.0, 1.0, 2.0, 100.0]).item()  # the middle half
      1.5
    """
    lowered_values = np.where(np.isfinite(values), values, -np.inf)
    ranked_values = np.sort(np.moveaxis(lowered_values, axis, -1), axis=-1)
    # Whole seeds, rounded down; failures are cut first, up to a quarter of all seeds.
    cut = int(_QUARTER * ranked_values.shape[-1])
    return finite_or_nan(ranked_values[..., cut : ranked_values.shape[-1] - cut].mean(axis=-1))


def iqm_interval(
    values: np.ndarray, axis: int = -1, confidence: float = 0.95
) -> tuple[np.ndarray, np.ndarray]:
    """Returns a confidence interval of the interquartile mean over seeds.

    It is Hesterberg's expanded percentile bootstrap, see ``bootstrap.expanded_tail``, of 5000
    resamples. At every point the same ranks are drawn, so the interval of a curve's point is that
    of the point alone. docs/statistics.md says how often it covers the truth.

    Args:
      values: one entry a seed along ``axis``; not finite where the seed failed, see ``iqm``.
      axis: the seeds.
      confidence: the interval's level.

    Returns:
      Its lower and upper ends. Both are NaN for fewer than six seeds (see ``enough``), and for
      fewer than eleven seeds that are all alike: that happens one time in twenty even if a quarter
      of all seeds differs. An end is also NaN if so many seeds failed that the resamples around it
      have no mean.

    Examples:
      >>> import numpy as np
      >>> import mjx_reinforce as mr
      >>> low, high = mr.iqm_interval(np.arange(20.0))
      >>> bool(low < 9.5 < high)
      True
    """
    return _expanded_percentiles(
        np.moveaxis(np.asarray(values, float), axis, -1), _QUARTER, confidence
    )


def mean_interval(values: ArrayLike, confidence: float = 0.95) -> tuple[np.ndarray, np.ndarray]:
    """Returns a confidence interval of the mean of values [..., S]; as ``iqm_interval``.

    Seeds that are all alike, however many, do not show how far a rare other would move the mean.

    Examples:
      >>> import numpy as np
      >>> import mjx_reinforce as mr
      >>> low, high = mr.mean_interval(np.arange(20.0))
      >>> bool(low < 9.5 < high)
      True
    """
    return _expanded_percentiles(np.asarray(values, float), 0.0, confidence)


def _expanded_percentiles(
    values: np.ndarray, cut: float, confidence: float
) -> tuple[np.ndarray, np.ndarray]:
    """Returns the ends of the interval of a trimmed mean over the last axis."""
    *shape, num_seeds = values.shape
    points = worst_if_not_finite(values).reshape(-1, num_seeds)
    ends = np.full((2, len(points)), np.nan)
    if enough(num_seeds, confidence):
        # Only means without trimming were seen to spread too little (interval_coverage.py).
        shrinkage = 1.0
        if not cut:
            shrinkage = math.sqrt(1 - 1 / num_seeds)
        tail = expanded_tail(confidence, num_seeds - 1, shrinkage)
        # 5000 means of a point are 40 kB: the points of a large sweep come in blocks.
        for start in range(0, len(points), _POINTS):
            block = slice(start, start + _POINTS)
            ends[:, block] = percentiles(resampled_trim_means(points[block], cut), tail)
        # With this probability no seed of a sample shows that a share ``cut`` of all differs.
        if (1 - cut) ** num_seeds > 1 - confidence:
            ends[:, alike(points)] = np.nan
    low, high = finite_or_nan(ends).reshape(2, *shape)
    return low[()], high[()]


def estimate_mean(values: ArrayLike, confidence: float = 0.95) -> Estimate:
    """Returns the mean over seeds with its confidence interval, see ``mean_interval``.

    Args:
      values: [..., S], the seeds last; not finite where a seed failed.
      confidence: the interval's level.

    Returns:
      Arrays [...]. NaN stands for what does not exist: the mean where a seed failed, an end that
      such resamples decide, both ends where seeds are too few or all alike.
    """
    values = worst_if_not_finite(values)
    return Estimate(finite_or_nan(np.mean(values, axis=-1)), *mean_interval(values, confidence))


def wilson(successes: ArrayLike, trials: ArrayLike, confidence: float = 0.95) -> Estimate:
    """Returns a rate with Wilson's score interval (Wilson 1927), as scipy's ``binomtest`` has it.

    Args:
      successes: how many seeds did it, an array or a number, whole or not.
      trials: of how many, above 0.
      confidence: the interval's level.
    """
    trials = np.asarray(trials)
    rate = np.asarray(successes) / trials
    # The ends solve |rate - p| = z sqrt(p (1 - p) / trials) for p.
    z = -special.ndtri((1 - confidence) / 2)
    middle = (rate + z**2 / (2 * trials)) / (1 + z**2 / trials)
    half = z * np.sqrt(rate * (1 - rate) / trials + (z / (2 * trials)) ** 2) / (1 + z**2 / trials)
    # There the ends are 0 and 1 exactly, and rounding would leave them a little beside.
    low = np.where(rate == 0, 0.0, middle - half)[()]
    high = np.where(rate == 1, 1.0, middle + half)[()]
    return Estimate(rate, low, high)


def cvar(values: ArrayLike, fraction: float = 0.1) -> np.ndarray:
    """Returns the mean of the worst ``fraction`` of the seeds, [...] of values [..., S].

    The conditional value at risk (Rockafellar and Uryasev 2000, Journal of Risk 2(3)). Where
    ``fraction * S`` is not whole, the last seed of the tail counts in part; fewer than
    ``1 / fraction`` seeds give their minimum. NaN where a seed failed.
    """
    sorted_values = np.sort(worst_if_not_finite(values), axis=-1)
    size = fraction * sorted_values.shape[-1]
    weights = np.clip(size - np.arange(math.ceil(size)), 0, 1) / size
    tail = sorted_values[..., : len(weights)]
    # Differences from the last value have no rounding where all values are alike.
    with np.errstate(invalid="ignore"):  # of failed seeds
        return finite_or_nan(tail[..., -1] + (tail - tail[..., -1:]) @ weights)


def finite_or_nan(values: ArrayLike) -> Any:
    """Returns the values, NaN for those that are not finite."""
    return np.where(np.isfinite(values), values, np.nan)[()]


def steps_to_solve(
    returns: np.ndarray, env_steps: np.ndarray, threshold: float | None
) -> list[int | None]:
    """Returns each seed's env steps at its first evaluation at or above the threshold.

    Args:
      returns: [E, S] the deterministic return at each evaluation.
      env_steps: [E, S] the env steps trained until then.
      threshold: the return that counts as solved, or None where there is none.

    Returns:
      [S] env steps, None for a seed that never got there.
    """
    if threshold is None:
        return [None] * returns.shape[1]
    solved = returns >= threshold
    # 0 for a seed that never got there, too.
    evaluation = np.argmax(solved, axis=0)
    return [int(env_steps[e, s]) if solved[e, s] else None for s, e in enumerate(evaluation)]


def summarize(history: dict[str, np.ndarray], threshold: float | None) -> dict[str, Any]:
    """Returns the statistics over seeds of a run.

    Args:
      history: ``eval_return``, and the ``env_steps`` and ``episodes`` until then, each
        [E, S]: evaluations by seeds.
      threshold: the return that counts as solved, if any.

    Returns:
      ``final_returns`` [S], NaN of a seed that failed; their interquartile mean ``iqm`` with
      its 95% interval ``iqm_ci``, where a failed seed counts as the worst; how many seeds have
      that as their last return, ``seeds_nonfinite_at_end``. Then of the threshold, None without
      one: how many seeds reached it in their last evaluation, ``seeds_solved_at_end``, also as a
      fraction, ``solve_rate``; how many in any evaluation, ``seeds_ever_solved``; and
      ``env_steps_to_solve`` and ``episodes_to_solve`` [S], until the first that did.
    """
    returns = history["eval_return"]
    final = returns[-1]
    low, high = iqm_interval(final)
    # The keys are there without a threshold, too, so that a program can rely on them.
    counts: dict[str, Any] = dict.fromkeys(
        ("seeds_solved_at_end", "seeds_ever_solved", "solve_rate")
    )
    if threshold is not None:
        solved = returns >= threshold
        counts = {
            "seeds_solved_at_end": int(solved[-1].sum()),
            "seeds_ever_solved": int(solved.any(axis=0).sum()),
            "solve_rate": float(np.mean(solved[-1])),
        }
    return {
        "final_returns": final.tolist(),
        "iqm": float(iqm(final)),
        "iqm_ci": [float(low), float(high)],
        "seeds_nonfinite_at_end": int(np.sum(~np.isfinite(final))),
        **counts,
        "env_steps_to_solve": steps_to_solve(returns, history["env_steps"], threshold),
        "episodes_to_solve": steps_to_solve(returns, history["episodes"], threshold),
    }
