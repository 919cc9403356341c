"""How often ``sweep --until-decided`` errs and decides, and what it saves, by simulation.

Prints a Markdown table. A sweep has 64 seeds of each configuration at most, whose returns are
independent. Where nothing differs, any exclusion is an error; elsewhere the exclusion of the best.
Beside it: how often the report of a fixed 64 seeds calls the best better than each other
configuration (paired t-test at 5%, Holm's correction).
"""

import argparse
import itertools
from collections.abc import Callable, Iterator, Sequence

import numpy as np
from scipy import stats

from experiments.checks.interval_coverage import truth, two_peaks
from mjx_reinforce.statistics.comparisons import holm, paired_difference
from mjx_reinforce.statistics.sequential import sequential_test

BUDGET = 64
#: Differences of the best from all others, in standard deviations between seeds.
DIFFERENCES = (0.0, 0.3, 0.6, 1.0)


_MEAN = truth(two_peaks, 0, 1)
_VARIANCE = truth(lambda u: (two_peaks(u) - _MEAN) ** 2, 0, 1)


def _standard_two_peaks(u: np.ndarray) -> np.ndarray:
    """Two peaks with the mean 0 and the standard deviation 1."""
    return (two_peaks(u) - _MEAN) / np.sqrt(_VARIANCE)


#: Distributions of a return, as quantile functions.
DISTRIBUTIONS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "normal": stats.norm.ppf,
    "two peaks": _standard_two_peaks,
}


def draw(
    returns: str, scales: Sequence[float], difference: float, sweeps: int
) -> Iterator[np.ndarray]:
    """Yields sweeps [C, 64] whose last configuration is the best.

    Args:
      returns: the distribution.
      scales: [C] standard deviations.
      difference: of the best from the others.
      sweeps: how many.
    """
    quantile = DISTRIBUTIONS[returns]
    random = np.random.default_rng(0)
    for _ in range(sweeps):
        values = quantile(random.random((len(scales), BUDGET))) * np.array(scales)[:, None]
        values[-1] += difference
        yield values


def is_best_by_report(values: np.ndarray) -> bool:
    """Returns whether a report of all seeds calls the last configuration better than each other."""
    pairs = [*itertools.combinations(range(len(values)), 2)]
    tests = [paired_difference(values[j], values[i]) for i, j in pairs]
    p_values = holm([test.p_value for test in tests])
    best = len(values) - 1
    return all(
        test.value > 0 and p_value < 0.05
        for (_, j), test, p_value in zip(pairs, tests, p_values, strict=True)
        if j == best
    )


def row(returns: str, scales: Sequence[float], difference: float, sweeps: int) -> dict[str, float]:
    """Returns shares of sweeps in percent, and the mean seeds of a configuration."""
    errors, decisions, reports, seeds = 0, 0, 0, 0.0
    best = len(scales) - 1
    for values in draw(returns, scales, difference, sweeps):
        verdict = sequential_test(list(values), BUDGET)
        if difference:
            errors += best not in verdict.contenders
            decisions += verdict.contenders == [best]
            reports += is_best_by_report(values)
        else:
            errors += len(verdict.contenders) < len(scales)
        seeds += float(np.mean(verdict.num_seeds))
    shares = {"wrong": errors, "decided": decisions, "fixed": reports}
    percents = {name: 100 * count / sweeps for name, count in shares.items()}
    mean_seeds = seeds / sweeps
    return percents | {"seeds": mean_seeds, "saved": 100 * (1 - mean_seeds / BUDGET)}


#: Standard deviations of the configurations, by what the table calls them.
CONFIGURATIONS = {
    "2": (1.0, 1.0),
    "2, one varies three times as much": (3.0, 1.0),
    "4": (1.0, 1.0, 1.0, 1.0),
    "4, one varies three times as much": (3.0, 1.0, 1.0, 1.0),
}


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sweeps", type=int, default=2000)
    sweeps = parser.parse_args().sweeps
    print(
        "| returns | configurations | difference | wrong, % | best decided, % | "
        f"the same, fixed {BUDGET}, % | seeds of each | saved, % |"
    )
    print("|" + "---|" * 8)
    for returns, (name, scales), difference in itertools.product(
        DISTRIBUTIONS, CONFIGURATIONS.items(), DIFFERENCES
    ):
        # Unequal spreads matter where nothing differs.
        if difference and len(set(scales)) > 1:
            continue
        figures = row(returns, scales, difference, sweeps)
        decided = [f"{figures[key]:.1f}" if difference else "-" for key in ("decided", "fixed")]
        numbers = [f"{figures['wrong']:.1f}", *decided]
        numbers += [f"{figures['seeds']:.1f}", f"{figures['saved']:.0f}"]
        print(f"| {returns} | {name} | {difference:g} |", " | ".join(numbers), "|", flush=True)


if __name__ == "__main__":
    main()
