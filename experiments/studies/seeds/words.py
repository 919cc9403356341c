"""Sentences of docs/seeds.md: they follow from the numbers by the rules of this file."""

import math
from collections.abc import Mapping, Sequence
from statistics import median

import numpy as np

from experiments.kit.markdown import listed, number, percent, table
from experiments.studies.seeds.answers import CONTRASTS, Contrast, Effect
from experiments.studies.seeds.findings import FEW_MEASURES, Findings
from experiments.studies.seeds.runs import Task

#: Numbers of seeds in the text.
FEW = (3, 5, 10)
#: Below which probability of a better seed an arm is called what (the bounds of Vargha and Delaney
#: 2000, Journal of Educational and Behavioral Statistics 25).
_SIZES = ((0.56, "hardly "), (0.64, "slightly "), (0.71, ""), (math.inf, "much "))


def short_answers(found: Findings) -> str:
    """Returns a table of the answers: a row a comparison, a column a task."""
    rows = []
    for contrast in CONTRASTS:
        cells = [_verdict(contrast, found.of(contrast, task, "best")) for task in found.tasks]
        rows.append([contrast.name, *cells])
    return table(["", *(task.name for task in found.tasks)], rows)


def _verdict(contrast: Contrast, found: Sequence[Effect]) -> str:
    """Returns which arm is better, by the measures that surely differ, and how much better."""
    direction = _direction(found)
    if direction is None:
        better, worse = (
            listed(effect.measure for effect in found if effect.direction == sign)
            for sign in (1, -1)
        )
        return f"{contrast.names[0]}: better in {better}, worse in {worse}"
    if direction == 0:
        return "no difference found"
    share, measure = _share(found, direction)
    size = next(word for limit, word in _SIZES if share < limit)
    better = contrast.names[0 if direction > 0 else 1]
    named = "" if measure == "average return" else f" in {measure}"
    return f"{better}: {size}better ({percent(share, 0)}{named})"


def _share(found: Sequence[Effect], direction: int) -> tuple[float, str]:
    """Returns how probably a seed of the better arm is better, and by which measure.

    That is the average return, or where it does not surely differ the measure that says most.
    """
    shares = {
        effect.measure: effect.improvement if direction > 0 else 1 - effect.improvement
        for effect in found
        if effect.direction
    }
    most = max(shares, key=shares.__getitem__)
    measure = "average return" if "average return" in shares else most
    return shares[measure], measure


def _direction(found: Sequence[Effect]) -> int | None:
    """Returns which arm is surely better in some measure and never worse; None if both are."""
    directions = {effect.direction for effect in found} - {0}
    return None if len(directions) == 2 else next(iter(directions), 0)


def answer(found: Findings, contrast: Contrast) -> str:
    """Returns sentences on one contrast: at the best rates, over all settings, over the rates."""
    first, second = contrast.names
    sentences = [f"**{_capital(first)} against {second}.**"]
    best = {task.name: _direction(found.of(contrast, task, "best")) for task in found.tasks}
    sentences.append(f"With each at its own best learning rate, {_by_direction(contrast, best)}.")
    overall = {task.name: _direction(found.of(contrast, task, "all")) for task in found.tasks}
    sentences.append(
        "Averaged over all other settings, learning rates included, "
        + ("the answer is the same." if overall == best else f"{_by_direction(contrast, overall)}.")
    )
    sentences += [s for task in found.tasks if (s := _flips(found, contrast, task))]
    return " ".join(sentences)


def _by_direction(contrast: Contrast, directions: Mapping[str, int | None]) -> str:
    """Returns a clause that says on which tasks which arm is better."""
    first, second = contrast.names
    clauses = []
    for direction, clause in (
        (1, f"{first} is better than {second} on"),
        (-1, f"{first} is worse than {second} on"),
        (None, f"{first} is better in one measure and worse in another on"),
        (0, "no difference was found on"),
    ):
        named = [task for task, found in directions.items() if found == direction]
        if named:
            clauses.append(f"{clause} {listed(named)}")
    return "; ".join(clauses)


def _flips(found: Findings, contrast: Contrast, task: Task) -> str:
    """Returns a sentence if the better arm depends on the learning rate, else nothing."""
    better: dict[int, list[str]] = {1: [], -1: []}
    for rate in task.factors["learning_rate"]:
        (effect,) = found.of(contrast, task, f"{rate:g}")
        better.setdefault(effect.direction, []).append(f"{rate:g}")
    if not (better[1] and better[-1]):
        return ""
    first, second = contrast.names
    return (
        f"On {task.name} the learning rate decides: with both at the same one, {first} gives the "
        f"higher average return at {listed(better[1])}, {second} at {listed(better[-1])}."
    )


def short_few(found: Findings) -> str:
    """Returns what few seeds would have said of the comparisons that have a winner."""
    of_return = [few for few in found.few if few.measure == FEW_MEASURES[0]]
    sure = [few for few in of_return if few.sure]
    begin = (
        f"Of the {len(of_return)} comparisons, each arm at its own best learning rate, {len(sure)} "
        "have a winner in mean final return that all seeds together are sure of."
    )
    if not sure:
        return begin
    rows = []
    for count in FEW:
        worst = max(sure, key=lambda few: few.wrong[count])
        mean = float(np.mean([few.wrong[count] for few in sure]))
        most = f"{percent(worst.wrong[count], 0)} ({worst.contrast}, {worst.task})"
        rows.append([f"{count}", percent(mean, 0), most])
    needed = [math.inf if few.needed is None else few.needed for few in sure]
    return (
        f"{begin} So often would fewer seeds have named the other:\n\n"
        f"{table(['seeds of each', 'on average', 'at worst'], rows)}\n\n"
        f"To find these differences with a power of 80 %, a t-test needs {number(min(needed))} to "
        f"{number(max(needed))} seeds of each arm, {number(median(needed))} in the median."
    )


def caveats(found: Findings) -> str:
    """Returns the caveats that depend on the numbers, as list items."""
    items = []
    edges = (min, max)
    for end, word in zip(edges, ("least", "greatest"), strict=True):
        at_edge = {
            (effect.contrast, effect.task)
            for effect in found.effects
            for task in found.tasks
            if effect.where == "best" and effect.task == task.name and effect.rates is not None
            if end(task.factors["learning_rate"]) in (*effect.rates[0], *effect.rates[1])
        }
        if at_edge:
            places = listed(sorted(f"{contrast} ({task})" for contrast, task in at_edge))
            items.append(
                f"* **Edge of the grid.** The {word} learning rate of the sweep is the best one of "
                f"an arm in: {places}. One beyond it may be better."
            )
    return "\n".join(items)


def provenance(tasks: Sequence[Task]) -> str:
    """Returns a clause on what the runs of each task were trained with."""
    clauses = []
    for task in tasks:
        record = task.record
        commit = record["git_commit"]
        program = f"commit {commit[:10]}" if commit else "a commit that was not recorded"
        where = f"{record['num_devices']} x {record['device']}"
        clauses.append(f"{task.name} on {where} with JAX {record['packages']['jax']}, {program}")
    return "; ".join(clauses)


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]
