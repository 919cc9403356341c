"""What charts show of an evaluation of many seeds: statistics, and a few seeds one by one."""

import numpy as np

from mjx_reinforce.reports.statistics import iqm, iqm_interval
from mjx_reinforce.training.rows import Cells

#: Seeds that are shown one by one, the first ones: each is a curve for every column.
MAX_SINGLE_SEEDS = 16
#: Columns that say when an evaluation was; what is shown is their mean.
_PROGRESS = ("env_steps", "episodes", "wall_seconds")
_QUANTILES = (5, 25, 50, 75, 95)
#: The interval is drawn from thousands of resamples, so the returns that matter alone have it.
_WITH_INTERVAL = ("eval_return",)


def chart_step(rows: Cells) -> int:
    """Returns the place of an evaluation on the axis of charts: the most updates of a seed."""
    return max(map(int, rows["update"]))


def measured(rows: Cells) -> dict[str, np.ndarray]:
    """Returns the columns [S] of one evaluation that were measured."""
    apart = ("seed", "update", *_PROGRESS)
    names = [name for name, cells in rows.items() if name not in apart and cells[0]]
    return {name: np.array(rows[name], float) for name in names}


def scalars(rows: Cells) -> dict[str, float]:
    """Returns the numbers that are shown, by name, such as ``eval_return/iqm``.

    For each column: ``iqm``, ``lowest`` (of returns, the worst seed), ``highest`` and quantiles;
    for the evaluation's return also ``iqm_low`` and ``iqm_high``, its 95 % interval; and
    ``seed_0`` and so on, of the first ``MAX_SINGLE_SEEDS``. A value that is not finite counts as
    less than any other; what it reaches is NaN.

    Args:
      rows: of one evaluation.
    """
    shown = {f"progress/{name}": float(np.array(rows[name], float).mean()) for name in _PROGRESS}
    for name, values in measured(rows).items():
        numbers = _summary(values)
        if name in _WITH_INTERVAL:
            low, high = iqm_interval(values)
            numbers |= {"iqm_low": float(low), "iqm_high": float(high)}
        numbers |= {f"seed_{i}": float(x) for i, x in enumerate(values[:MAX_SINGLE_SEEDS])}
        shown |= {f"{name}/{key}": x for key, x in numbers.items()}
    return shown


def _summary(values: np.ndarray) -> dict[str, float]:
    """Returns statistics over the seeds of values [S]."""
    failed_last = np.where(np.isfinite(values), values, -np.inf)
    # Not interpolated: between a failed seed and another there is no number.
    found = np.percentile(failed_last, (0, *_QUANTILES, 100), method="inverted_cdf")
    names = ("lowest", *(f"quantile_{q:02}" for q in _QUANTILES), "highest")
    quantiles = np.where(np.isfinite(found), found, np.nan)
    return {"iqm": float(iqm(values))} | dict(zip(names, quantiles.tolist(), strict=True))
