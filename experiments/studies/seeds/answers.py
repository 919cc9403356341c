"""The comparisons of the seeds study: how large each effect is, and how sure that is."""

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy import stats

from experiments.studies.seeds.runs import Task
from mjx_reinforce.statistics import iqm, wilson
from mjx_reinforce.statistics.comparisons import (
    Difference,
    holm,
    paired_difference,
    probability_of_improvement,
)

#: Where a setting is not compared: the program's defaults.
DEFAULTS = {"estimator": "leave-one-out", "discount_weights": False, "standardize": True}
#: Each half of the seeds chooses the learning rates at which the other half is reported.
HALVES = slice(0, None, 2), slice(1, None, 2)
LEVEL = 0.05


def paired_rates(x: np.ndarray, y: np.ndarray, confidence: float = 0.95) -> Difference:
    """Returns how much higher the rate of x is than that of y on the same seeds.

    The interval is Newcombe's (1998, Statistics in Medicine 17, 2635-2650, method 10): Wilson's of
    both rates, squared and added, with the correlation of the pairs. Unlike that of a t-test it has
    width also where all seeds agree. The p value is McNemar's exact one: of the seeds that tell x
    from y, as many would be for either.

    Args:
      x: [..., S] whether each seed of one configuration did it, such as solve the task.
      y: [..., S] the same of another, with the same seeds in the same order.
      confidence: the interval's level.
    """
    x, y = x.astype(bool), y.astype(bool)
    num_seeds = x.shape[-1]
    both, first, second, none = (np.sum(a & b, axis=-1) for a in (x, ~x) for b in (y, ~y))
    of_x, of_y = (wilson(z.sum(axis=-1), num_seeds, confidence) for z in (x, y))
    value = of_x.value - of_y.value
    # The correlation, shrunk where it is positive; 0 where a rate is 0 or 1.
    product = 1.0 * both * none - 1.0 * first * second
    shrunk = np.where(product < 0, product, np.maximum(product - num_seeds / 2, 0))
    spread = num_seeds**2 * np.sqrt(of_x.value * (1 - of_x.value) * of_y.value * (1 - of_y.value))
    correlation = np.divide(shrunk, spread, out=np.zeros_like(value), where=spread > 0)
    ((down, up), (lower, upper)) = ((z.value - z.low, z.high - z.value) for z in (of_x, of_y))
    low, high = (
        np.sqrt(a**2 - 2 * correlation * a * b + b**2) for a, b in ((down, upper), (lower, up))
    )
    fewer = stats.binom.cdf(np.minimum(first, second), first + second, 0.5)
    return Difference(value, value - low, value + high, np.minimum(2 * fewer, 1.0))


class Contrast(NamedTuple):
    """Two values of a setting that are compared; the question is about the first.

    question: what it belongs to
    factor: the setting
    levels: its two values
    names: what these are called
    """

    question: str
    factor: str
    levels: tuple[Any, Any]
    names: tuple[str, str]

    @property
    def name(self) -> str:
        """What the comparison is called."""
        return " against ".join(self.names)


_LEARNED, _OTHERS, _NONE = "learned", "leave-one-out", "none"
CONTRASTS = (
    Contrast("baseline", "estimator", ("value-baseline", "reward-to-go"), (_LEARNED, _NONE)),
    Contrast("baseline", "estimator", ("value-baseline", "leave-one-out"), (_LEARNED, _OTHERS)),
    Contrast("baseline", "estimator", ("leave-one-out", "reward-to-go"), (_OTHERS, _NONE)),
    Contrast("discount", "discount_weights", (True, False), ("gamma^t", "without")),
    Contrast("normalize", "standardize", (True, False), ("normalized", "raw")),
)


class Measure(NamedTuple):
    """What a run is judged by.

    values: of a task, [..., S]
    statistic: over seeds, "iqm", "mean" or "rate"
    sign: 1 where more is better, else -1
    """

    values: Callable[[Task], np.ndarray]
    statistic: str
    sign: int


MEASURES = {
    "final return": Measure(lambda task: task.final_return, "iqm", 1),
    "solved at the end": Measure(
        lambda task: (task.final_return >= task.threshold).astype(float), "rate", 1
    ),
    "average return": Measure(lambda task: task.average_return, "mean", 1),
    "env steps to solve": Measure(lambda task: task.steps_to_solve, "mean", -1),
}


#: The learning rates of two arms.
Rates = tuple[tuple[float, ...], tuple[float, ...]]


class Effect(NamedTuple):
    """How two arms differ in one measure.

    task, contrast, measure: names
    where: "best" learning rate of each arm, "all" other settings averaged, or a learning rate
    rates: the learning rates of each of the two arms, two where the halves of the seeds chose two;
      None where all are averaged
    first, second: the statistic of each arm
    difference: first minus second, with its interval
    adjusted: its p value after Holm's correction for all effects of the page
    improvement: the probability that a seed of the first arm is better than one of the second
    """

    task: str
    contrast: str
    measure: str
    where: str
    rates: Rates | None
    first: float
    second: float
    difference: Difference
    adjusted: float
    improvement: float

    @property
    def direction(self) -> int:
        """1 where the first arm is surely better, -1 where it is surely worse, else 0."""
        sure = self.adjusted < LEVEL
        return int(sure * np.sign(self.difference.value)) * MEASURES[self.measure].sign


