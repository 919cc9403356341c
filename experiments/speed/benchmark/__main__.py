"""Makes the rows of docs/benchmarks.csv: everything that README.md and the documents say of speed.

    python -m experiments.speed.benchmark gpu --minutes 8 --commit $(git rev-parse HEAD)
    python -m experiments.speed.benchmark cpu --minutes 4 --commit $(git rev-parse HEAD)

Each task has a process of its own. All compile at once, on all cores. When all have (or six
tenths of the minutes are over, and what has not compiled is left out), one after the other times
its engines and peers, interleaved, while nothing else runs, and appends its rows: a call that is
cut off keeps what was timed. On a CPU a process has two threads from its start, and all are timed
on the same two cores (``taskset``). `tables.py` makes the tables.
``cpu --tasks Hopper-v5 --csv rows.csv`` times one task on the machine at hand, in some minutes.

A task is an id of ``envs.make``, with settings after it, such as a robot's file, and ``--runs`` are
run directories of such tasks, whose best policies play, too:

    ROBOT="experiments.speed.benchmark.robots:Robot xml_file=models/go1/scene.xml"
    python -m mjx_reinforce.train --env ${ROBOT% *} --env-set ${ROBOT#* } --output go1
    python -m experiments.speed.benchmark gpu --minutes 8 --tasks "$ROBOT" Humanoid-v5 --runs go1

All engines play the same looping task: an episode that ends starts again from its own start state,
so that every simulated step is a real one. Compare rows of one call with each other, not with
another machine's. With MJX_REINFORCE_DEBUG=1 the native engine describes its kernels.
"""

import concurrent.futures
import dataclasses
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import IO, Literal, NamedTuple

import tyro

from experiments.kit.rows import now, shared_clock
from experiments.speed.benchmark.rows import RAW, Candidate


class Sizes(NamedTuple):
    """How much of a task is timed on a GPU; episodes fill an H100 or an H200 once or more often.

    MuJoCo Warp needs room beside the record of native's episodes, which XLA copies: a Humanoid's,
    of 200 env steps, left too little of 80 GB.

    batch, steps: of native's episodes
    few: native is timed with so many episodes too, and MuJoCo Warp with so many worlds
    worlds: of env steps of Playground's tasks, each number that is tried
    mjx: the episodes of plain MJX, each number that is tried
    mjx_steps: their env steps
    warp: the worlds of MuJoCo Warp, each number that is tried
    """

    batch: int
    steps: int
    mjx: tuple[int, ...] = ()
    mjx_steps: int = 0
    warp: tuple[int, ...] = (8_192, 32_768)
    few: tuple[int, ...] = ()
    worlds: tuple[int, ...] = ()


