"""How much faster is training on two GPUs than on one? Prints a table of each part as it ends.

``python -m experiments.speed.devices_scaling --devices 1 2`` measures

- sweep: 16 configurations of 1,024 seeds, by ``sweep_scaling``;
- episodes: one seed of HalfCheetah with 65,536 episodes an update, which the devices share;
- seeds: 16 seeds of Ant, which the devices share.

``--parts`` chooses among them. The programs for all numbers of devices are compiled side by side,
and then take turns: a block of updates on each that is not timed, and as many rounds of timed
blocks as ``--rounds`` says. All make the same updates from the same keys. Scaling is env steps a
second on D devices, over D times those on the first number of devices.
"""

import argparse
import dataclasses
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from experiments.kit.rows import read
from experiments.speed.sweep_scaling import measure

#: Task, seeds, episodes an update, and updates a block.
RUNS = {"episodes": ("HalfCheetah-v5", 1, 65_536, 3), "seeds": ("Ant-v5", 16, 2048, 2)}


def say(text: str) -> None:
    """Prints a line at once."""
    print(text, flush=True)


def train(part: str, settings: argparse.Namespace) -> None:
    """Measures a run on each number of devices, and prints the table."""
    import jax

    from mjx_reinforce import envs
    from mjx_reinforce.console.jax_setup import configure_jax
    from mjx_reinforce.settings.defaults import of_task
    from mjx_reinforce.store.ready import made
    from mjx_reinforce.training.division import Division
    from mjx_reinforce.training.programs import compile_run
    from mjx_reinforce.training.state import Budget

    configure_jax()
    task, num_seeds, num_episodes, updates = RUNS[part]
    num_episodes = settings.num_episodes or num_episodes
    updates = settings.updates or updates
    config = dataclasses.replace(
        of_task(task, env_steps=10**12, num_seeds=num_seeds),
        num_episodes=num_episodes,
        eval_every=updates,
    )
    env = envs.make(task)

    def prepare(count: int) -> tuple[Any, Any, float]:
        began = time.perf_counter()
        division = Division(**{part: count})
        state, run = compile_run(made(env, config, division=division).programs, config)
        return state, run, time.perf_counter() - began

    say(f"{part}: {num_seeds} seeds of {task}, {num_episodes:,} episodes an update")
    with ThreadPoolExecutor() as pool:
        ready = dict(zip(settings.devices, pool.map(prepare, settings.devices), strict=True))
    for count, (_, _, seconds) in ready.items():
        say(f"compiled for {count} devices, beside the others, in {seconds:.1f} s")
    states = {count: state for count, (state, _, _) in ready.items()}
    times: dict[int, list[tuple[float, int]]] = {count: [] for count in ready}
    for number in range(1 + settings.rounds):
        for count, (_, run, _) in ready.items():
            began = time.perf_counter()
            budget = Budget.of(10**12, (number + 1) * updates)
            states[count], metrics, _ = run.advance(states[count], False, budget)
            jax.block_until_ready(states[count])
            row = time.perf_counter() - began, int(metrics["env_steps"].sum())
            say(f"round {number}: {count} devices, {row[0]:.3f} s, {row[1]:,} env steps")
            if number:
                times[count].append(row)
    say("| devices | training (s) | env steps/s, best round | scaling | every round |")
    say("|---|---|---|---|---|")
    first = settings.devices[0]
    speeds = {count: [n / t for t, n in rows] for count, rows in times.items()}
    for count, rows in times.items():
        ratios = [a / b * first / count for a, b in zip(speeds[count], speeds[first], strict=True)]
        best = max(speeds[count])
        scaling = best / max(speeds[first]) * first / count
        every = ", ".join(f"{100 * ratio:.1f} %" for ratio in ratios)
        seconds = " ".join(f"{t:.2f}" for t, _ in rows)
        say(f"| {count} | {seconds} | {best:.3g} | {100 * scaling:.1f} % | {every} |")
    say(f"{updates} updates a round, on {jax.devices()[0].device_kind}")


def sweep(settings: argparse.Namespace, arguments: list[str]) -> None:
    """Measures a sweep on each number of devices, and prints the table."""
    with tempfile.TemporaryDirectory(prefix="scaling-") as folder:
        rows = {}
        say("| devices | compiling (s) | training (s) | wall (s) | env steps/s | scaling |")
        say("|---|---|---|---|---|---|")
        for count in settings.devices:
            row = rows[count] = measure(count, ["--num-seeds", "1024", *arguments], Path(folder))
            runs = read(Path(folder) / f"{count}-devices" / "results.csv")
            steps = sum(int(run["env_steps"]) for run in runs)
            first = rows[settings.devices[0]]["run_seconds"]
            scaling = first / row["run_seconds"] * settings.devices[0] / count
            cells = [f"{row[name]:.2f}" for name in ("compile_seconds", "run_seconds")]
            cells += [f"{row['wall_seconds']:.2f}", f"{steps / row['run_seconds']:.3g}"]
            say(f"| {count} | {' | '.join(cells)} | {100 * scaling:.1f} % |")


def main() -> None:
    """Measures each part in a process of its own."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--devices", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--parts", nargs="+", default=["episodes", "seeds", "sweep"])
    parser.add_argument("--rounds", type=int, default=2, help="timed blocks on each")
    parser.add_argument("--updates", type=int, help="of a block, instead of the part's own")
    parser.add_argument("--num-episodes", type=int, help="an update, instead of the part's own")
    parser.add_argument("--here", choices=tuple(RUNS), help=argparse.SUPPRESS)
    settings, others = parser.parse_known_args()  # any other flag is the sweep's
    if settings.here is not None:
        train(settings.here, settings)
        return
    for part in settings.parts:
        began = time.monotonic()
        if part == "sweep":
            sweep(settings, others)
        else:
            module = [sys.executable, "-m", "experiments.speed.devices_scaling"]
            subprocess.run([*module, *sys.argv[1:], "--here", part], check=False)
        say(f"{part} took {time.monotonic() - began:.0f} s in all\n")


if __name__ == "__main__":
    main()
