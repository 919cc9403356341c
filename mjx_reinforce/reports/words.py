"""What the figures of a report say in words: numbers, the headline, and what to distrust."""

import math
from collections.abc import Callable, Iterator

import numpy as np

from mjx_reinforce.reports.experiment import Experiment, counted, ordered, say, setting_in_words
from mjx_reinforce.reports.findings import COMPARED, Findings, by_speed
from mjx_reinforce.settings.defaults import OF_TASKS
from mjx_reinforce.statistics import Estimate, enough
from mjx_reinforce.statistics.comparisons import Comparison, seeds_needed, wrong_winner

#: What counts as a difference after Holm's correction.
LEVEL = 0.05
#: Seeds with which people compare, and of which the page says how often they err.
_COUNTS = (3, 5, 10)
#: Fewer seeds than these give an interval that promises more than it keeps.
_FEW_SEEDS = 20
#: Seeds of a group that so few others may not show at all, and how often that is not rare.
_GROUP, _RARE = 0.3, 0.05


def number(value: float) -> str:
    """Returns a return in words: one decimal, or three digits of what is small."""
    if math.isnan(value):
        return "none"
    return f"{value:,.1f}" if abs(value) >= 10 or value == 0 else f"{value:.3g}"


def interval_in_words(estimate: Estimate, form: Callable[[float], str] = number) -> str:
    """Returns an interval, "997.0 to 999.0", or that there is none."""
    if math.isnan(estimate.low) or math.isnan(estimate.high):
        return "no interval"
    return f"{form(float(estimate.low))} to {form(float(estimate.high))}"


def within(estimate: Estimate, form: Callable[[float], str] = number) -> str:
    """Returns an interval with its level, "95% interval 997.0 to 999.0", or that there is none."""
    said = interval_in_words(estimate, form)
    return said if said == "no interval" else f"95% interval {said}"


def percent(share: float) -> str:
    """Returns a share as a percentage; only all is 100%, and only none 0%."""
    if share in (0.0, 1.0):
        return f"{share:.0%}"
    return f"{min(max(100 * share, 0.1), 99.9):.1f}%"


def steps(value: float) -> str:
    """Returns env steps to three digits, or that there are none."""
    return "none" if math.isnan(value) else f"{float(f'{value:.3g}'):,.0f}"


def p_value(value: float) -> str:
    """Returns a p value, "p = 0.012", "p < 0.001" or "p = 1"."""
    if value >= 0.9995:
        return "p = 1"
    return "p < 0.001" if value < 0.001 else f"p = {value:.3f}"


def short_p(value: float) -> str:
    """Returns a p value without its name: "0.012", "< 0.001", "1"."""
    return p_value(value).removeprefix("p = ").removeprefix("p ")


def of_best(findings: Findings) -> list[Comparison]:
    """Returns the comparisons of the best configuration with the others, in their order."""
    return [each for each in findings.comparisons if each.first == 0]


def headline(findings: Findings) -> list[str]:
    """Returns the answer in a few sentences: who is best, by how much, and how surely.

    Where the final returns are a tie and one configuration surely learns faster, that is
    first.
    """
    best = findings.results[0]
    if math.isnan(best.mean.value):
        return ["There is no answer: no seed of any configuration ended with a finite return."]
    why = ": all seeds are alike" if enough(len(best.final)) else " below six seeds"
    bounds = within(best.mean).replace("no interval", f"no interval{why}")
    mean = f"a mean return of {number(best.mean.value)} ({bounds})"
    if len(findings.results) == 1:
        seeds, first = counted(len(best.final), "seed"), best.configuration.eval_return[0]
        first = first[np.isfinite(first)]
        before = f", from {number(float(first.mean()))} before training" if first.size else ""
        said = f"{seeds} of {findings.experiment.env} ended with {mean}{before}."
        return [said, *_solving(findings)]
    name, ties = best.configuration.label, _ties(findings)
    first = f"By the mean, the best is {name}. It ended with {mean}."
    if findings.comparisons and not ties:
        first = f"The best is {name}. It ended with {mean}."
    said = [first, *_ahead(findings), *_solving(findings), *_few(findings)]
    speed = _speed(findings)
    if speed and ties and len(ties) == len(of_best(findings)):
        return [f"{speed}. The final returns are a tie.", *said]
    return [*said, f"{speed}."] if speed else said


