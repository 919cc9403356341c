"""What the figures of a report say in words: numbers, the headline, and what to distrust."""

import math
from collections.abc import Callable, Iterator

import numpy as np

from mjx_reinforce.reports.experiment import (
    Experiment,
    counted,
    ordered,
    race_in_words,
    say,
    setting_in_words,
)
from mjx_reinforce.reports.findings import COMPARED, Findings, by_speed, lost_by_lot
from mjx_reinforce.reports.tasks import TaskFindings
from mjx_reinforce.settings.defaults import OF_TASKS
from mjx_reinforce.statistics import Estimate, enough
from mjx_reinforce.statistics.comparisons import Comparison, seeds_needed, wrong_winner

#: What counts as a difference after Holm's correction.
LEVEL = 0.05
#: Seeds with which people compare, and of which the page says how often they err.
_COUNTS = (3, 5, 10)
#: Fewer seeds than these give an interval that promises more than it keeps.
_FEW_SEEDS = 20
#: The share of a group of seeds that a few may not show at all, and how often that is not rare.
_GROUP = 0.3
_RARE = 0.05


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
    interval = interval_in_words(estimate, form)
    if interval == "no interval":
        return interval
    return f"95% interval {interval}"


def percent(share: float) -> str:
    """Returns a share as a percentage; only all is 100%, and only none 0%."""
    if share in (0.0, 1.0):
        return f"{share:.0%}"
    # One seed of ten thousand is not none, and all but one are not all.
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
    return [pair for pair in findings.comparisons if pair.first == 0]


def headline(findings: Findings) -> list[str]:
    """Returns the answer in a few sentences: who is best, by how much, and how surely.

    Where the final returns are a tie and one configuration surely learns faster, that is
    first.
    """
    best = findings.results[0]
    if math.isnan(best.mean.value):
        return ["There is no answer: no seed of any configuration ended with a finite return."]
    # A mean without an interval has one of two reasons.
    reason = " below six seeds"
    if enough(len(best.final)):
        reason = ": all seeds are alike"
    bounds = within(best.mean).replace("no interval", f"no interval{reason}")
    mean = f"a mean return of {number(best.mean.value)} ({bounds})"
    if len(findings.results) == 1:
        return [_alone(findings, mean), *_solving(findings)]
    name = best.configuration.label
    ties = _ties(findings)
    answer = f"By the mean, the best is {name}. It ended with {mean}."
    # Without a test, of configurations that share fewer than two seeds, nobody is surely the best.
    if findings.comparisons and not ties:
        answer = f"The best is {name}. It ended with {mean}."
    sentences = [answer, *_decision(findings), *_ahead(findings), *_solving(findings)]
    sentences += _few(findings)
    speed = _speed(findings)
    if not speed:
        return sentences
    if ties and len(ties) == len(of_best(findings)):
        return [f"{speed}. The final returns are a tie.", *sentences]
    return [*sentences, f"{speed}."]


def _alone(findings: Findings, mean: str) -> str:
    """Returns how the only configuration ended, with its mean in words, and where it began."""
    best = findings.results[0]
    start = best.configuration.eval_return[0]
    start = start[np.isfinite(start)]
    gain = f", from {number(float(start.mean()))} before training" if start.size else ""
    seeds = counted(len(best.final), "seed")
    return f"{seeds} of {findings.experiment.env} ended with {mean}{gain}."


def _decision(findings: Findings) -> Iterator[str]:
    """Yields when a sweep until the best is decided stopped, and why."""
    experiment = findings.experiment
    decision = experiment.decision
    if decision is None or not decision.looks:
        return
    labels = [part.label for part in experiment.configurations]
    budget = counted(decision.budget, "seed")
    seeds = f"{decision.looks[-1]:,} of at most {budget}"
    contenders = _listed([labels[place] for place in decision.contenders])
    if len(decision.contenders) == 1:
        yield f"The sweep stopped after {seeds}: {contenders} is surely the best."
    elif decision.is_over:
        yield f"The sweep spent its budget of {budget} without a decision."
    else:
        yield f"The sweep has not decided yet, after {seeds}."
    excluded = [
        f"{label} after {counted(num_seeds, 'seed')}"
        for place, (label, num_seeds) in enumerate(zip(labels, decision.num_seeds, strict=True))
        if place not in decision.contenders
    ]
    if excluded:
        yield (
            f"Surely below another: {_listed(excluded)} (sequential test, "
            f"{counted(len(decision.looks), 'look')}; the probability of any wrong exclusion is at "
            f"most {LEVEL:.0%})."
        )
    if len(decision.contenders) > 1:
        yield f"Any of these may be the best: {contenders}."


