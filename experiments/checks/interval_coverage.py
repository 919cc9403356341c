"""How often each interval of mjx_reinforce/reports covers the truth, by simulation.

Prints a Markdown table: interval and distribution by number of seeds, in percent of the draws,
with the standard error of that share. ``--draws 10000`` takes minutes on one core.
"""

import argparse
import functools
import math
from collections.abc import Callable, Iterator

import numpy as np
from scipy import stats

from experiments.studies.seeds import answers
from mjx_reinforce.statistics import comparisons, iqm_interval, mean_interval, survival, wilson

SEEDS = (6, 20, 50, 200)


def solved_or_not(u: np.ndarray) -> np.ndarray:
    """Seven of ten seeds have the highest return there is, 1000; the others have 50 to 950."""
    return np.where(u < 0.3, 50 + 3000 * u, 1000.0)


def two_peaks(u: np.ndarray) -> np.ndarray:
    """A third of the seeds have 100 to 300, the others 800 to 1000."""
    return np.where(u < 1 / 3, 100 + 600 * u, 700 + 300 * u)


#: Distributions of a return, as quantile functions.
DISTRIBUTIONS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "normal": stats.norm.ppf,
    "skewed (exponential)": stats.expon.ppf,
    "solved or not": solved_or_not,
    "two peaks": two_peaks,
    "heavy tail (Student's t, 3)": stats.t(3).ppf,
}
#: Intervals, and the part of the ordered seeds that each is of the mean of.
INTERVALS = {"mean": (mean_interval, 0, 1), "iqm": (iqm_interval, 0.25, 0.75)}


def truth(quantile: Callable[[np.ndarray], np.ndarray], low: float, high: float) -> float:
    """Returns the mean of a part of the distribution itself, from a million of its quantiles."""
    values = quantile((np.arange(10**6) + 0.5) / 10**6)
    return float(np.mean(values[int(low * 10**6) : int(high * 10**6)]))


def one_sample(draws: int) -> Iterator[tuple[str, str, list[str]]]:
    """Yields interval, distribution and coverage by seeds for statistics of one configuration."""
    for statistic, (interval, low, high) in INTERVALS.items():
        for name, quantile in DISTRIBUTIONS.items():
            true = truth(quantile, low, high)
            cells = []
            for num_seeds in SEEDS:
                values = quantile(np.random.default_rng(num_seeds).random((draws, num_seeds)))
                cells.append(share(*interval(values), true=true))
            yield statistic, name, cells


def rates(draws: int) -> Iterator[tuple[str, str, list[str]]]:
    """Yields the same for a rate: solved, collapsed."""
    for rate in (0.5, 0.9, 0.97):
        cells = []
        for num_seeds in SEEDS:
            count = np.random.default_rng(num_seeds).binomial(num_seeds, rate, draws)
            cells.append(share(*wilson(count, num_seeds)[1:], rate))
        yield "rate (Wilson)", f"{100 * rate:.0f}%", cells


