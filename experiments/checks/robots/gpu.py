"""How fast a GPU plays models that others wrote: teams of lanes and MuJoCo Warp, in one call.

The timing is that of ``experiments.speed.benchmark``: some models compile at once, then they are
timed one by one.
"""

import collections
import statistics
import time
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments.checks.robots import models, playing, teams
from experiments.kit import rows
from experiments.kit.markdown import table
from experiments.speed.benchmark import __main__ as benchmark
from experiments.speed.benchmark import rows as benchmark_rows
from mjx_reinforce.engine.base import Box

#: Columns of docs/robots_gpu.csv: env steps/s of both, by the number of episodes or worlds.
COLUMNS = ("package", "model", "nv", "nu", "covered")
COLUMNS += ("error20", "ratio200", "error20_exact", "ratio200_exact")
NUMBERS = (2_048, 33_792)
SPEEDS = tuple(f"{name}_{n}" for n in NUMBERS for name in ("native", "warp"))
#: So many models compile at once.
_AT_ONCE = 8
#: Seconds that these may take; a call that has less left starts no more of them.
_LEAST_SECONDS = 120.0
_MOST_SECONDS = 300.0
#: Env steps of an episode, and timed runs after one that warms up.
_STEPS = 25
_REPEATS = 2
#: By how much each speed differs from rest where an episode begins (m/s, rad/s).
_SPEED = 0.1


