"""The tables of docs/results.md and README.md."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats

from experiments.kit.markdown import fixed, percent, table
from experiments.studies.results import kept
from experiments.studies.results.kept import POLICIES, Columns, Group, Result
from experiments.studies.results.tasks import PUBLISHED_SEEDS
from mjx_reinforce.statistics import Estimate, estimate_mean, finite_or_nan

#: Env steps within which the pendulum should be solved.
WITHIN = (50_000, 100_000)
PEERS = ("Stable-Baselines3 PPO", "Stable-Baselines3 SAC")
#: The tasks of README.md.
_README = ("Hopper-v5", "HalfCheetah-v5", "Ant-v5", "Humanoid-v5")


def number(x: float) -> str:
    """Returns a return with one decimal, two if it is small."""
    return fixed(x, 2 if abs(x) < 10 else 1)


def estimate(found: Estimate) -> str:
    """Returns a number and its interval, "3.20 (3.10 to 3.30)", or that there is none."""
    if not (math.isfinite(found.low) and math.isfinite(found.high)):
        return f"{number(found.value)} (no interval)"
    return f"{number(found.value)} ({number(found.low)} to {number(found.high)})"


def seconds(x: float) -> str:
    """Returns a time in seconds or minutes."""
    return f"{x:.1f} s" if x < 120 else f"{x / 60:.1f} min"


def published_interval(mean: float, deviation: float) -> Estimate:
    """Returns a published mean with its 95% interval by Student's t over the published seeds."""
    t = stats.t.ppf(0.975, PUBLISHED_SEEDS - 1)
    half = float(t) * deviation / math.sqrt(PUBLISHED_SEEDS)
    return Estimate(mean, mean - half, mean + half)


def of_tasks(results: Sequence[Result]) -> str:
    """Returns the table of all tasks by env steps."""
    header = ["task", "seeds", "env steps per seed", "mean (95%)", "worst seed"]
    header += ["solved at the end (threshold)", "published (95%)"]
    return table([*header, "training, compiling", "machine"], map(_result_row, results))


def _result_row(result: Result) -> list[str]:
    tested, facts = finite_or_nan(result.seeds["test_return"]), result.facts
    threshold, published = facts["threshold"], result.task.published
    solved = "no threshold"
    if threshold is not None:
        solved = f"{int(np.sum(tested >= threshold)):,} of {len(tested):,} ({threshold:,g})"
    return [
        result.task.name,
        f"{len(tested):,}",
        f"{facts['settings']['env_steps']:,}",
        estimate(estimate_mean(tested)),
        "failed" if np.isnan(tested).any() else number(tested.min()),
        solved,
        "none" if published is None else estimate(published_interval(*published)),
        f"{seconds(facts['run_seconds'])}, {seconds(facts['compile_seconds'])}",
        f"{facts['cpu_count']} cores" if facts["device"] == "cpu" else _short(facts["device"]),
    ]


def distances(starts: Sequence[Mapping[str, str]]) -> str:
    """Returns the table of the distances to the optimum, from the rows of optimum.csv."""
    tasks = dict.fromkeys(row["task"] for row in starts)
    header = ["task", "starts", "policy", "optimum", "distance: mean (95%)", "median", "largest"]
    header += ["found in the second half of the search: mean, largest"]
    return table(header, (_distance_row([x for x in starts if x["task"] == y]) for y in tasks))


def _distance_row(starts: Sequence[Mapping[str, str]]) -> list[str]:
    """Returns the row of a task, whose starts have a bound or what a search found."""
    policy, best, late = (
        np.array([float(row[name]) for row in starts]) for name in ("policy", "best", "second_half")
    )
    distance = best - policy
    side, searched = "at least", f"{number(late.mean())}, {number(late.max())}"
    if starts[0]["method"] == "bound":
        side, searched = "at most", "a bound, no search"
    return [
        starts[0]["task"],
        str(len(starts)),
        number(policy.mean()),
        f"{side} {number(best.mean())}",
        f"{side} {estimate(estimate_mean(distance))}",
        number(float(np.median(distance))),
        number(distance.max()),
        searched,
    ]


def racing(arms: Sequence[Mapping[str, str]]) -> str:
    """Returns the table of races beside independent runs, from the rows of racing.csv."""
    header = ["task", "policies that are tested", "mean (95%)", "worst", "best"]
    return table([*header, "seconds, all runs", "env steps, all runs"], map(_arm_row, arms))


def _arm_row(arm: Mapping[str, str]) -> list[str]:
    mean, low, high, worst, best = (
        number(float(arm[name])) for name in ("mean", "low", "high", "worst", "best")
    )
    tested = f"{arm['policies']}, {arm['arm']}"
    returns = [f"{mean} ({low} to {high})", worst, best]
    cost = [seconds(float(arm["seconds"])), _steps_of(float(arm["env_steps"]))]
    return [arm["task"], tested, *returns, *cost]


def pendulum(results: Sequence[Result]) -> str:
    """Returns how soon and how surely the pendulum is solved, by the evaluations on the way."""
    rows = []
    for result in results:
        steps = np.sort(result.seeds["env_steps_to_solve"])
        within = [int(np.sum(steps <= limit)) for limit in WITHIN]
        sizes = result.facts["settings"]["hidden_sizes"]
        rows.append(
            [
                f"{' and '.join(map(str, sizes))} units" if sizes else "linear",
                f"{len(steps):,}",
                *(f"{percent(count / len(steps), 2)} ({count:,})" for count in within),
                *(_steps(steps[math.ceil(share * len(steps)) - 1]) for share in (0.5, 0.99)),
            ]
        )
    header = ["policy", "seeds", *(f"solved within {limit:,}" for limit in WITHIN)]
    return table([*header, "median env steps to solve", "99% of seeds within"], rows)