#: A task of a user's own, and the same with elliptic cones.
QUADRUPED = "experiments.examples.quadruped:Quadruped"
ELLIPTIC = "experiments.speed.benchmark.robots:EllipticQuadruped"
#: Of a task that is not in ``GPU``.
OTHER = Sizes(33_792, 200, few=(2_048,))
#: Of a task of MuJoCo Playground, whose own env step is the peer.
OF_PLAYGROUND = Sizes(33_792, 200, warp=(), worlds=(2_048, 8_192, 32_768))
#: What stands first is timed first, and so kept where a call is cut off.
GPU = {
    "InvertedPendulum-v5": Sizes(262_144, 200, (16_384, 65_536), 50, (32_768, 131_072)),
    "Hopper-v5": Sizes(33_792, 1_000, (8_192, 32_768), 10, few=(2_048,)),
    "HalfCheetah-v5": Sizes(33_792, 1_000, (8_192, 32_768), 10, few=(2_048,)),
    "Walker2d-v5": Sizes(33_792, 1_000, (32_768,), 5, few=(2_048,)),
    "Ant-v5": Sizes(33_792, 500, (32_768,), 2, few=(2_048,)),
    "Pusher-v5": Sizes(67_584, 100, (32_768,), 10),
    "Reacher-v5": Sizes(540_672, 50, (16_384, 65_536), 50, (32_768, 131_072)),
    "Swimmer-v5": Sizes(135_168, 200, (8_192,), 20, (32_768, 131_072)),
    "InvertedDoublePendulum-v5": Sizes(135_168, 200, (4_096,), 20, (32_768, 131_072)),
    "CartPole-v1": Sizes(262_144, 200, warp=()),
    "Humanoid-v5": Sizes(33_792, 100, few=(2_048,)),
    "HumanoidStandup-v5": Sizes(33_792, 100, few=(2_048,)),
    QUADRUPED: OTHER,
    ELLIPTIC: OTHER,
}
#: Episodes and env steps of native's on two cores.
CPU = {
    "InvertedPendulum-v5": (8_192, 100),
    **dict.fromkeys(("Hopper-v5", "HalfCheetah-v5", "Walker2d-v5"), (2_048, 20)),
    **dict.fromkeys(("Ant-v5", "Humanoid-v5", "HumanoidStandup-v5", QUADRUPED), (512, 20)),
    "Pusher-v5": (2_048, 20),
    **dict.fromkeys(("Reacher-v5", "Swimmer-v5", "InvertedDoublePendulum-v5"), (2_048, 50)),
}
#: The task that also shows the engines beside native on a CPU.
SHOWN_ON_CPU = "InvertedPendulum-v5"


@dataclasses.dataclass(frozen=True)
class Settings:
    """Measure all that the documents say of speed, on a GPU or on two cores of a CPU."""

    part: tyro.conf.Positional[Literal["gpu", "cpu"]]
    """gpu: rollouts on a GPU; cpu: on two cores."""
    minutes: float = 5.0
    """What this may take; what is not done by then is left out."""
    csv: Path = RAW
    """Where to append the rows."""
    commit: str = ""
    """Of the code that is measured."""
    repeats: int = 4
    """Timed runs of each row, after one that warms up."""
    tasks: tuple[str, ...] = ()
    """All of the part if not given: ids, with settings after them, "ID NAME=VALUE"."""
    runs: tuple[Path, ...] = ()
    """Run directories whose best policies play on a GPU, too, each in the task of its training."""
    batches: tuple[int, ...] = ()
    """On a GPU, episodes of native and worlds of MuJoCo Warp, each number in turn; the task's own
    numbers if not given. With few of them the rows tell how long an env step takes."""
    steps: int = 0
    """On a GPU, env steps of native's episodes; the task's own number if 0."""
    busy: bool = False
    """On a CPU with other jobs: count the seconds that the process's threads compute, divided by
    their number, not those that pass."""
    shrink: int = 1
    """Divide episodes and worlds by this, to try the script; such rows are worth nothing."""
    worker: str = ""
    """The call that this process times its only task for."""


def main() -> None:
    """Starts a process for each task, or is one."""
    settings = tyro.cli(Settings, prog="python -m experiments.speed.benchmark", description=__doc__)
    if settings.worker:
        work(settings)
    else:
        conduct(settings)


def conduct(settings: Settings) -> None:
    """Lets all tasks compile at once, then time one by one."""
    began = time.monotonic()
    date = now()
    every = {"cpu": list(CPU), "gpu": list(GPU)}
    tasks = list(settings.tasks or every[settings.part])
    started = {task: start(task, i, date, settings) for i, task in enumerate(tasks)}
    try:
        time_in_turn(started, settings, began)
    finally:
        for process in started.values():
            stop(process)
    print(f"{settings.part}: {time.monotonic() - began:.0f} s", flush=True)


