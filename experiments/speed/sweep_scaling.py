"""How much faster is a sweep on two GPUs than on one? Prints a table of wall times.

``python -m experiments.speed.sweep_scaling --devices 1 2`` trains 1,024 seeds of 16 configurations
of InvertedPendulum on the first GPU, then on the first two, each in a process of its own with
nothing compiled before. Scaling is the time of training on one device, over that on D times D.

With ``--rounds 3`` all are trained in this process instead, three times in turn, and of the fastest
round on each it says where the time goes: ``wide`` are blocks of updates while more than a quarter
of the runs train, ``tail`` those after them.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

OVER = ["--over", "learning-rate", "3e-3", "1e-2", "2e-2", "3e-2"]
OVER += ["--over", "discount", "0.97", "0.98", "0.99", "0.995"]


def measure(devices: int, arguments: list[str], folder: Path) -> dict[str, Any]:
    """Returns the times of a sweep on so many devices (s), from its own account and our clock."""
    output = folder / f"{devices}-devices"
    visible = ",".join(map(str, range(devices)))
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count={devices}"
    environment = os.environ | {
        "CUDA_VISIBLE_DEVICES": visible,
        "XLA_FLAGS": flags.strip(),  # where there are no GPUs
        "XDG_CACHE_HOME": str(folder / f"cache-{devices}"),
    }
    command = [sys.executable, "-m", "mjx_reinforce.sweep", *OVER, *arguments]
    began = time.monotonic()
    subprocess.run([*command, "--output", str(output)], check=True, env=environment)
    wall = time.monotonic() - began
    return json.loads((output / "sweep.json").read_text()) | {"wall_seconds": wall}


def compare(devices: list[int], rounds: int, arguments: list[str], folder: Path) -> None:
    """Trains a sweep of one group on each number of devices in turn, and prints the table."""
    from mjx_reinforce.console.jax_setup import configure_jax
    from mjx_reinforce.devices import Devices
    from mjx_reinforce.runs.display import Display
    from mjx_reinforce.sweeps.command_line import parse_design
    from mjx_reinforce.sweeps.conduct import Conductor, Stage
    from mjx_reinforce.sweeps.designs.plan import prepare_sweep
    from mjx_reinforce.sweeps.programs import SlotPrograms
    from mjx_reinforce.sweeps.results import SweepFiles

    class TimedPrograms(SlotPrograms):
        def begin(self, *args: Any, **named: Any) -> Any:
            return timed("begin", super().begin, *args, **named)

        def evaluate(self, *args: Any, **named: Any) -> Any:
            return timed("evaluate", super().evaluate, *args, **named)

        def advance(self, *args: Any, **named: Any) -> Any:
            part = "wide" if 4 * args[1].sum() > len(args[1]) else "tail"
            measured = timed(part, super().advance, *args, **named)
            blocks[part] += len(measured)
            return measured

    class TimedFiles(SweepFiles):
        def keep_policies(self, *args: Any, **named: Any) -> None:
            timed("save", super().keep_policies, *args, **named)

        def add(self, *args: Any, **named: Any) -> None:
            timed("save", super().add, *args, **named)

    class TimedConductor(Conductor):
        programs: Any = None

        def _compile(self, stage: Stage) -> SlotPrograms:
            return self.programs

    def timed(part: str, function: Any, *args: Any, **named: Any) -> Any:
        began = time.perf_counter()
        result = function(*args, **named)
        seconds[part] += time.perf_counter() - began
        return result

    def conductor(count: int, name: str) -> TimedConductor:
        there = prepared._replace(devices=Devices(count))
        values = there.configurations
        (folder / name).mkdir()
        files = TimedFiles(folder / name, values, None, going_on=False)
        display = Display()
        display.console.quiet = True
        files.open({"status": "running"})
        return TimedConductor(there, design, files, display, None, lambda _: None)

    def compiled(count: int) -> tuple[Any, float]:
        began = time.perf_counter()
        [group] = prepared.groups
        made = Conductor._compile(conductor(count, f"compiled-{count}"), Stage(0, group, []))
        for slot in made.slots.values():
            slot.result()
        return TimedPrograms(*made), time.perf_counter() - began

    configure_jax()
    design = parse_design([*OVER, *arguments, "--output", str(folder / "none")])
    prepared = prepare_sweep(design, None)
    with ThreadPoolExecutor() as pool:
        programs = dict(zip(devices, pool.map(compiled, devices), strict=True))
    parts = ("begin", "wide", "tail", "evaluate", "save")
    rows: dict[int, list[tuple[float, dict, dict]]] = {count: [] for count in devices}
    for number in range(rounds):
        for count in devices:
            seconds: dict[str, float] = dict.fromkeys(parts, 0.0)
            blocks: dict[str, int] = {"wide": 0, "tail": 0}
            going = conductor(count, f"{count}-{number}")
            going.programs = programs[count][0]
            going.conduct()
            rows[count].append((going.clock.running, seconds, blocks))
            print(f"round {number}: {count} devices, {going.clock.running:.3f} s", flush=True)
    print(
        f"| devices | compiling (s) | training (s) | {' | '.join(parts)} | host | scaling | all |"
    )
    print("|" + "---|" * (len(parts) + 6))
    first = min(rows[devices[0]], key=lambda row: row[0])[0]
    for count, every in rows.items():
        total, seconds, blocks = min(every, key=lambda row: row[0])
        cells = [f"{x:.3f}" for x in (total, *seconds.values(), total - sum(seconds.values()))]
        scaling = f"{100 * first / total * devices[0] / count:.1f} %"
        totals = " ".join(f"{row[0]:.2f}" for row in every)
        print(
            f"| {count} | {programs[count][1]:.1f} | {' | '.join(cells)} | {scaling} | {totals} |"
        )
        for part, number in blocks.items():
            if number:
                each = 1000 * seconds[part] / number
                print(f"  {part}: {number} blocks of {each:.1f} ms")


def main() -> None:
    """Measures, and prints the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--devices", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--num-seeds", default="1024")
    parser.add_argument("--rounds", type=int, help="train in this process, so often in turn")
    parser.add_argument("--slots", type=int, nargs="+", help="episodes in one, with --rounds")
    settings, others = parser.parse_known_args()  # any other flag is the sweep's
    arguments = ["--num-seeds", settings.num_seeds, *others]
    with tempfile.TemporaryDirectory(prefix="scaling-") as folder:
        if settings.rounds:
            if settings.slots:
                from mjx_reinforce.sweeps.designs import plan

                plan._CPU_EPISODES = plan._GPU_EPISODES = tuple(settings.slots)
            compare(settings.devices, settings.rounds, arguments, Path(folder))
            return
        times = {n: measure(n, arguments, Path(folder)) for n in settings.devices}
    columns = ("compile_seconds", "run_seconds", "statistics_seconds", "wall_seconds")
    first = times[settings.devices[0]]
    print("| devices | compiling (s) | training (s) | statistics (s) | wall (s) | scaling |")
    print("|---|---|---|---|---|---|")
    for count, row in times.items():
        cells = ["" if row[name] is None else f"{row[name]:.2f}" for name in columns]
        speedup = first["run_seconds"] / row["run_seconds"]
        scaling = speedup * settings.devices[0] / count
        print(f"| {count} | {' | '.join(cells)} | {100 * scaling:.1f} % |")
    print(f"on {first['device']}, {len(first['configurations'])} configurations", end=" ")
    print(f"of {first['num_seeds']:,} seeds")


if __name__ == "__main__":
    main()
