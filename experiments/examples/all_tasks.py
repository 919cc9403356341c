"""All tasks together: a table of normalized scores and a figure of the learning curves.

``python experiments/examples/all_tasks.py RUN_OR_SWEEP ...`` A score is 0 at the mean return of
untrained policies, and 1 at the return that counts as solved, or else at the greatest mean return.
p: of equal times to solve, over all tasks (Stouffer), against the best; before any correction.
"""

import json
import sys
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from scipy import stats

from mjx_reinforce.reports.findings import Findings, compute_findings
from mjx_reinforce.reports.sources import read_experiment
from mjx_reinforce.statistics.survival import log_rank


def read(directories: list[Path]) -> list[Findings]:
    """Returns the findings of each task."""
    tasks: dict[str, list[Path]] = {}
    for each in directories:
        known = next(each / x for x in ("sweep.json", "config.json") if (each / x).is_file())
        tasks.setdefault(json.loads(known.read_text("utf-8"))["env"], []).append(each)
    found = [read_experiment(some) for some in tasks.values()]
    if all(len(each.configurations) == 1 for each in found):  # and named as its directory
        parts = [each.configurations[0]._replace(label="all") for each in found]
        found = [e._replace(configurations=[x]) for e, x in zip(found, parts, strict=True)]
    return [*map(compute_findings, found)]


def scores(found: Findings, name: str) -> np.ndarray:
    """Returns the scores [S] of a configuration of a task."""
    zero = np.nanmean(np.concatenate([r.configuration.eval_return[0] for r in found.results]))
    solved = found.experiment.threshold
    one = max(r.mean.value for r in found.results) if solved is None else solved
    return (found.results[found.labels.index(name)].scores - zero) / (one - zero)


#: Statistics of the tasks' scores: the mean of their means, and the IQM of all of them.
STATISTICS = (
    lambda *x, axis=-1: np.mean([each.mean(axis) for each in x], axis=0),
    lambda *x, axis=-1: stats.trim_mean(np.concatenate(x, axis=axis), 0.25, axis=axis),
)


def compare(tasks: list[Findings], picture: str) -> None:
    """Prints the table and draws the figure of the configurations that all tasks have."""
    own = {
        name: [scores(each, name) for each in tasks]
        for name in tasks[0].labels
        if all(name in each.labels for each in tasks)
    }
    order = sorted(own, key=lambda name: -np.mean([each.mean() for each in own[name]]))
    figure = Figure(figsize=(5 * len(tasks), 4), layout="constrained")
    panels = figure.subplots(1, len(tasks), squeeze=False)[0]
    print("| configuration | seeds | mean score | interquartile mean | p |\n|---|---|---|---|---|")
    for name in order:
        said = []
        for statistic in STATISTICS:  # as in rliable, of which each task's seeds are drawn apart
            found = stats.bootstrap(own[name], statistic, method="percentile", rng=0)
            low, high = found.confidence_interval
            said.append(f"{statistic(*own[name]):.3f} ({low:.3f} to {high:.3f})")
        tests = []
        for panel, each in zip(panels, tasks, strict=True):
            best, result = (each.results[each.labels.index(x)] for x in (order[0], name))
            panel.plot(each.grid, result.band.value, label=name)
            panel.fill_between(each.grid, result.band.low, result.band.high, alpha=0.2)
            panel.set(title=each.experiment.env, xlabel="env steps of a seed", ylabel="return")
            if best.solving and result.solving:
                pair = [x for e in (best.solving, result.solving) for x in (e.steps, e.solved)]
                tests.append(log_rank(*pair).statistic)
        p = f"{2 * stats.norm.sf(abs(sum(tests)) / len(tests) ** 0.5):.2g}" if tests else "none"
        print(f"| {name} | {sum(map(len, own[name]))} | {said[0]} | {said[1]} | {p} |")
    panels[0].legend()
    figure.savefig(picture)


if __name__ == "__main__":
    compare(read([Path(each) for each in sys.argv[1:]]), "all_tasks.png")
