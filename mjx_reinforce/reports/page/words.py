"""What the figures of a report say, in sentences."""

import math
from collections.abc import Callable, Iterator

import numpy as np

from mjx_reinforce.reports.experiment import (
    COMPARED,
    Result,
    counted,
    ordered,
    say,
    setting_in_words,
    shared_seeds,
)
from mjx_reinforce.reports.findings import Findings
from mjx_reinforce.reports.statistics import Estimate, enough
from mjx_reinforce.reports.statistics.comparisons import Comparison
from mjx_reinforce.settings.tuned import OF_TASKS

#: What counts as a difference after Holm's correction.
LEVEL = 0.05
#: Fewer seeds than these give an interval that promises more than it keeps.
_FEW_SEEDS = 20


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
    """Returns an interval with its level, "95 % interval 997.0 to 999.0", or that there is none."""
    said = interval_in_words(estimate, form)
    return said if said == "no interval" else f"95 % interval {said}"


def percent(share: float) -> str:
    """Returns a share as a percentage; only all is 100 %, and only none 0 %."""
    if share in (0.0, 1.0):
        return f"{share:.0%}".replace("%", " %")
    return f"{min(max(100 * share, 0.1), 99.9):.1f} %"


def steps(value: float) -> str:
    """Returns env steps to three digits, or that there are none."""
    return "none" if math.isnan(value) else f"{float(f'{value:.3g}'):,.0f}"


def p_value(value: float) -> str:
    """Returns a p value, "p = 0.012", "p < 0.001" or "p = 1"."""
    if value >= 0.9995:
        return "p = 1"
    return "p < 0.001" if value < 0.001 else f"p = {value:.3f}"


def of_best(findings: Findings) -> list[Comparison]:
    """Returns the comparisons of the best configuration with the others, in their order."""
    return [each for each in findings.comparisons if each.first == 0]


def unsure(findings: Findings) -> list[Result]:
    """Returns the configurations that cannot be told from the best."""
    return [findings.results[c.second] for c in of_best(findings) if c.adjusted >= LEVEL]


def answer(findings: Findings) -> list[str]:
    """Returns the answer, in a few sentences: the first is the shortest that is true."""
    best = findings.results[0]
    if math.isnan(best.mean.value):
        return ["There is no answer: no seed of any configuration ended with a finite return."]
    said = [_headline(findings), *_ahead(findings), *_solving(findings)]
    return said + _few(findings)


def _headline(findings: Findings) -> str:
    best, env = findings.results[0], findings.experiment.env
    why = "all seeds are alike" if enough(len(best.final)) else "too few seeds"
    bounds = within(best.mean).replace("no interval", f"no interval: {why}")
    mean = f"a mean return of {number(best.mean.value)} ({bounds})"
    if len(findings.results) == 1:
        return _learned(findings, env, mean)
    name = best.configuration.label
    ties = unsure(findings)
    if not ties and findings.comparisons:
        return f"The best is {name}: it ended with {mean}."
    return f"The greatest mean is that of {name}, which ended with {mean}."


def _learned(findings: Findings, env: str, mean: str) -> str:
    """Returns what the seeds of one configuration learned."""
    best = findings.results[0]
    returns, at = best.configuration.eval_return, best.configuration.env_steps
    seeds = counted(len(best.final), "seed")
    untrained = returns[0][np.isfinite(returns[0])]
    if at[0].any() or not len(untrained) or len(returns) < 2:
        return f"{seeds} of {env} ended with {mean}."
    change = f"from {number(float(untrained.mean()))} before training to {mean}"
    if best.solving is None or not best.solving.ever:
        moved = "rose" if best.mean.value > untrained.mean() else "did not rise: it went"
        return f"{seeds} of {env} were trained. The return {moved} {change}."
    ever = "All" if best.solving.ever == len(best.final) else f"{best.solving.ever:,} of"
    if len(best.final) == 1:
        return f"{env} was learned: the return went {change}."
    return f"{ever} {seeds} learned to solve {env}. The return went {change}."