def time_in_turn(
    started: dict[str, subprocess.Popen[str]], settings: Settings, began: float
) -> None:
    """Waits until tasks have compiled, and lets one after the other time."""
    with concurrent.futures.ThreadPoolExecutor(len(started)) as pool:
        ready = {task: pool.submit(until, p.stdout, "compiled") for task, p in started.items()}
        concurrent.futures.wait(ready.values(), timeout=0.6 * 60 * settings.minutes)
        for task, process in started.items():
            if not ready[task].done() or not ready[task].result():
                print(f"{task}: left out, not compiled in time or failed", flush=True)
                stop(process)
    print(f"compiled after {time.monotonic() - began:.0f} s", flush=True)
    for process in started.values():
        left = settings.minutes * 60 - (time.monotonic() - began)
        if process.poll() is None and left > 0:
            if settings.part == "cpu":
                quiet = named(two_cores())
                move = ["taskset", "-acp", quiet, str(process.pid)]
                subprocess.run(move, check=True, stdout=subprocess.DEVNULL)
            print(*go(process, left), sep="\n", flush=True)
        stop(process)


def stop(process: subprocess.Popen[str]) -> None:
    """Ends a task's process, which ends its compilers first: they would disturb the others."""
    process.terminate()
    try:
        process.wait(timeout=30)
    except subprocess.TimeoutExpired:
        process.kill()


def start(task: str, index: int, date: str, settings: Settings) -> subprocess.Popen[str]:
    """Starts a task's process; on a CPU, held to two of the machine's threads."""
    command = [sys.executable, "-m", "experiments.speed.benchmark", settings.part]
    command += ["--tasks", task, "--worker", date]
    for name in ("minutes", "csv", "commit", "repeats", "steps", "shrink"):
        command.append(f"--{name}={getattr(settings, name)}")
    command += ["--busy"] if settings.busy else []
    runs = [str(run) for run in settings.runs if task_of(run) == task]
    command += ["--runs", *runs] if runs else []
    if settings.batches:
        command += ["--batches", *map(str, settings.batches)]
    environment = os.environ | {"XLA_PYTHON_CLIENT_PREALLOCATE": "false"}
    if settings.part == "cpu":
        environment["JAX_PLATFORMS"] = "cpu"
        usable = sorted(os.sched_getaffinity(0))
        first = 2 * (index % (len(usable) // 2))
        command = ["taskset", "-c", named(usable[first : first + 2]), *command]
    pipe = subprocess.PIPE
    return subprocess.Popen(command, stdin=pipe, stdout=pipe, env=environment, text=True)


def two_cores() -> list[int]:
    """Returns a hardware thread of each of two cores, or two threads where it has one core."""
    usable = sorted(os.sched_getaffinity(0))
    place = "/sys/devices/system/cpu/cpu{}/topology/thread_siblings_list"
    cores = {}
    for thread in usable:
        siblings = Path(place.format(thread))
        cores.setdefault(siblings.read_text() if siblings.exists() else thread, thread)
    return list(cores.values())[:2] if len(cores) > 1 else usable[:2]


def named(threads: list[int]) -> str:
    """Returns threads as ``taskset`` takes them."""
    return ",".join(str(thread) for thread in threads)


def until(stream: IO[str] | None, word: str) -> bool:
    """Reads lines up to a word; returns whether it came."""
    return stream is not None and any(line.strip() == word for line in stream)


def go(process: subprocess.Popen[str], seconds: float) -> list[str]:
    """Lets a process time, for so long at most; returns what it printed."""
    try:
        lines = process.communicate("go\n", timeout=seconds)[0].splitlines()
    except subprocess.TimeoutExpired:
        return ["no time left"]
    # A compiler or driver that ends the process says nothing.
    failure = f"ended with exit status {process.returncode}"
    return [*lines, failure] if process.returncode else lines


def work(settings: Settings) -> None:
    """Compiles one task's engines, waits for its turn, times and appends."""
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))  # not at once: compilers are ended first
    import jax

    from experiments.speed.benchmark.rows import append, facts, measure, speed

    jax.config.update("jax_default_matmul_precision", "highest")
    (task,) = settings.tasks
    candidates_of = on_gpu if settings.part == "gpu" else on_cpu
    candidates = candidates_of(task, settings)
    print("compiled", flush=True)
    if sys.stdin.readline().strip() != "go":
        return
    said = facts(settings.worker, settings.commit)
    clock = shared_clock if settings.busy else time.perf_counter
    rows = [row | said for row in measure(candidates(), settings.repeats, clock)]
    if settings.busy:
        for row in rows:
            row["settings"] = "; ".join(filter(None, (row["settings"], "seconds of the CPU")))
    append(settings.csv, rows)
    for row in rows:
        words = (row[key] for key in ("task", "what", "engine", "precision", "batch"))
        print(*words, f"{speed(row):.3g} env steps/s", sep=", ", flush=True)


