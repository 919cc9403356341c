"""Times the statistics of a sweep: 16 configurations of 1,024 seeds, 200 evaluations each.

Prints the seconds of each part, all imports and resamples included, and the most memory held.
"""

import time
from pathlib import Path

STARTED = time.perf_counter()

import numpy as np  # noqa: E402, which is part of the time

from mjx_reinforce.reports import statistics  # noqa: E402
from mjx_reinforce.reports.statistics import (  # noqa: E402
    aggregates,
    comparisons,
    power,
    profiles,
    survival,
)

CONFIGURATIONS, EVALUATIONS, SEEDS = 16, 200, 1024
THRESHOLD = 10.0


def main() -> None:
    """Prints the table."""
    print(f"{time.perf_counter() - STARTED:6.2f} s  imports")
    random = np.random.default_rng(0)
    curves = random.normal(size=(CONFIGURATIONS, EVALUATIONS, SEEDS)).cumsum(axis=1)
    curves += np.arange(CONFIGURATIONS)[:, None, None]
    steps = np.broadcast_to(1000 * np.arange(EVALUATIONS)[:, None], curves.shape[1:])
    final, grid = curves[:, -1], np.linspace(-50, 70, 200)
    parts = {
        "bands of the curves": lambda: [
            (statistics.iqm(curve), statistics.iqm_interval(curve)) for curve in curves
        ],
        "mean, median, IQM, gap, CVaR": lambda: [
            aggregates.interval(name, final, target=THRESHOLD)
            for name in ("mean", "median", "iqm", "optimality-gap", "cvar")
        ],
        "times to the threshold": lambda: [_times(curve, steps) for curve in curves],
        "profiles": lambda: [profiles.performance_profile(row, grid) for row in final],
        "120 pairs": lambda: comparisons.compare_all(list(final)),
        "seeds needed, wrong winners of one pair": lambda: (
            power.seeds_needed(final[0], final[1]),
            [power.wrong_winner(final[0], final[1], num_seeds) for num_seeds in (3, 5, 10)],
        ),
    }
    for name, part in parts.items():
        before = time.perf_counter()
        part()
        print(f"{time.perf_counter() - before:6.2f} s  {name}")
    print(f"{time.perf_counter() - STARTED:6.2f} s  all")
    status = Path("/proc/self/status").read_text(encoding="utf-8")
    print(f"{int(status.split('VmHWM:')[1].split()[0]) / 1024:6.0f} MB")


def _times(curve: np.ndarray, steps: np.ndarray) -> None:
    seeds = survival.time_to_threshold(curve, steps, THRESHOLD)
    survival.kaplan_meier(*seeds)
    survival.median_steps(*seeds)
    survival.restricted_mean(*seeds, until=float(steps[-1, 0]))
    aggregates.wilson(survival.collapses(curve, THRESHOLD).sum(), SEEDS)


if __name__ == "__main__":
    main()