def _ahead(findings: Findings) -> Iterator[str]:
    """Yields by how much the best is ahead, and of which others that is not sure."""
    against = of_best(findings)
    if not against:
        return
    next_best = against[0]
    label = findings.results[next_best.second].configuration.label
    improvement = next_best.improvement
    sizes = {len(each.final) for each in findings.results[:COMPARED]}
    where = "The mean" if len(sizes) == 1 else "Over the seeds that all have, the mean"
    yield (
        f"{where} {_above(float(next_best.difference.value))} that of the next, {label} "
        f"({within(next_best.difference)}; {p_value(next_best.adjusted)} "
        f"after Holm's correction for {counted(len(findings.comparisons), 'pair')}). Of two seeds, "
        "one of each, that of the best ends higher with a probability of "
        f"{percent(improvement.value)} ({within(improvement, percent)}; ties count half)."
    )
    ties = unsure(findings)
    if ties:
        least = p_value(min(c.adjusted for c in against if c.adjusted >= LEVEL))
        names = [f"“{each.configuration.label}”" for each in ties[:3]]
        more = f" and {len(ties) - 3} more" if len(ties) > 3 else ""
        seeds = len(shared_seeds(findings.results[:COMPARED]))
        can = len(findings.comparisons) * 2.0 ** (1 - seeds) < LEVEL
        why = (
            "a difference as large comes by chance too often"
            if can
            else f"{counted(seeds, 'seed')} are too few to tell, whatever they say"
        )
        yield (
            f"It cannot be told from {', '.join(names)}{more}: {why} "
            f"({least}{'' if least == 'p = 1' else ' or more'})."
        )


def _above(difference: float) -> str:
    return f"is {number(difference)} above" if difference else "equals"


def _solving(findings: Findings) -> Iterator[str]:
    best = findings.results[0]
    if best.solving is None:
        return
    solving, seeds = best.solving, len(best.final)
    fell = int(solving.fell.sum())
    whose = "its " if len(findings.results) > 1 else ""
    kept = f"; {fell:,} had solved it and fell back" if fell else ""
    yield (
        f"{solving.at_end:,} of {whose}{counted(seeds, 'seed')} solve the task at the end "
        f"({percent(float(solving.rate.value))}, {within(solving.rate, percent)}; solved is a "
        f"return of {number(findings.experiment.threshold or 0.0)}){kept}."
    )
    if not math.isnan(solving.median.value):
        half = f"{steps(solving.median.value)} env steps ({within(solving.median, steps)})"
        yield f"Half of them had solved it after {half}."


def _few(findings: Findings) -> list[str]:
    few = findings.few
    if few is None or not few.wrong or any(math.isnan(x) for x in few.wrong.values()):
        return []
    each = [f"{percent(share)} of the time with {number}" for number, share in few.wrong.items()]
    listed = each[0] if len(each) == 1 else f"{', '.join(each[:-1])} and {each[-1]}"
    needed = (
        f"{few.needed:,} of each would find it four times of five"
        if few.needed
        else "10,000 of each would not find it four times of five"
    )
    return [f"With few seeds, the next would have looked better than the best {listed}; {needed}."]


def caveats(findings: Findings) -> list[str]:
    """Returns what to distrust in the answer, the gravest first."""
    checks = (_of_sources, _of_seeds, _of_failures, _of_choice, _of_budget, _of_measure)
    return [sentence for check in checks for sentence in check(findings)]


def _of_sources(findings: Findings) -> Iterator[str]:
    experiment = findings.experiment
    for directory in experiment.unfinished:
        yield f"{directory} is not finished: these are its results so far."
    for name in map(setting_in_words, experiment.disagree):
        yield f"The sources were made with different {name}; see where they come from."