def _ties(findings: Findings) -> list[Comparison]:
    """Returns the comparisons of the best with those that cannot be told from it."""
    return [pair for pair in of_best(findings) if pair.adjusted >= LEVEL]


def _ahead(findings: Findings) -> Iterator[str]:
    """Yields by how much the best is ahead, and of which others that is not sure."""
    pairs = of_best(findings)
    if not pairs:
        return
    second_pair = pairs[0]
    difference = float(second_pair.difference.value)
    relation = f"is {number(difference)} above" if difference else "equals"
    yield (
        f"The mean {relation} that of the next, {findings.labels[second_pair.second]} "
        f"({within(second_pair.difference)}; {p_value(second_pair.adjusted)} by the paired t-test, "
        f"after Holm's correction for {counted(len(findings.comparisons), 'pair')})."
    )
    ties = _ties(findings)
    if ties:
        labels = _listed([findings.labels[pair.second] for pair in ties])
        yield f"The best cannot be told from {labels}: {_why_a_tie(findings, ties)}."


def _why_a_tie(findings: Findings, ties: list[Comparison]) -> str:
    """Returns why the best is not surely better, and the least p value of those comparisons."""
    first_seeds = findings.results[ties[0].first].configuration.seed
    second_seeds = findings.results[ties[0].second].configuration.seed
    num_seeds = np.intersect1d(first_seeds, second_seeds).size
    reason = "chance often makes a difference as large"
    # The least p value that so many seeds can have, all of one sign, times Holm's first factor.
    if len(findings.comparisons) * 2.0 ** (1 - num_seeds) >= LEVEL:
        reason = f"{counted(num_seeds, 'seed')} are too few to tell"
    least_p = p_value(min(pair.adjusted for pair in ties))
    if least_p != "p = 1":
        least_p += " or more"
    return f"{reason} ({least_p})"


def _listed(names: list[str]) -> str:
    """Returns names with commas, and how many there are beyond three."""
    text = ", ".join(names[:3])
    if len(names) > 3:
        text += f" and {len(names) - 3} more"
    return text


def _solving(findings: Findings) -> Iterator[str]:
    """Yields how many seeds of the best solve the task at the end, if it has a threshold."""
    best = findings.results[0]
    if best.solving is None:
        return
    seeds = counted(len(best.final), "seed")
    # "Of 8 seeds" of a lone configuration; "of its 8 seeds" where others have seeds, too.
    if len(findings.results) > 1:
        seeds = f"its {seeds}"
    rate = best.solving.rate
    num_fallen = int(best.solving.fell.sum())
    relapse = f"; {num_fallen:,} had solved it and fell back" if num_fallen else ""
    yield (
        f"{best.solving.at_end:,} of {seeds} solve the task at the end "
        f"({percent(float(rate.value))}, {within(rate, percent)}; solved is "
        f"{solved(findings.experiment)}){relapse}."
    )


def solved(experiment: Experiment) -> str:
    """Returns what a task counts as solved."""
    return f"a return of {number(experiment.threshold or 0.0)}, the threshold of {experiment.env}"


def lost(findings: Findings) -> str:
    """Returns in a number how much the settings matter, or nothing where nothing was gained."""
    share = lost_by_lot(findings)
    if math.isnan(share):
        return ""
    return (
        f"Of these {len(findings.results):,} configurations, one drawn by lot lacks "
        f"{100 * share:.0f}% of the best's gain, on average. 0% means that the settings do not "
        "matter within the values tried."
    )