def _one_luck(random: np.random.Generator, shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Two configurations on the same seeds: each seed is lucky or not in both."""
    luck = random.normal(size=shape)
    return luck + random.normal(0.5, 0.5, shape), luck + random.normal(0, 0.5, shape)


def _solved_twice(
    random: np.random.Generator, shape: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """One configuration solves nine seeds of ten, the other seven."""
    first, second = random.random(shape), random.random(shape)
    return np.where(first < 0.1, 50 + 9000 * first, 1000.0), solved_or_not(second)


def _heavy(random: np.random.Generator, shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    return random.standard_t(3, shape) + 1, random.standard_t(3, shape)


PAIRS = {"normal, correlated": _one_luck, "solved or not": _solved_twice, "heavy tail": _heavy}


def two_samples(draws: int) -> Iterator[tuple[str, str, list[str]]]:
    """Yields the same for comparisons of two configurations."""
    better = comparisons.probability_of_improvement
    same = functools.partial(comparisons.probability_of_improvement, paired=True)
    for name, pair in PAIRS.items():
        x, y = pair(np.random.default_rng(1), (1000, 1000))
        true = {
            "probability of improvement": np.mean(better(x, y).value),
            "the same, paired": np.mean(better(x, y).value),
            "paired difference (t)": np.mean(x - y),
        }
        cells: dict[str, list[str]] = {kind: [] for kind in true}
        for num_seeds in SEEDS:
            x, y = pair(np.random.default_rng(num_seeds), (draws, num_seeds))
            for kind, function in (
                ("probability of improvement", better),
                ("the same, paired", same),
                ("paired difference (t)", comparisons.paired_difference),
            ):
                cells[kind].append(share(*function(x, y)[1:3], float(true[kind])))
        for kind, row in cells.items():
            yield kind, name, row


def paired_rates(draws: int) -> Iterator[tuple[str, str, list[str]]]:
    """Yields the same for the difference of two rates on the same seeds."""
    for first, second, alike in ((0.9, 0.7, 0.5), (0.99, 0.97, 0.5), (1.0, 0.995, 0.0)):
        name = f"{100 * first:g}% and {100 * second:g}%" + (", correlated" if alike else "")
        cells = []
        for num_seeds in SEEDS:
            random = np.random.default_rng(num_seeds)
            luck = random.random((2, draws, num_seeds))
            shared = random.random((draws, num_seeds)) < alike
            luck[1] = np.where(shared, luck[0], luck[1])
            found = answers.paired_rates(luck[0] < first, luck[1] < second)
            cells.append(share(*found[1:3], first - second))
        yield "difference of paired rates (Newcombe)", name, cells


def times(draws: int) -> Iterator[tuple[str, str, list[str]]]:
    """Yields the same for env steps to a threshold, which are lognormal with the median 1."""
    for name, solved_share, earliest in (
        ("1 of 10 unsolved", 0.9, 1.0),
        ("4 of 10 unsolved", 0.6, 1.0),
        ("2 of 10 unsolved, different budgets", 0.8, 0.5),
    ):
        last = float(stats.lognorm(1).ppf(solved_share))
        until = earliest * last
        quantiles = stats.lognorm(1).ppf((np.arange(10**6) + 0.5) / 10**6)
        true = {"median steps": 1.0, "restricted mean": np.mean(np.minimum(quantiles, until))}
        cells: dict[str, list[str]] = {kind: [] for kind in true}
        for num_seeds in SEEDS:
            random = np.random.default_rng(num_seeds)
            time = random.lognormal(size=(draws, num_seeds))
            end = random.uniform(until, last, time.shape)
            runs = [*zip(np.minimum(time, end), time <= end, strict=True)]
            medians = np.array([survival.median_steps(*run) for run in runs])
            means = np.array([survival.restricted_mean(*run, until) for run in runs])
            for kind, found in zip(true, (medians, means), strict=True):
                cells[kind].append(share(found[:, 1], found[:, 2], float(true[kind])))
        for kind, row in cells.items():
            yield kind, name, row


def share(low: np.ndarray, high: np.ndarray, true: float) -> str:
    """Returns how many of the intervals cover the truth, in percent, with its standard error.

    An end that is NaN bounds nothing, so it covers; draws without an interval, with two such ends,
    do not count, and where there is no other, a dash.
    """
    given = ~(np.isnan(low) & np.isnan(high))
    if not given.any():
        return "-"
    slack = 1e-9 * max(1.0, abs(true))
    covered = float(np.mean((~(low > true + slack) & ~(high < true - slack))[given]))
    return f"{100 * covered:.1f} ± {100 * math.sqrt(covered * (1 - covered) / given.sum()):.1f}"


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=10_000)
    draws = parser.parse_args().draws
    print(f"Share of {draws:,} draws whose 95% interval covers the truth, in percent\n")
    print("| interval | distribution |", *(f"{n} seeds |" for n in SEEDS))
    print("|---|---|" + "---|" * len(SEEDS))
    for part in (f(draws) for f in (one_sample, rates, two_samples, paired_rates, times)):
        for interval, distribution, cells in part:
            print(f"| {interval} | {distribution} |", *(f"{c} |" for c in cells), flush=True)


if __name__ == "__main__":
    main()