def _ties(findings: Findings) -> list[Comparison]:
    """Returns the comparisons of the best with those that cannot be told from it."""
    return [each for each in of_best(findings) if each.adjusted >= LEVEL]


def _ahead(findings: Findings) -> Iterator[str]:
    """Yields by how much the best is ahead, and of which others that is not sure."""
    against, pairs = of_best(findings), counted(len(findings.comparisons), "pair")
    if not against:
        return
    next_best, ties = against[0], _ties(findings)
    difference = float(next_best.difference.value)
    above = f"is {number(difference)} above" if difference else "equals"
    yield (
        f"The mean {above} that of the next, {findings.labels[next_best.second]} "
        f"({within(next_best.difference)}; {p_value(next_best.adjusted)} by the paired t-test, "
        f"after Holm's correction for {pairs})."
    )
    if ties:
        least = p_value(min(each.adjusted for each in ties))
        one, other = (findings.results[k].configuration.seed for k in ties[0][:2])
        seeds, why = np.intersect1d(one, other).size, "chance often makes a difference as large"
        if len(findings.comparisons) * 2.0 ** (1 - seeds) >= LEVEL:
            why = f"{counted(seeds, 'seed')} are too few to tell"
        least += "" if least == "p = 1" else " or more"
        names = _listed([findings.labels[each.second] for each in ties])
        yield f"The best cannot be told from {names}: {why} ({least})."


def _listed(names: list[str]) -> str:
    more = f" and {len(names) - 3} more" if len(names) > 3 else ""
    return ", ".join(names[:3]) + more


def _solving(findings: Findings) -> Iterator[str]:
    best = findings.results[0]
    if best.solving is not None:
        whose = "its " if len(findings.results) > 1 else ""
        rate, fell = best.solving.rate, int(best.solving.fell.sum())
        yield (
            f"{best.solving.at_end:,} of {whose}{counted(len(best.final), 'seed')} solve the task "
            f"at the end ({percent(float(rate.value))}, {within(rate, percent)}; solved is "
            f"{solved(findings.experiment)})"
            f"{f'; {fell:,} had solved it and fell back' if fell else ''}."
        )


def solved(experiment: Experiment) -> str:
    """Returns what a task counts as solved."""
    return f"a return of {number(experiment.threshold or 0.0)}, the threshold of {experiment.env}"


def two_ways(findings: Findings) -> str:
    """Returns what it means where the best has the higher mean and loses to another, or nothing."""
    against = [
        findings.labels[pair.second]
        for pair in of_best(findings)
        if pair.difference.value > 0 and pair.improvement.value < 0.5
    ]
    if not against:
        return ""
    return (
        f"The best has a higher mean than {_listed(against)}, but is better in less than half of "
        "the pairs of seeds: it wins by more than it loses by. That is so where seeds fall in "
        "groups, such as those that fail and those that do not; the histograms show them."
    )


def _few(findings: Findings) -> Iterator[str]:
    """Yields what few seeds would have said of the two best, where there are many seeds."""
    best, second = (each.scores for each in findings.results[:2])
    counts = [count for count in _COUNTS if 10 * count <= min(len(best), len(second))]
    if counts and best.mean() != second.mean():
        wrong = [f"{percent(wrong_winner(best, second, n))} of the time with {n}" for n in counts]
        needed = seeds_needed(best, second)
        found = f"{needed:,} seeds of each would" if needed else "10,000 seeds of each would not"
        yield (
            "With few seeds of the best and the next, the wrong one of these two would have won: "
            f"{', '.join(wrong)}. {found} find the difference four times out of five, by Welch's "
            "test, which does not pair seeds."
        )


