"""The tables of docs/results.md."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from experiments.kit.markdown import fixed, percent, table
from experiments.studies.results.files import POLICIES, STAY_SOLVED, Columns, Result, tested_returns
from experiments.studies.results.measures import (
    Comparison,
    compare,
    published_interval,
    solved_within,
    steps_quantile,
    verdict,
)
from mjx_reinforce.reports.experiment import setting_in_words
from mjx_reinforce.reports.statistics import Estimate
from mjx_reinforce.reports.statistics.aggregates import interval

#: Env steps within which the pendulum should be solved.
WITHIN = (50_000, 100_000)


def number(x: float) -> str:
    """Returns a return with one decimal, two if it is small."""
    if not math.isfinite(x):
        return "none"
    return fixed(x, 2 if abs(x) < 10 else 1)


def estimate(found: Estimate) -> str:
    """Returns a number and its interval, "3.20 (3.10 to 3.30)", or that there is none."""
    if not (math.isfinite(found.low) and math.isfinite(found.high)):
        return f"{number(found.value)} (no interval)"
    return f"{number(found.value)} ({number(found.low)} to {number(found.high)})"


def seconds(x: float) -> str:
    """Returns a time in seconds or minutes."""
    return f"{x:.1f} s" if x < 120 else f"{x / 60:.1f} min"


def machine(facts: dict[str, Any]) -> str:
    """Returns where a run was trained."""
    if facts["device"] == "cpu":
        return f"{facts['cpu_count']} CPU cores"
    return f"{facts['num_devices']} {facts['device']}"


def mean_of(result: Result) -> Estimate:
    """Returns the mean over seeds of the last policies' returns, with its interval."""
    return interval("mean", tested_returns(result))


def verdict_of(result: Result) -> str:
    """Returns where our mean is beside the published one."""
    return verdict(mean_of(result), result.task.published)


def comparison(played: Columns | None, policy: str) -> Comparison | None:
    """Returns a policy's returns here and in Gymnasium, None if it was not played."""
    if played is None:
        return None
    chosen = played["policy"] == policy
    ours = played["simulation"] == "ours"
    returns = played["return"]
    return compare(returns[chosen & ours], returns[chosen & ~ours])


def results_table(results: Sequence[Result]) -> str:
    """Returns the table of all tasks."""
    header = [
        *("task", "seeds", "env steps a seed", "IQM (95 %)", "mean (95 %)", "worst seed"),
        *(
            "solved at the end (threshold)",
            "published (95 %)",
            "our mean is",
            "training, compiling",
        ),
        *("machine", "Gymnasium: best, median seed"),
    ]
    return table(header, map(_result_row, results))


def _result_row(result: Result) -> list[str]:
    tested, facts = tested_returns(result), result.facts
    threshold, published = facts["threshold"], result.task.published
    solved = "no threshold"
    if threshold is not None:
        solved = f"{int(np.sum(tested >= threshold)):,} of {len(tested):,} ({threshold:,g})"
    theirs = "none" if published is None else estimate(published_interval(*published))
    played = [comparison(result.played, policy) for policy in POLICIES]
    return [
        result.task.name,
        f"{len(tested):,}",
        f"{facts['settings']['env_steps']:,}",
        estimate(interval("iqm", tested)),
        estimate(mean_of(result)),
        number(worst(tested)),
        solved,
        theirs,
        verdict_of(result),
        f"{seconds(facts['run_seconds'])}, {seconds(facts['compile_seconds'])}",
        machine(facts),
        ", ".join(number(one.gymnasium.value) for one in played if one) or "not played",
    ]


def _least_share(result: Result) -> str:
    least = result.facts["least_share_solved"]
    return "not trained for as long" if least is None else percent(least, 2)


def worst(returns: np.ndarray) -> float:
    """Returns the least of returns [S]; one that is not finite is the worst."""
    return float(np.min(np.where(np.isfinite(returns), returns, -np.inf)))