def task_of(run: Path) -> str:
    """Returns the task that a run was trained in."""
    from mjx_reinforce.export.run_files import read_run

    facts = read_run(run)
    return " ".join((facts.env, *facts.env_set))


def added(task: str, worlds: int) -> list[Candidate]:
    """MuJoCo Warp with so many worlds; where it fails, its reason is printed instead."""
    from experiments.speed.benchmark.peers import mujoco_warp

    try:
        candidate = mujoco_warp(task, worlds)
        candidate.run()
    except Exception as error:  # whatever it raises, the other rows stand
        print(f"{task}: MuJoCo Warp, {worlds} worlds: {error!r}", file=sys.stderr, flush=True)
        return []
    return [candidate]


def on_gpu(task: str, settings: Settings) -> Callable[[], list[Candidate]]:
    """Native, plain MJX, C MuJoCo and MuJoCo Warp; records wait, for all tasks share the GPU."""
    from experiments.speed.benchmark.ours import rollout_of, rollouts
    from experiments.speed.benchmark.peers import c_mujoco

    of_playground = task.startswith("playground:")
    sizes = GPU.get(task, OF_PLAYGROUND if of_playground else OTHER)
    if settings.batches:
        steps = settings.steps or sizes.steps
        sizes = Sizes(settings.batches[-1], steps, warp=(), few=settings.batches[:-1])
        if of_playground:
            sizes = sizes._replace(few=(), worlds=settings.batches)
    native = []
    for run in (None, *settings.runs):
        try:
            native.append(rollout_of(task, "native", sizes.steps, run=run))
        except ValueError as error:  # what native refuses, peers may play
            print(f"{task}: {error}", file=sys.stderr, flush=True)
    for rollout in native:
        rollout(128).run()  # the machine code is the same for any number of episodes
    plain = [batch // settings.shrink for batch in sizes.mjx]
    others = rollouts(task, "plain MJX", plain, sizes.mjx_steps) if plain else []
    env_steps: Callable[[], list[Candidate]] = list
    if of_playground:
        from experiments.speed.benchmark import playground

        numbers = tuple(max(1, number // settings.shrink) for number in sizes.worlds)
        env_steps = partial(playground.candidates, playground.compiled(task, numbers))
    worlds = () if of_playground else settings.batches or (*sizes.few, *sizes.warp)
    if worlds:
        added(task, 128)  # compiles
    if sizes.warp:
        others.append(c_mujoco(task))

    def candidates() -> list[Candidate]:
        batches = [max(1, batch // settings.shrink) for batch in (*sizes.few, sizes.batch)]
        ours = [rollout(batch) for rollout in native for batch in batches] + env_steps()
        numbers = [max(1, number // settings.shrink) for number in worlds]
        return sum((added(task, number) for number in numbers), ours + others)

    return candidates


def on_cpu(task: str, settings: Settings) -> Callable[[], list[Candidate]]:
    """Native in both precisions beside C MuJoCo and Gymnasium, on the threads of this process."""
    from experiments.speed.benchmark.ours import rollouts
    from experiments.speed.benchmark.peers import peers

    batch, steps = CPU[task]
    batches = [batch // settings.shrink]
    candidates = rollouts(task, "native", batches, steps)
    candidates += rollouts(task, "native", batches, steps, "float64")
    if task == SHOWN_ON_CPU:
        candidates += rollouts(task, "plain MJX", [128, 512], steps)
    candidates += peers(task)
    return lambda: candidates


if __name__ == "__main__":
    main()