def _of_seeds(findings: Findings) -> Iterator[str]:
    sizes = [len(each.final) for each in findings.results]
    if min(sizes) < _FEW_SEEDS:
        yield (
            f"{counted(min(sizes), 'seed')} of a configuration are few: below {_FEW_SEEDS}, a "
            "bootstrap interval holds the truth less often than 95 % of the time, and below six "
            "there is none, nor a p below 0.05."
        )
    if len(set(sizes)) > 1:
        yield (
            f"Configurations have {min(sizes):,} to {max(sizes):,} seeds; they are compared on "
            "the seeds that all have."
        )


def _of_failures(findings: Findings) -> Iterator[str]:
    failed = sum(int(np.sum(~np.isfinite(each.final))) for each in findings.results)
    total = sum(len(each.final) for each in findings.results)
    if failed:
        yield (
            f"{failed:,} of {counted(total, 'seed')} ended with a return that is not finite. They "
            "count as the worst finite return of all, which may flatter them."
        )
    best = findings.results[0]
    fell = int(best.solving.fell.sum()) if best.solving else 0
    if fell:
        yield (
            f"{counted(fell, 'seed')} of the best configuration had solved the task and lost it "
            "again: stopped earlier, or by its best policy, it would look better."
        )


def _of_choice(findings: Findings) -> Iterator[str]:
    results = findings.results
    if len(results) == 1:
        return
    yield (
        f"The best was chosen among {len(results):,} by the same seeds that give its figures, so "
        "they are a little too good. Train it with fresh seeds before you quote them."
    )
    if len(results) > COMPARED:
        yield f"Only the best {COMPARED} of {len(results):,} are compared pair by pair."
    typical = max(results, key=lambda each: np.nan_to_num(each.iqm.value, nan=-math.inf))
    if number(typical.iqm.value) != number(results[0].iqm.value):
        yield (
            f"The interquartile mean, which leaves out the worst and the best quarter of the "
            f"seeds, names another: {typical.configuration.label} "
            f"({number(typical.iqm.value)}, against {number(results[0].iqm.value)})."
        )
    settings = results[0].configuration.settings
    if settings and findings.experiment.env in OF_TASKS:
        yield (
            "The other settings, where you gave none, are defaults that were chosen with one value "
            f"of {' and '.join(map(setting_in_words, settings))}: tune them for each "
            "configuration before you say which is better."
        )
    for name in settings:
        yield from _at_the_edge(findings, name)


def _at_the_edge(findings: Findings, name: str) -> Iterator[str]:
    """Yields that the best value of a setting is the least or the greatest that was tried."""
    values = ordered([each.configuration.settings.get(name) for each in findings.results])
    if len(values) < 3 or any(
        isinstance(x, bool) or not isinstance(x, int | float) for x in values
    ):
        return
    best = findings.results[0].configuration.settings[name]
    for end, said in ((values[0], "least"), (values[-1], "greatest")):
        if best == end:
            label = setting_in_words(name).capitalize()
            yield f"{label} {say(best)} is the {said} tried: try beyond it."


def _of_budget(findings: Findings) -> Iterator[str]:
    ends = [float(np.median(each.configuration.env_steps[-1])) for each in findings.results]
    if max(ends) > 1.1 * min(ends):
        yield (
            f"Budgets differ: {steps(min(ends))} to {steps(max(ends))} env steps a seed. Each is "
            "judged at its own end."
        )
    band = findings.results[0].band
    known = np.flatnonzero(np.isfinite(band.value))
    if len(known) > 4:
        before, last = known[int(0.85 * (len(known) - 1))], known[-1]
        rise = band.value[last] - band.value[before]
        if band.low[last] > band.high[before] and rise > 0.01 * np.ptp(band.value[known]):
            yield "The best was still rising at the end: a longer training may change the order."


def _of_measure(findings: Findings) -> Iterator[str]:
    if findings.experiment.threshold is None:
        yield "The sources name no return that counts as solved, so nothing is said of solving."
    episodes = findings.experiment.settings.get("eval_episodes")
    if episodes is not None:
        yield (
            f"A return is the mean of {counted(int(episodes), 'episode')} without exploration, "
            "from starts that are the same at every evaluation of a seed."
        )
    yield "One task: nothing here says how these settings do on another."