def effects(tasks: Sequence[Task]) -> list[Effect]:
    """Returns all effects of the page, their p values corrected for there being so many."""
    found = [
        effect
        for task, contrast in itertools.product(tasks, CONTRASTS)
        for effect in _effects_of(task, contrast)
    ]
    adjusted = holm([effect.difference.p_value for effect in found])
    return [effect._replace(adjusted=float(p)) for effect, p in zip(found, adjusted, strict=True)]


def _effects_of(task: Task, contrast: Contrast) -> list[Effect]:
    """Returns the effects of one contrast, their p values not yet corrected."""
    chosen = zip(*(best_rates(task, contrast, half) for half in HALVES), strict=True)
    one, other = (tuple(sorted(set(rates))) for rates in chosen)
    found = [
        _effect(task, contrast, measure, "best", (one, other), at_best(task, measure, contrast))
        for measure in MEASURES
    ]
    for rate in task.factors["learning_rate"]:
        arms = [arm(task, "average return", contrast, level, rate) for level in contrast.levels]
        same = (rate,), (rate,)
        found.append(_effect(task, contrast, "average return", f"{rate:g}", same, arms))
    for measure in MEASURES:
        arms = [_averaged(task, measure, contrast, level) for level in contrast.levels]
        found.append(_effect(task, contrast, measure, "all", None, arms))
    return found


def at_best(task: Task, measure: str, contrast: Contrast) -> tuple[np.ndarray, np.ndarray]:
    """Returns a measure [S] of both arms, each at its best rate by the half a seed is not in."""
    first, second = np.empty((2, task.final_return.shape[-1]))
    for choosing, reported in (HALVES, HALVES[::-1]):
        rates = best_rates(task, contrast, choosing)
        for values, level, rate in zip((first, second), contrast.levels, rates, strict=True):
            values[reported] = arm(task, measure, contrast, level, rate)[reported]
    return first, second


def best_rates(task: Task, contrast: Contrast, seeds: slice) -> tuple[float, float]:
    """Returns each arm's learning rate of the greatest average return on some seeds."""
    rates = task.factors["learning_rate"]
    first, second = (
        max(
            rates, key=lambda rate: arm(task, "average return", contrast, level, rate)[seeds].mean()
        )
        for level in contrast.levels
    )
    return first, second


def arm(task: Task, measure: str, contrast: Contrast, level: Any, rate: float) -> np.ndarray:
    """Returns a measure [S] of one value of a contrast at a learning rate, all else as default."""
    settings = DEFAULTS | {contrast.factor: level, "learning_rate": rate}
    return select(task, MEASURES[measure].values(task), settings)


def select(task: Task, values: np.ndarray, settings: Mapping[str, Any]) -> np.ndarray:
    """Returns the part of values [..., X] in which some factors have the given values."""
    index = [
        task.factors[name].index(settings[name]) if name in settings else slice(None)
        for name in task.factors
    ]
    return values[tuple(index)]


def _averaged(task: Task, measure: str, contrast: Contrast, level: Any) -> np.ndarray:
    """Returns a measure [S] of each seed, averaged over all other settings of the sweep."""
    values = select(task, MEASURES[measure].values(task), {contrast.factor: level})
    return values.reshape(-1, values.shape[-1]).mean(axis=0)


def _effect(
    task: Task,
    contrast: Contrast,
    measure: str,
    where: str,
    rates: Rates | None,
    arms: Sequence[np.ndarray],
) -> Effect:
    _, statistic, sign = MEASURES[measure]
    first, second = arms
    compare = {"iqm": paired_iqm_difference, "mean": paired_difference, "rate": paired_rates}
    # Rates that were averaged over settings are numbers like any other.
    averaged = statistic == "rate" and where == "all"
    difference = compare["mean" if averaged else statistic](first, second)
    middle = iqm if statistic == "iqm" else np.mean
    improvement = probability_of_improvement(sign * first, sign * second).value
    values = float(middle(first)), float(middle(second))
    return Effect(
        task.name, contrast.name, measure, where, rates, *values, difference, math.nan, improvement
    )


def paired_iqm_difference(x: np.ndarray, y: np.ndarray, confidence: float = 0.95) -> Difference:
    """Returns how much higher the interquartile mean of x is than that of y on the same seeds.

    The interval and p value are those of Yuen's test for dependent samples (Wilcox 2012,
    Introduction to Robust Estimation, section 5.9.5): Student's on winsorised values. Where these
    do not differ, the interval has no width.

    Args:
      x: [S] finite values of one arm.
      y: [S] of another, with the same seeds in the same order.
      confidence: the interval's level.
    """
    cut = len(x) // 4
    kept = len(x) - 2 * cut
    winsorised = [np.clip(v, *np.sort(v)[[cut, len(v) - cut - 1]]) for v in (x, y)]
    squares = len(x) * np.var(winsorised[0] - winsorised[1])
    difference = float(iqm(x) - iqm(y))
    error = math.sqrt(squares / (kept * (kept - 1)))
    if error == 0:
        return Difference(difference, difference, difference, float(difference == 0))
    half = stats.t.isf((1 - confidence) / 2, kept - 1) * error
    p_value = 2 * stats.t.sf(abs(difference) / error, kept - 1)
    return Difference(difference, difference - half, difference + half, float(p_value))