def pendulum_table(results: Sequence[Result]) -> str:
    """Returns how soon, how surely and for how long the pendulum is solved."""
    start, stop = STAY_SOLVED
    header = ["policy", "seeds", *(f"solved within {limit:,}" for limit in WITHIN)]
    header += [f"least share solved, {start:,} to {stop:,}"]
    header += ["median env steps to solve", "99 % of seeds within"]
    return table(header, map(_pendulum_row, results))


def _pendulum_row(result: Result) -> list[str]:
    steps = result.seeds["env_steps_to_solve"]
    sizes = result.facts["settings"]["hidden_sizes"]
    within = [solved_within(steps, limit) for limit in WITHIN]
    return [
        f"{' and '.join(map(str, sizes))} units" if sizes else "linear",
        f"{len(steps):,}",
        *(f"{percent(count / len(steps), 2)} ({count:,})" for count in within),
        _least_share(result),
        *(_steps(steps_quantile(steps, share)) for share in (0.5, 0.99)),
    ]


def _steps(x: float) -> str:
    return f"{x:,.0f}" if math.isfinite(x) else "never"


def play_table(played: Mapping[str, Columns], films: Mapping[str, Path], docs: Path) -> str:
    """Returns the returns of policies here and in Gymnasium, with links to films that exist.

    Args:
      played: by a name, what was played.
      films: by that name, what the names of its films begin with, below ``docs``.
      docs: the folder.
    """
    rows = []
    for name, columns in played.items():
        for policy in POLICIES:
            if (found := comparison(columns, policy)) is None:
                continue
            film = Path(f"{films.get(name, '')}-{policy}.gif")
            seed = columns["seed"][columns["policy"] == policy][0]
            rows.append(
                [
                    *(name, f"{policy} ({seed})"),
                    *map(estimate, (found.ours, found.gymnasium, found.difference)),
                    "yes" if found.within else "no",
                    f"[film]({film.as_posix()})" if (docs / film).exists() else "none",
                ]
            )
    header = ["task", "policy (seed)", "here", "Gymnasium", "Gymnasium less here"]
    return table([*header, "within our interval", "film"], rows)


def moved_table(results: Sequence[Result]) -> str:
    """Returns which settings, moved alone, surely change what the defaults reach."""
    rows = []
    for result in results:
        if result.moved is None:
            continue
        name, value, low, high = moved_measure(result)
        shown = _share if name == "solved" else number
        labels = [_label(result.moved, row) for row in range(len(value))]
        worse = [row for row in range(len(value)) if high[row] < low[0]]
        better = [row for row in range(len(value)) if low[row] > high[0]]
        rows.append(
            [
                result.task.name,
                *(f"{result.moved[column][0]:,}" for column in ("seeds", "env_steps")),
                f"{'solved' if name == 'solved' else 'IQM'} {shown(value[0])}",
                *(
                    "; ".join(f"{labels[row]}: {shown(value[row])}" for row in chosen) or "none"
                    for chosen in (worse, better)
                ),
            ]
        )
    return table(
        ["task", "seeds of each", "env steps a seed", "defaults", "surely worse", "surely better"],
        rows,
    )


def moved_measure(result: Result) -> tuple[str, np.ndarray, np.ndarray, np.ndarray]:
    """Returns what a sweep is judged by, and it with its interval, [C] each.

    It is the share of seeds solved at the end where the defaults solve half of them, else the IQM.
    """
    moved = result.moved
    assert moved is not None
    if moved["solved"][0] >= 0.5:
        return "solved", moved["solved"], moved["solved_low"], moved["solved_high"]
    return "iqm", moved["iqm"], moved["low"], moved["high"]


def _label(moved: dict[str, np.ndarray], row: int) -> str:
    return f"{setting_in_words(str(moved['setting'][row]))} {moved['value'][row]}"


def _share(x: float) -> str:
    return percent(x, 1)
