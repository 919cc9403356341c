"""Statistics over seeds: what a few numbers can and cannot say of a distribution."""

import warnings
from typing import Any

import numpy as np
from scipy import stats

_RESAMPLES = 5000


def iqm(values: np.ndarray, axis: int = -1) -> np.ndarray:
    """Returns the interquartile mean: the mean of the middle half (Agarwal et al. 2021).

    It is robust to a few failed or lucky seeds and uses more data than the median
    (arXiv:2108.13264, section 4.3). Fewer than four values are averaged whole.
    """
    return stats.trim_mean(values, 0.25, axis=axis)


def iqm_interval(
    values: np.ndarray, axis: int = -1, confidence: float = 0.95
) -> tuple[np.ndarray, np.ndarray]:
    """Returns a percentile-bootstrap confidence interval of the interquartile mean over seeds.

    Args:
      values: one entry a seed along ``axis``.
      axis: the seeds.
      confidence: the interval's level.

    Returns:
      Its lower and upper ends; one seed gives no interval and both ends are NaN.
    """
    values = np.asarray(values, float)
    if values.shape[axis] < 2:
        nan = np.full(iqm(values, axis).shape, np.nan)
        return nan, nan
    with warnings.catch_warnings():
        # Seeds that all score the same have an interval of width zero, which is right.
        warnings.simplefilter("ignore", stats.DegenerateDataWarning)
        interval = stats.bootstrap(
            (values,),
            iqm,
            axis=axis,
            confidence_level=confidence,
            n_resamples=_RESAMPLES,
            method="percentile",
            vectorized=True,
            rng=np.random.default_rng(0),
        ).confidence_interval
    return interval.low, interval.high


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
    first = np.argmax(solved, axis=0)
    return [int(env_steps[e, s]) if solved[e, s] else None for s, e in enumerate(first)]


def summarize(history: dict[str, np.ndarray], threshold: float | None) -> dict[str, Any]:
    """Returns the statistics over seeds of a run.

    Args:
      history: ``eval_return``, and the ``env_steps`` and ``episodes`` until then, each
        [E, S]: evaluations by seeds.
      threshold: the return that counts as solved, if any.

    Returns:
      ``final_returns`` [S], their interquartile mean ``iqm`` with its 95 %
      interval ``iqm_ci``, ``solve_rate`` (the fraction of seeds whose last
      evaluation reached the threshold, None without one), and
      ``env_steps_to_solve`` and ``episodes_to_solve`` [S], until the first that did.
    """
    final = history["eval_return"][-1]
    low, high = iqm_interval(final)
    return {
        "final_returns": final.tolist(),
        "iqm": float(iqm(final)),
        "iqm_ci": [float(low), float(high)],
        "solve_rate": None if threshold is None else float(np.mean(final >= threshold)),
        "env_steps_to_solve": steps_to_solve(
            history["eval_return"], history["env_steps"], threshold
        ),
        "episodes_to_solve": steps_to_solve(history["eval_return"], history["episodes"], threshold),
    }


def smooth(values: np.ndarray, window: int) -> np.ndarray:
    """Returns the mean of each value [U, ...] and up to ``window`` - 1 before it."""
    sums = np.cumsum(np.concatenate([np.zeros_like(values[:1]), values]), axis=0)
    first = np.maximum(np.arange(len(values)) + 1 - window, 0)
    count = np.arange(len(values)) + 1 - first
    return (sums[1:] - sums[first]) / count.reshape(-1, *(1,) * (values.ndim - 1))