def two_ways(findings: Findings) -> str:
    """Returns what it means where the best has the higher mean and loses to another, or nothing."""
    labels = [
        findings.labels[pair.second]
        for pair in of_best(findings)
        if pair.difference.value > 0 and pair.improvement.value < 0.5
    ]
    if not labels:
        return ""
    return (
        f"The best has a higher mean than {_listed(labels)}, but is better in less than half of "
        "the pairs of seeds: it wins by more than it loses by. That is so where seeds fall in "
        "groups, such as those that fail and those that do not; the histograms show them."
    )


def _few(findings: Findings) -> Iterator[str]:
    """Yields what few seeds would have said of the two best, where there are many seeds."""
    best, next_best = (result.scores for result in findings.results[:2])
    # Draws stand for fresh seeds only where there are many more seeds than are drawn.
    counts = [count for count in _COUNTS if 10 * count <= min(len(best), len(next_best))]
    if not counts or best.mean() == next_best.mean():
        return
    shares = [f"{percent(wrong_winner(best, next_best, n))} of the time with {n}" for n in counts]
    num_seeds = seeds_needed(best, next_best)
    power = "10,000 seeds of each would not"
    if num_seeds:
        power = f"{num_seeds:,} seeds of each would"
    yield (
        "With few seeds of the best and the next, the wrong one of these two would have won: "
        f"{', '.join(shares)}. {power} find the difference four times out of five, by Welch's "
        "test, which does not pair seeds."
    )


def _speed(findings: Findings) -> str:
    """Returns what surely solves the task sooner than others, by the log-rank test, or nothing."""
    # Without a threshold, or a seed that reached it, there is no speed to test.
    if not findings.speeds:
        return ""
    labels = findings.labels[:COMPARED]
    fastest = by_speed(findings.results[:COMPARED])[0]
    slower_labels = [
        labels[sum(pair) - fastest]  # the other place of the pair
        for pair, p in findings.speeds.items()
        if fastest in pair and p < LEVEL
    ]
    if not slower_labels:
        return ""
    if len(slower_labels) == len(labels) - 1:
        return f"The fastest is {labels[fastest]}"
    return f"{labels[fastest]} is surely faster than {_listed(slower_labels)}"


def score(value: float) -> str:
    """Returns a score in words, with three decimals."""
    return "none" if math.isnan(value) else f"{value:.3f}"


def over_tasks(findings: TaskFindings) -> Iterator[str]:
    """Yields the answer of several tasks: who is best, by how much, how much settings matter."""
    best, *others = findings.standings
    tasks = counted(len(findings.tasks), "task")
    mean = f"a mean score of {score(float(best.mean.value))} ({within(best.mean, score)})"
    if not others:
        yield f"Over {tasks}, {best.label} ended with {mean}."
        return
    yield f"Over {tasks}, the best by the mean is {best.label}. It ended with {mean}."
    next_best = others[0]
    yield (
        f"The mean is {score(float(next_best.behind.value))} above that of the next, "
        f"{next_best.label} ({within(next_best.behind, score)})."
    )
    # An interval that is NaN tells nothing apart.
    ties = [standing.label for standing in others if not standing.behind.low > 0]
    if ties:
        yield f"The best cannot be told from {_listed(ties)}: the interval of the difference has 0."
    yield (
        "With the best configuration of each task in place of one for all, the mean score is "
        f"{score(findings.gain_by_tuning)} higher: so sensitive are these configurations to the "
        "task. As each task's best owes part of its lead to luck, this number is a little too "
        "large."
    )