def _steps(x: float) -> str:
    return f"{x:,.0f}" if math.isfinite(x) else "never"


def gpu(groups: Sequence[Group], docs: Path) -> str:
    """Returns the table of runs on GPUs, beside the figures of published.csv in a folder."""
    rows = [
        [
            group.task,
            _short(group.device),
            str(len(group.final)),
            f"{number(group.minute.mean())}, {number(group.minute.min())}",
            estimate(estimate_mean(group.final)),
            *map(number, (group.final.min(), group.final.max())),
            seconds(group.seconds) + _stopped(group),
            _steps_of(group.env_steps),
            _published(docs, group.task, "PPO"),
            _published(docs, group.task, "off-policy"),
        ]
        for group in groups
        if group.is_gpu
    ]
    header = ["task", "on", "seeds", "after a minute: mean, worst", "at the end: mean (95%)"]
    header += ["worst", "best seed", "seconds, all seeds", "env steps per seed", "PPO, published"]
    return table([*header, "off-policy, published"], rows)


def _steps_of(env_steps: float) -> str:
    """Returns a number of env steps in two digits."""
    return f"{env_steps:.2g}".replace("e+0", "e").replace("e+", "e")


def _short(device: str) -> str:
    """Returns the name of a GPU in a word."""
    return device.removeprefix("NVIDIA ").split()[0]


def _published(docs: Path, task: str, method: str) -> str:
    """Returns a published figure, with its algorithm where the method has many."""
    figure = kept.published(docs / "published.csv", task, method)
    if figure is None:
        return "none"
    name = "" if method == "PPO" else f"{figure.algorithm}, "
    return f"{number(figure.mean)} ({name}{_steps_of(figure.env_steps)})"


def cpu(groups: Sequence[Group], docs: Path) -> str:
    """Returns the table of runs on two threads, beside those of peers.csv in a folder."""
    others = kept.peers(docs / "peers.csv")
    rows = [
        [
            group.task,
            group.device.partition(",")[0],
            str(len(group.final)),
            _spread(group.minute),
            f"{_spread(group.final)} after {seconds(group.seconds)}{_stopped(group)}",
            *(
                _peer(others.get((group.task, peer, group.device.rpartition(", ")[2]), {}))
                for peer in PEERS
            ),
        ]
        for group in groups
        if not group.is_gpu
    ]
    header = ["task", "on", "runs", "after a minute: median (worst, best)", "at the end"]
    return table([*header, "PPO: 1, 10 minutes", "SAC: 1, 10 minutes"], rows)


def _stopped(group: Group) -> str:
    return " (stopped)" if group.stopped else ""


def _spread(values: np.ndarray) -> str:
    low, middle, high = (number(float(f(values))) for f in (np.min, np.median, np.max))
    return f"{middle} ({low}, {high})"


def _peer(budgets: dict[float, list[float]]) -> str:
    found = (budgets.get(seconds) for seconds in (60.0, 600.0))
    cells = ", ".join(number(float(np.mean(x))) if x else "not run" for x in found)
    return cells if budgets else "not run"


def compare(ours: ArrayLike, theirs: ArrayLike) -> Estimate:
    """Returns by how much the mean of their returns [N] is above that of ours, by Welch."""
    ours, theirs = np.asarray(ours, float), np.asarray(theirs, float)
    difference = float(theirs.mean() - ours.mean())
    low = high = difference
    if ours.std() > 0 or theirs.std() > 0:
        welch = stats.ttest_ind(theirs, ours, equal_var=False).confidence_interval(0.95)
        low, high = float(welch.low), float(welch.high)
    return Estimate(difference, low, high)


def play(played: Mapping[str, Columns], docs: Path) -> str:
    """Returns the returns of policies here and in Gymnasium, with links to films that exist."""
    rows = []
    for task, columns in played.items():
        for policy in POLICIES:
            mine, ours = columns["policy"] == policy, columns["simulation"] == "ours"
            returns = columns["return"]
            both = returns[mine & ours], returns[mine & ~ours]
            film = Path("films", f"{task}-{policy}.gif")
            shown = f"[video]({film.as_posix()})" if (docs / film).exists() else ""
            label = f"{policy} ({columns['seed'][mine][0]})"
            means = (number(x.mean()) for x in both)
            rows.append([task, label, *means, estimate(compare(*both)), shown])
    header = ["task", "policy (seed)", "here", "Gymnasium", "Gymnasium less here", "video"]
    return table(header, rows)


def readme(groups: Sequence[Group], docs: Path) -> str:
    """Returns the table of README.md.

    Of several CPUs, that with the most runs counts; of several GPUs, the newest model.
    """
    rows = []
    for task in _README:
        mine = [group for group in groups if group.task == task]
        on_gpu = [group for group in mine if group.is_gpu]
        on_cpu = sorted((x for x in mine if not x.is_gpu), key=lambda x: len(x.final))
        cells = [_round(np.median(on_cpu[-1].minute)) if on_cpu else "", "", "", "", ""]
        if on_gpu:
            cells[1] = _round(on_gpu[-1].minute.mean())
            cells[2] = f"{_round(on_gpu[-1].final.mean())} in {seconds(on_gpu[-1].seconds)}"
        for place, method in enumerate(("PPO", "off-policy"), start=3):
            if figure := kept.published(docs / "published.csv", task, method):
                cells[place] = _round(figure.mean)
        rows.append([task, *cells])
    header = ["task", "two cores, a minute", "one GPU, a minute", "one GPU, at the end"]
    return table([*header, "PPO", "off-policy"], rows)


def _round(x: np.floating | float) -> str:
    return fixed(float(x), 1 if abs(x) < 100 else 0)
