"""How fast configurations learn, pair by pair, and what each swept setting does on average."""

import itertools
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from mjx_reinforce.reports.experiment import COMPARED, Result, ordered, shared_seeds
from mjx_reinforce.reports.statistics import Estimate
from mjx_reinforce.reports.statistics.aggregates import interval
from mjx_reinforce.reports.statistics.comparisons import (
    Comparison,
    compare_all,
    holm,
    paired_difference,
)
from mjx_reinforce.reports.statistics.survival import log_rank


class SpeedTest(NamedTuple):
    """The log-rank test of two results, ``first`` and ``second`` being their places.

    p_value: that both solve the task equally soon
    adjusted: the same after Holm's correction for all pairs
    """

    first: int
    second: int
    p_value: float
    adjusted: float


class Level(NamedTuple):
    """One value of a setting, averaged over the other settings.

    number: of configurations that the average is over, as many for each value of the setting
    means: over seeds, by the measure's name: "return", "area", "steps" (the env steps to solve)
    adjusted: p values of no difference from the setting's best value by that measure, after Holm's
      correction for all pairs of values of all settings; None of the best value itself
    """

    setting: str
    value: Any
    number: int
    means: dict[str, Estimate]
    adjusted: dict[str, float | None]


class Learning(NamedTuple):
    """How fast the results learn.

    until: env steps at which the areas end and the mean env steps to solve are cut off
    speeds: of all pairs of the best results; empty where the task has no threshold
    areas: the same pairs by the mean return over the training
    levels: of each setting whose values were all tried with the same values of the others
    """

    until: int
    speeds: list[SpeedTest]
    areas: list[Comparison]
    levels: list[Level]


def compare_learning(results: Sequence[Result], until: int) -> Learning:
    """Compares how fast results learn; see ``Learning``."""
    best = results[:COMPARED]
    shared = shared_seeds(best)
    areas = [each.areas[np.isin(each.configuration.seed, shared)] for each in best]
    pairs = compare_all(areas) if len(best) > 1 and len(shared) > 1 else []
    return Learning(until, _speeds(best), pairs, _levels(results, until))


def fastest(results: Sequence[Result]) -> int:
    """Returns the place of the result with the fewest mean env steps to solve."""
    means = [float(each.solving.mean.value) if each.solving else np.inf for each in results]
    return int(np.argmin(means))


def _speeds(results: Sequence[Result]) -> list[SpeedTest]:
    solving = [each.solving for each in results if each.solving is not None]
    pairs = list(itertools.combinations(range(len(solving)), 2))
    found = [
        log_rank(solving[i].steps, solving[i].solved, solving[j].steps, solving[j].solved).p_value
        for i, j in pairs
    ]
    return [
        SpeedTest(i, j, p_value, float(adjusted))
        for (i, j), p_value, adjusted in zip(pairs, found, holm(found), strict=True)
    ]


def _levels(results: Sequence[Result], until: int) -> list[Level]:
    """Returns the main effects of settings, where there are several and they were crossed."""
    names = list(results[0].configuration.settings)
    shared = shared_seeds(results)
    if len(results) < 2 or len(names) < 2 or len(shared) < 2:
        return []
    crossed = {name: _crossed(results, name) for name in names}
    measured = [_measures(each, shared, until) for each in results]
    means = {
        (name, place): {
            measure: np.mean([measured[i][measure] for i in members], axis=0)
            for measure in measured[0]
        }
        for name, groups in crossed.items()
        for place, (_, members) in enumerate(groups)
    }
    adjusted = {measure: _against_best(means, measure) for measure in measured[0]}
    return [
        Level(
            setting=name,
            value=crossed[name][place][0],
            number=len(crossed[name][place][1]),
            means={measure: interval("mean", each) for measure, each in arrays.items()},
            adjusted={measure: adjusted[measure][name, place] for measure in arrays},
        )
        for (name, place), arrays in means.items()
    ]


def _crossed(results: Sequence[Result], name: str) -> list[tuple[Any, list[int]]]:
    """Returns the values of a setting, each with the places of the results to average.

    They are those whose other settings were tried with every value; none if there are no such, or
    more values than are compared pair by pair.
    """
    values = ordered([each.configuration.settings.get(name) for each in results])
    places: dict[tuple[str, ...], dict[str, int]] = {}
    for i, each in enumerate(results):
        settings = each.configuration.settings
        others = tuple(f"{k}={v!r}" for k, v in settings.items() if k != name)
        places.setdefault(others, {})[repr(settings.get(name))] = i
    whole = [by_value for by_value in places.values() if len(by_value) == len(values)]
    if not whole or not 1 < len(values) <= COMPARED:
        return []
    return [(value, [by_value[repr(value)] for by_value in whole]) for value in values]


def _measures(result: Result, shared: np.ndarray, until: int) -> dict[str, np.ndarray]:
    """Returns what is averaged, by name, of the seeds that all results have."""
    chosen = np.isin(result.configuration.seed, shared)
    found = {"return": result.scores[chosen], "area": result.areas[chosen]}
    if (solving := result.solving) is not None:
        steps = np.where(solving.solved, solving.steps, until)
        found["steps"] = np.minimum(steps, until)[chosen].astype(float)
    return found


def _against_best(
    means: dict[tuple[str, int], dict[str, np.ndarray]], measure: str
) -> dict[tuple[str, int], float | None]:
    """Returns the adjusted p value of each value of each setting against the setting's best."""
    sign = -1 if measure == "steps" else 1
    pairs = [(a, b) for a, b in itertools.combinations(means, 2) if a[0] == b[0]]
    p_values = [
        float(paired_difference(means[a][measure], means[b][measure]).p_value) for a, b in pairs
    ]
    adjusted = dict(zip(map(frozenset, pairs), holm(p_values).tolist(), strict=True))
    best = {
        name: max(
            (key for key in means if key[0] == name),
            key=lambda key: sign * float(np.mean(means[key][measure])),
        )
        for name, _ in means
    }
    return {
        key: None if key == best[key[0]] else adjusted[frozenset((key, best[key[0]]))]
        for key in means
    }
