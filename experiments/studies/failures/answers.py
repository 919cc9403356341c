"""What the runs say: each change against the base on the same seeds, and the scale's part."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy import stats

from experiments.studies.failures.measures import COMPARED, LOOKS, Arrays, Kept
from experiments.studies.failures.runs import SOLVED
from mjx_reinforce.reports.statistics import Estimate
from mjx_reinforce.reports.statistics.aggregates import wilson
from mjx_reinforce.reports.statistics.comparisons import holm, probability_of_improvement


class Arm(NamedTuple):
    """What the seeds of a setting did.

    name: the arm
    num_seeds: S
    failing: the share whose last policy is below the threshold without noise
    failures, never, stand: how many, how many of them never were above, how many are with noise
    fallen: the share that fell below it again in one evaluation at least
    fallen_evaluations: the share of such evaluations, of all after the first solved one
    median, slowest: env steps to solve, the median and the 99 % quantile (inf: never)
    p_failing, p_fallen: of no difference from the base on the same seeds, exact McNemar tests,
      after Holm for all arms; NaN for the base
    """

    name: str
    num_seeds: int
    failing: Estimate
    failures: int
    never: int
    stand: int
    fallen: Estimate
    fallen_evaluations: float
    median: float
    slowest: float
    p_failing: float
    p_fallen: float


class Quarter(NamedTuple):
    """A quarter of the base's seeds by the position's scale, ``low`` to ``high`` (m)."""

    low: float
    high: float
    failing: Estimate
    fallen: Estimate


class Contrast(NamedTuple):
    """How a measure of failing seeds differs from that of others.

    chance: the probability that a failing seed has the greater value
    failing, others: medians
    """

    measure: str
    update: int
    chance: Estimate
    failing: float
    others: float


def fails(seeds: Arrays) -> np.ndarray:
    """Returns which seeds [S] fail."""
    return ~(seeds["final_return"] >= SOLVED)


def falls_again(seeds: Arrays) -> np.ndarray:
    """Returns which seeds [S] fell again after they had solved the task."""
    return seeds["fallen"] > 0


def arms(kept: Kept) -> list[Arm]:
    """Returns what every arm did."""
    base, *others = kept.seeds
    adjusted = [
        holm([_mcnemar(bad(kept.seeds[base]), bad(kept.seeds[name])) for name in others])
        for bad in (fails, falls_again)
    ]
    p_values = zip(*adjusted, strict=True)
    return [
        _arm(base, kept.seeds[base], np.nan, np.nan),
        *(_arm(name, kept.seeds[name], *p) for name, p in zip(others, p_values, strict=True)),
    ]


def _arm(name: str, seeds: Arrays, p_failing: float, p_fallen: float) -> Arm:
    bad, count = fails(seeds), len(seeds["final_return"])
    steps = np.where(np.isnan(seeds["steps_to_solve"]), np.inf, seeds["steps_to_solve"])
    median, slowest = np.quantile(steps, (0.5, 0.99), method="inverted_cdf")
    return Arm(
        name=name,
        num_seeds=count,
        failing=wilson(bad.sum(), count),
        failures=int(bad.sum()),
        never=int((bad & np.isinf(steps)).sum()),
        stand=int((bad & (seeds["final_sampled"] >= SOLVED)).sum()),
        fallen=wilson(falls_again(seeds).sum(), count),
        fallen_evaluations=float(seeds["fallen"].sum() / seeds["evaluations"].sum()),
        median=float(median),
        slowest=float(slowest),
        p_failing=float(p_failing),
        p_fallen=float(p_fallen),
    )


def _mcnemar(first: np.ndarray, second: np.ndarray) -> float:
    """Returns the p value of equal shares on the same seeds; the shorter one's seeds count."""
    count = min(len(first), len(second))
    only = first[:count] & ~second[:count], second[:count] & ~first[:count]
    apart = int(only[0].sum() + only[1].sum())
    return float(stats.binomtest(int(only[0].sum()), apart).pvalue) if apart else 1.0


def quarters(kept: Kept) -> list[Quarter]:
    """Returns the quarters of the base's seeds by the scale of their last policies."""
    seeds = kept.seeds["base"]
    scale = kept.base["scale_position_0"]
    found = []
    for chosen in np.array_split(np.argsort(scale), 4):
        count = len(chosen)
        found.append(
            Quarter(
                float(scale[chosen].min()),
                float(scale[chosen].max()),
                wilson(fails(seeds)[chosen].sum(), count),
                wilson(falls_again(seeds)[chosen].sum(), count),
            )
        )
    return found


def contrasts(kept: Kept, updates: Sequence[int] = LOOKS) -> list[Contrast]:
    """Returns how the failing seeds of the base differ from the others."""
    bad = fails(kept.seeds["base"])
    found = []
    for measure in COMPARED:
        for update in updates:
            x = kept.base[f"{measure}_{update}"]
            seen = np.isfinite(x)
            failing, others = x[seen & bad], x[seen & ~bad]
            chance = probability_of_improvement(failing, others)
            medians = float(np.median(failing)), float(np.median(others))
            found.append(Contrast(measure, update, chance, *medians))
    return found
