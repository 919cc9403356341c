"""How fast every engine is, beside what a user would otherwise pick, in one table from one run.

    python -m experiments.speed.benchmark --quick          # two minutes on a CPU
    python -m experiments.speed.benchmark --csv rows.csv   # everything

All engines play the same looping task: an episode that ends starts again from its own start state,
so that every simulated step is a real one. A rollout has a policy, its noise, and all that is
recorded for an update. Runs are interleaved and the median is shown; compare rows of one run with
each other, not with another machine's. `all.py` makes the rows of docs/benchmarks.csv.

With MJX_REINFORCE_DEBUG=1 the native engine describes its kernels, see docs/engine.md. The last
column is the time of one env step of one episode, which is what an update of few episodes waits
for. The column is empty where the batch is too large for all episodes to be played at once.
"""

import dataclasses
import os
from pathlib import Path
from typing import Any

import jax
import tyro

from experiments.kit.markdown import table
from experiments.kit.rows import now
from experiments.speed.benchmark.ours import ENGINES, rollouts, training
from experiments.speed.benchmark.peers import peers
from experiments.speed.benchmark.rows import append, facts, measure, speed
from mjx_reinforce.engines.native import available
from mjx_reinforce.engines.native.cpu.machine import this_machine

#: Threads of a multiprocessor that the longest programs leave room for.
THREADS = 256
SHOWN = ("task", "what", "engine", "precision", "batch", "steps", "compile_seconds")


@dataclasses.dataclass(frozen=True)
class Settings:
    """Measure engines and peers: rollouts with their policy, and whole training updates."""

    env: tuple[str, ...] = ("InvertedPendulum-v5",)
    """Environments."""
    engine: tuple[str, ...] = ("plain MJX", "fused", "native")
    """Rows of the table: "plain MJX", "plain MJX, 1 iteration", vmap, fused and native."""
    precision: tuple[str, ...] = ("float32", "float64")
    """Of the native engine on a CPU; all else of ours plays in float32."""
    batch: tuple[int, ...] = (128, 512, 2048, 8192)
    """Episodes played at once."""
    max_mjx_batch: int = 2048
    """Plain MJX is not run on more, which takes minutes on a CPU."""
    steps: int = 100
    """Env steps of each episode."""
    repeats: int = 5
    """Timed runs of each row; the median is shown."""
    train: bool = True
    """Also measure training updates (16-32 and 64-64 networks) at the greatest batch."""
    policy: Path | None = None
    """The policy folder of a run, instead of an untrained 16-32 network."""
    csv: Path | None = None
    """Where to append the rows, with every repetition's speed."""
    quick: bool = False
    """InvertedPendulum with few episodes and no training, in under two minutes."""


def main() -> None:
    """Measures, prints and writes."""
    settings = tyro.cli(Settings, prog="python -m experiments.speed.benchmark", description=__doc__)
    if settings.quick:
        few: dict[str, Any] = {"batch": (128, 1024, 4096), "max_mjx_batch": 128}
        few |= {"repeats": 3, "train": False}
        settings = dataclasses.replace(settings, **few)
    jax.config.update("jax_default_matmul_precision", "highest")
    said = facts(now(), "")
    rows = []
    for env in settings.env:
        ours = list(engines(env, settings))
        rows += [said | row for row in measure(ours + peers(env), settings.repeats)]
    header = (*(key.replace("_", " ") for key in SHOWN), "env steps/s", "ns a step of an episode")
    print(table(header, []), *map(line, rows), sep="\n")
    if settings.csv:
        append(settings.csv, rows)


def engines(env_id: str, settings: Settings):
    """Generates what is to be timed of every engine, batch and precision."""
    precisions = settings.precision if jax.default_backend() == "cpu" else ("float32",)
    for name in settings.engine:
        plain = ENGINES[name][0] == "vmap"
        batches = [b for b in settings.batch if not plain or b <= settings.max_mjx_batch]
        for precision in precisions if name == "native" else ("float32",):
            yield from rollouts(
                env_id, name, batches, settings.steps, precision, policy=settings.policy
            )
        if settings.train:
            for sizes in ((16, 32), (64, 64)):
                yield training(env_id, name, max(batches), settings.steps, sizes)


def line(row: dict[str, Any]) -> str:
    """Returns a row of the table."""
    cells = ["" if (x := row.get(key)) is None else str(x) for key in SHOWN]
    return f"| {' | '.join([*cells, f'{speed(row):,.0f}', latency(row)])} |"


def latency(row: dict[str, Any]) -> str:
    """Returns the time of one env step of one episode (ns), if all of a rollout play at once."""
    together = row["engine"] == "native" and row["what"].startswith("rollout")
    return f"{1e9 * row['batch'] / speed(row):,.0f}" if together and fits(row["batch"]) else ""


def fits(batch: int) -> bool:
    """Returns whether the native engine surely plays so many episodes at once, of any task."""
    if available.platform() == "cpu":
        return batch <= this_machine().lanes * (os.cpu_count() or 1)
    return batch <= THREADS * jax.devices()[0].core_count


if __name__ == "__main__":
    main()