def _speed(findings: Findings) -> str:
    """Returns what surely solves the task sooner than others, by the log-rank test, or nothing."""
    names, order = findings.labels[:COMPARED], by_speed(findings.results[:COMPARED])
    pairs = findings.speeds.items()
    slower = [names[sum(pair) - order[0]] for pair, p in pairs if order[0] in pair and p < LEVEL]
    if slower and len(slower) == len(names) - 1:
        return f"The fastest is {names[order[0]]}"
    return f"{names[order[0]]} is surely faster than {_listed(slower)}" if slower else ""


def caveats(findings: Findings) -> Iterator[str]:
    """Yields what to distrust in the headline, the gravest first."""
    experiment, results = findings.experiment, findings.results
    sizes = [len(each.final) for each in results]
    for each in experiment.unfinished:
        yield f"{each} is not finished. These are its results so far."
    for name in map(setting_in_words, experiment.disagree):
        yield f'The sources were made with different {name}: see "Where this comes from".'
    if min(sizes) < _FEW_SEEDS:
        yield (
            f"A configuration has {counted(min(sizes), 'seed')}: with fewer than {_FEW_SEEDS}, "
            "intervals hold the truth less than 95% of the time. Below six, there are none."
        )
    fewest = min(filter(enough, sizes), default=_FEW_SEEDS)
    if (unseen := (1 - _GROUP) ** fewest) > _RARE:
        yield (
            "Where returns fall in two groups far apart, an interval of so few seeds does not keep "
            f"its 95%: if three seeds in ten are of the other group, {fewest} seeds show none of "
            f"them {percent(unseen)} of the time, so the interval of the mean holds the truth at "
            f"most {percent(1 - unseen)} of the time."
        )
    if failed := sum(int(np.sum(~np.isfinite(each.final))) for each in results):
        yield (
            f"{failed:,} of {counted(sum(sizes), 'seed')} ended with a return that is not finite. "
            "They count as the worst finite return of all, which may flatter them."
        )
    if len(results) > 1:
        yield (
            f"The best of {len(results):,} was chosen by the same seeds that give its numbers, so "
            "these are a little too good. Train it with fresh seeds before you quote them."
        )
        names = " and ".join(map(setting_in_words, results[0].configuration.settings))
        if names and experiment.env in OF_TASKS:
            yield (
                f"Settings that you did not give are defaults, tuned for one value of {names}. "
                "Tune them for each configuration before you choose."
            )
    yield from _edges(findings)
    ends = [float(np.median(each.configuration.env_steps[-1])) for each in results]
    if max(ends) > 1.1 * min(ends):
        yield (
            f"Budgets differ: {steps(min(ends))} to {steps(max(ends))} env steps per seed. Each is "
            "judged at its own end."
        )
    if _rises(results[0].band):
        yield "The best was still rising at the end. A longer training may change the order."
    yield "This is one task. Nothing here says how these settings do on another."


def _edges(findings: Findings) -> Iterator[str]:
    """Yields the settings of the best that are the least or the greatest of three numbers."""
    for name, best in findings.results[0].configuration.settings.items():
        values = ordered([each.configuration.settings.get(name) for each in findings.results])
        numbers = all(isinstance(x, int | float) and not isinstance(x, bool) for x in values)
        if numbers and len(values) > 2 and best in (values[0], values[-1]):
            which = "least" if best == values[0] else "greatest"
            label = setting_in_words(name).capitalize()
            yield f"{label} {say(best)} is the {which} tried: try beyond it."


def _rises(band: Estimate) -> bool:
    """Returns whether the last part of a curve is above what was before, by their intervals."""
    known = np.flatnonzero(np.isfinite(band.value))
    if len(known) < 5:
        return False
    before, last = known[int(0.85 * (len(known) - 1))], known[-1]
    rise = band.value[last] - band.value[before]
    return bool(band.low[last] > band.high[before] and rise > 0.01 * np.ptp(band.value[known]))