def caveats(findings: Findings) -> Iterator[str]:
    """Yields what to distrust in the headline, the gravest first."""
    experiment = findings.experiment
    results = findings.results
    sizes = [len(result.final) for result in results]
    for directory in experiment.unfinished:
        yield f"{directory} is not finished. These are its results so far."
    for name in map(setting_in_words, experiment.disagree):
        yield f'The sources were made with different {name}: see "Where this comes from".'
    yield from _raced(experiment)
    if min(sizes) < _FEW_SEEDS:
        yield (
            f"A configuration has {counted(min(sizes), 'seed')}: with fewer than {_FEW_SEEDS}, "
            "intervals hold the truth less than 95% of the time. Below six, there are none."
        )
    # Of the configurations with an interval: how often it misses a group of three in ten.
    min_seeds = min(filter(enough, sizes), default=_FEW_SEEDS)
    miss_probability = (1 - _GROUP) ** min_seeds
    if miss_probability > _RARE:
        yield (
            "Where returns fall in two groups far apart, an interval of so few seeds does not keep "
            f"its 95%: if three seeds in ten are of the other group, {min_seeds} seeds show none "
            f"of them {percent(miss_probability)} of the time, so the interval of the mean holds "
            f"the truth at most {percent(1 - miss_probability)} of the time."
        )
    if experiment.decision is not None:
        yield (
            "The returns decided how many seeds there are, and means, intervals, and p values do "
            "not account for that. Only the decision does."
        )
    num_failures = sum(int(np.sum(~np.isfinite(result.final))) for result in results)
    if num_failures:
        yield (
            f"{num_failures:,} of {counted(sum(sizes), 'seed')} ended with a return that is not "
            "finite. They count as the worst finite return of all, which may flatter them."
        )
    if len(results) > 1:
        yield (
            f"The best of {len(results):,} was chosen by the same seeds that give its numbers, so "
            "these are a little too good. Train it with fresh seeds before you quote them."
        )
        # Other tasks have no defaults of their own, which would suit one of the values better.
        names = " and ".join(map(setting_in_words, results[0].configuration.settings))
        if names and experiment.env in OF_TASKS:
            yield (
                f"Settings that you did not give are defaults, tuned for one value of {names}. "
                "Tune them for each configuration before you choose."
            )
    yield from _edges(findings)
    # Seeds overshoot their budget by part of an update: that is no difference of budgets.
    ends = [float(np.median(result.configuration.env_steps[-1])) for result in results]
    if max(ends) > 1.1 * min(ends):
        yield (
            f"Budgets differ: {steps(min(ends))} to {steps(max(ends))} env steps per seed. Each is "
            "judged at its own end."
        )
    if _rises(results[0].band):
        yield "The best was still rising at the end. A longer training may change the order."
    yield "This is one task. Nothing here says how these settings do on another."


def _raced(experiment: Experiment) -> Iterator[str]:
    """Yields which configurations are races, whose means are none of single seeds."""
    for part in experiment.configurations:
        if race_in_words(experiment.settings | part.settings):
            yield (
                f"Each seed of {part.label} is the best of a race: of several policies, those with "
                "worse training returns were dropped. A seed without a race is no such choice. Env "
                "steps count all policies of a race."
            )


def _edges(findings: Findings) -> Iterator[str]:
    """Yields the settings of the best that are the least or the greatest of three numbers."""
    for name, best in findings.results[0].configuration.settings.items():
        values = ordered([result.configuration.settings.get(name) for result in findings.results])
        is_numeric = all(isinstance(x, int | float) and not isinstance(x, bool) for x in values)
        # Of two values, either is at an edge.
        if is_numeric and len(values) > 2 and best in (values[0], values[-1]):
            edge = "least" if best == values[0] else "greatest"
            label = setting_in_words(name).capitalize()
            yield f"{label} {say(best)} is the {edge} tried: try beyond it."


def _rises(band: Estimate) -> bool:
    """Returns whether the last part of a curve is above what was before, by their intervals."""
    points = np.flatnonzero(np.isfinite(band.value))
    if len(points) < 5:
        return False
    start = points[int(0.85 * (len(points) - 1))]
    end = points[-1]
    rise = band.value[end] - band.value[start]
    # Intervals that lie apart may be ever so narrow: a rise of less than a percent is none.
    return bool(band.low[end] > band.high[start] and rise > 0.01 * np.ptp(band.value[points]))