class Robot(playing.Generic):
    """A model that moves its actuators around the middle of their range, at random."""

    def __init__(self, xml_file: str):
        """Begins each episode near the model's start."""
        model, _ = models.load(Path(xml_file))
        super().__init__(model, models.start_of(model), playing.FRAME_SKIPS["speed"])
        self.action_space = Box(np.full(model.nu, -1.0), np.full(model.nu, 1.0))

    def control(self, action: jax.Array) -> jax.Array:
        """Returns the controls of actions."""
        return jnp.asarray(self.start.control) + jnp.asarray(self.start.amplitude) * action

    def initial(self, rng: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Returns the start, with speeds of its own in each episode."""
        qpos, qvel = super().initial(rng)
        return qpos, qvel + _SPEED * jax.random.normal(rng, qvel.shape, qvel.dtype)

    def observe(self, data: Any) -> jax.Array:
        """Sees qpos and qvel."""
        return jnp.concatenate([data.qpos, data.qvel])

    def outcome(self, before: Any, data: Any, action: jax.Array) -> Any:
        """Returns ``reward`` of what teams of lanes report; nothing ends."""
        reward = (data.qpos - before.qpos).sum() / self.dt - 1e-3 * (action**2).sum()
        return reward, False, {}


def task_of(path: Path) -> str:
    """Returns the task of a model, as ``experiments.speed.benchmark`` takes it."""
    return f"{__name__}:Robot xml_file={path}"


def covered(raw_rows: Iterable[Mapping[str, str]]) -> list[Mapping[str, str]]:
    """Returns the rows of ``teams`` of models that teams cover, Menagerie's robots first."""
    kept = [row for row in raw_rows if row["error20"] and row["nu"] != "0"]
    first = {row["model"] for row in teams.SETS["Menagerie's robots"](kept)}
    return sorted(kept, key=lambda row: row["model"] not in first)


def measure(output: Path, folder: Path, listed: Path, seconds: float, commit: str) -> None:
    """Times the models that have no row yet, and appends rows of ``experiments.speed.benchmark``.

    Args:
      output: the rows; what a call has timed it keeps.
      folder: a folder for each package.
      listed: the rows of ``teams``.
      seconds: what this may take.
      commit: of the code that is measured.
    """
    deadline = time.monotonic() + seconds
    finished = {row["task"] for row in rows.read(output)} if output.exists() else set()
    # What had all the time that there is and has no row is not tried again.
    tried = output.with_suffix(".tried")
    if tried.exists():
        finished.update(tried.read_text("utf-8").splitlines())
    paths = [folder.resolve() / row["package"] / row["model"] for row in covered(rows.read(listed))]
    tasks = [task for task in map(task_of, paths) if task not in finished]
    print(f"{len(tasks)} models of {len(paths)} are to be timed", flush=True)
    for first in range(0, len(tasks), _AT_ONCE):
        left = deadline - time.monotonic()
        if left < _LEAST_SECONDS:
            print(f"{left:.0f} s are left, too few for {tasks[first]}", flush=True)
            return
        print(f"{first} of {len(tasks)} are done, {left:.0f} s are left", flush=True)
        batch = tasks[first : first + _AT_ONCE]
        settings = benchmark.Settings(
            part="gpu",
            minutes=min(left, _MOST_SECONDS) / 60,
            csv=output,
            commit=commit,
            tasks=tuple(batch),
            batches=NUMBERS,
            steps=_STEPS,
            repeats=_REPEATS,
        )
        benchmark.conduct(settings)
        if left >= _MOST_SECONDS:
            with tried.open("a", encoding="utf-8") as file:
                file.writelines(f"{task}\n" for task in batch)


def merged(
    team_rows: Sequence[Mapping[str, str]], timed: Sequence[Mapping[str, Any]], folder: Path
) -> list[dict[str, Any]]:
    """Returns the rows of docs/robots_gpu.csv: of ``teams``, with the speeds of both.

    Args:
      team_rows: those of ``teams``.
      timed: those of ``experiments.speed.benchmark``, read by its ``rows``.
      folder: the models' folder when they were timed.
    """
    speeds: dict[str, dict[str, str]] = collections.defaultdict(dict)
    names = {"native": "native", "MuJoCo Warp": "warp"}
    for row in timed:
        median = statistics.median(row["env_steps_per_second"])
        speeds[row["task"]][f"{names[row['engine']]}_{row['batch']}"] = f"{median:.3g}"
    merged_rows = []
    for row in team_rows:
        if row["verdict"] == "no model" or row["nu"] in ("", "0"):
            continue
        task = task_of(folder.resolve() / row["package"] / row["model"])
        kept = {name: row[name] for name in COLUMNS if name in row}
        kept["covered"] = _why(row["cause"]) if row["verdict"] == "refused" else "yes"
        merged_rows.append(kept | dict.fromkeys(SPEEDS, "") | speeds[task])
    return merged_rows


def _why(cause: str) -> str:
    """Returns what a model has that teams lack."""
    return cause.removeprefix("the model has ").removesuffix(", which teams of lanes do not play")


def robots(raw_rows: Sequence[Mapping[str, str]]) -> str:
    """Returns a table of Menagerie's robots: covered or why not, and equality."""
    lines = []
    for row in teams.SETS["Menagerie's robots"](raw_rows):
        reason = "" if row["covered"] == "yes" else row["covered"]
        lines.append([row["model"], row["nv"], reason or row["error20"], row["error20_exact"]])
    return table(["model", "degrees of freedom", "from C MuJoCo, or why not", "tolerance 0"], lines)


def speeds(raw_rows: Iterable[Mapping[str, str]]) -> str:
    """Returns a table of the robots that were timed, by the ratio to Warp, the least first.

    A cell is empty where an engine did not play.
    """

    def ratio(row: Mapping[str, str], number: int) -> str:
        ours, warp = row[f"native_{number}"], row[f"warp_{number}"]
        return f"{float(ours) / float(warp):.1f}" if ours and warp else ""

    def by_ratio(row: Mapping[str, str]) -> float:
        return float(ratio(row, NUMBERS[-1]) or "inf")

    lines = []
    for row in sorted(raw_rows, key=by_ratio):
        if any(row[name] for name in SPEEDS):
            figures = [f"{float(row[name]):,.0f}" if row[name] else "" for name in SPEEDS]
            lines.append([row["model"], *figures, *(ratio(row, number) for number in NUMBERS)])
    header = ["model", *(f"{name}, {n:,}" for n in NUMBERS for name in ("teams", "Warp"))]
    return table([*header, *(f"teams / Warp, {n:,}" for n in NUMBERS)], lines)


def summary(raw_rows: Sequence[Mapping[str, str]]) -> str:
    """Returns a table of how many robots of each set teams cover, and how much faster than Warp."""
    lines = []
    for name, select in teams.SETS.items():
        kept = select(raw_rows)
        ratios = [
            float(row[f"native_{n}"]) / float(row[f"warp_{n}"])
            for row in kept
            for n in NUMBERS[-1:]
            if row[f"native_{n}"] and row[f"warp_{n}"]
        ]
        middle = f"{statistics.median(ratios):.1f} of {len(ratios)}" if ratios else "not timed"
        num_covered = sum(row["covered"] == "yes" for row in kept)
        lines.append([name, str(len(kept)), str(num_covered), middle])
    return table(
        ["set", "robots", "covered by teams", "median speed / Warp's of those timed"], lines
    )


def write(path: Path, team_rows: Path, timed: Path, folder: Path) -> None:
    """Writes docs/robots_gpu.csv.

    Args:
      path: of docs/robots_gpu.csv.
      team_rows: the rows of ``teams``.
      timed: those of ``measure``; there may be none.
      folder: the models' folder when they were timed.
    """
    speeds = benchmark_rows.read(timed) if timed.exists() else []
    rows.write(path, merged(rows.read(team_rows), speeds, folder))
