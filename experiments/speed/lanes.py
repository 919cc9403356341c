"""Whether lanes or threads of a GPU play a task faster, by the number of episodes.

    python -m experiments.speed.lanes measure playground:WalkerRun --lanes 1 8 16
    python -m experiments.speed.lanes page    # the table of docs/engine.md, from lanes.csv

One lane is a thread an episode. Each number of lanes plays all numbers of episodes, with a policy
of 64-64 units that has learned nothing; the best of five rollouts counts. An env step counts also
after its episode has ended, so that speeds of tasks whose episodes end early are too high, and
their ratios are not. Rows are added to ``lanes.csv`` beside this file.
"""

import argparse
import time
from collections.abc import Iterable
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from experiments.kit import rows
from experiments.kit.markdown import filled, fixed, table
from experiments.kit.places import DOCS
from experiments.speed.benchmark.robots import make
from mjx_reinforce import mlp_policy, normal, rollout
from mjx_reinforce.engine.gpu import seam
from mjx_reinforce.engine.play import available, teams

DATA = Path(__file__).with_suffix(".csv")
#: Env steps of an episode.
STEPS = 50
#: Rollouts that are timed, of each number of episodes.
REPEATS = 5
#: Numbers of episodes.
SIZES = (256, 1024, 2048, 4096, 8192, 16384)
COLUMNS: tuple[str, ...] = (
    *("date", "commit", "device", "jax", "task", "lanes", "episodes", "env_steps_per_second"),
)


def measure(task: str, lanes: int, batches: Iterable[int]) -> list[dict[str, Any]]:
    """Returns a row for each number of episodes.

    Args:
      task: its name.
      lanes: that play an episode.
      batches: numbers of episodes.
    """
    # The model and the number of episodes decide what plays; here it is set by hand.
    private: Any = teams
    private._is_for_teams = lambda model: lanes > 1
    private._lanes = lambda model: lanes
    private.play_few = lambda env: False
    env = make(task)
    distribution = normal(env.action_space)
    policy = mlp_policy(env.observation_size, distribution)
    actor = policy.init(jax.random.key(0))

    def played(num_episodes: int, key: jax.Array) -> Any:
        options: Any = {"num_episodes": num_episodes, "horizon": STEPS, "engine": "native"}
        return jax.tree.map(
            jnp.sum, rollout(env, policy.apply, actor, distribution, key, **options)
        )

    programs = {size: jax.jit(partial(played, size)) for size in batches}
    compiled = {size: x.lower(jax.random.key(0)).compile() for size, x in programs.items()}
    seam.wait_for_kernels()
    known = {"date": rows.now(), "commit": rows.commit(), "jax": jax.__version__}
    known |= {"device": jax.local_devices()[0].device_kind, "task": task, "lanes": lanes}
    lines = []
    for size, program in compiled.items():
        jax.block_until_ready(program(jax.random.key(0)))
        seconds = min(_seconds(program, jax.random.key(1 + k)) for k in range(REPEATS))
        speed = f"{size * STEPS / seconds:.3e}"
        print(f"{task}, {lanes} lanes, {size:,} episodes: {speed} env steps/s", flush=True)
        lines.append(known | {"episodes": size, "env_steps_per_second": speed})
    return lines


def _seconds(program: Any, key: jax.Array) -> float:
    start = time.perf_counter()
    jax.block_until_ready(program(key))
    return time.perf_counter() - start


def speeds(data: Path) -> str:
    """Returns the table of lanes' speed as a multiple of threads'."""
    lines = rows.read(data)
    speed = {
        (row["task"], int(row["lanes"]), int(row["episodes"])): float(row["env_steps_per_second"])
        for row in lines
    }
    ratios = {
        (task, lanes, size): fixed(speed[task, lanes, size] / speed[task, 1, size], 2)
        for task, lanes, size in speed
        if lanes > 1 and (task, 1, size) in speed
    }
    sizes = sorted({size for _, _, size in ratios})
    cells = [
        [task.removeprefix("playground:"), str(lanes)]
        + [ratios.get((task, lanes, size), "") for size in sizes]
        for task, lanes in sorted({(task, lanes) for task, lanes, _ in ratios})
    ]
    header = ["task", "lanes", *(f"{size:,} episodes" for size in sizes)]
    return table(header, cells)


def main() -> None:
    """Reads the command line, and does what it says."""
    parser = argparse.ArgumentParser(
        prog="python -m experiments.speed.lanes",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    stages = parser.add_subparsers(dest="stage", required=True)
    stages.add_parser("page", help="write the table again")
    stage = stages.add_parser("measure", help="time a task on this GPU")
    stage.add_argument("task")
    stage.add_argument("--lanes", type=int, nargs="+", default=[1, 16], choices=(1, 8, 16, 32))
    stage.add_argument("--episodes", type=int, nargs="+", default=SIZES)
    settings = parser.parse_args()
    if settings.stage == "page":
        page = DOCS / "engine.md"
        text = filled(page.read_text("utf-8"), {"lanes": partial(speeds, DATA)})
        page.write_text(text, encoding="utf-8")
        return
    if available.platform() != "gpu":
        parser.error("lanes play on NVIDIA GPUs alone, and JAX finds none here")
    for lanes in settings.lanes:
        rows.append(DATA, measure(settings.task, lanes, settings.episodes), COLUMNS)


if __name__ == "__main__":
    main()
