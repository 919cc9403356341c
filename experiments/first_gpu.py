"""Times one GPU code generator against the other: PTX of LLVM IR, and CUDA C++ through NVRTC.

    python -m experiments.first_gpu [TASK ...]

ptx: as on main. cpp: the same program, a C++ statement a scalar, a thread an episode. team: the
device code of teams with one lane, whose state is the thread's own. An experiment, not for main.
"""

import functools
import re
import statistics
import sys
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np

from experiments.speed.benchmark import ours
from experiments.speed.benchmark.robots import make
from mjx_reinforce import act
from mjx_reinforce.engine import objects
from mjx_reinforce.engine.gpu import kernel, nvrtc, ptx, thread_kernel
from mjx_reinforce.engine.play import native, teams

WAYS = ("ptx", "cpp", "team")
STEPS = 500
BATCHES = (2_048, 32_768, 131_072)
REPEATS = 4
#: Seconds of the parts of compiling, and the assembler's log, of the way that is made now.
NOTES: dict[str, Any] = {}
_FACTS = r"Used \d+ registers|\d+ bytes stack frame|\d+ bytes spill \w+"


def timed(name, function):
    """Returns a function that adds to the notes how long it took."""

    def run(*args, **kwargs):
        began = time.perf_counter()
        result = function(*args, **kwargs)
        NOTES[name] = NOTES.get(name, 0) + time.perf_counter() - began
        return result

    return run


def prepare():
    """Keeps nothing on disk, and notes what compiling takes and makes."""
    machine_code = ptx._machine_code

    def assembled(kernel_made, assembler, folder):
        def assemble(text):
            if kernel_made.language == "cuda":
                Path(f"/tmp/{NOTES['name']}.cu").write_text(text)
            log, image = timed("assemble", assembler.assemble)(text)
            NOTES["log"] = f"{assembler.name}: {', '.join(re.findall(_FACTS, log))}"
            return log, image

        return machine_code(kernel_made, assembler._replace(assemble=assemble), folder)

    ptx._machine_code = assembled
    ptx._compile = timed("llvm", ptx._compile)
    objects.folder = lambda: None
    nvrtc._OPTIONS = (*nvrtc._OPTIONS, "--ptxas-options=-v")
    teams._lanes = lambda model: 1
    teams._shared_memory = lambda: 32_768


WRITE = {"ptx": kernel.kernel_text, "cpp": thread_kernel.kernel_text, "team": kernel.kernel_text}
LOAD = ptx.load_kernel
TEAM_PHYSICS = teams.team_physics
SMALLEST = teams._LEAST_DOFS


def choose(task, way):
    """Lets the native engine write its kernels in a way."""
    NOTES.clear()
    NOTES["name"] = f"{task}.{way}"
    teams._LEAST_DOFS = 0 if way == "team" else 10**9
    kernel.kernel_text = timed("write", WRITE[way])
    # The kernels of two ways are two, though the program is one.
    ptx.load_kernel = lambda source, write, *rest: LOAD(
        f"{way} {source}", team_of_256(write), *rest
    )


def team_of_256(write):
    """Returns what writes a source whose blocks have 256 threads, of 255 registers each."""

    def written():
        source = write()
        if source.launch.most_threads:
            launch = source.launch._replace(threads=256, most_threads=0)
            return source._replace(launch=launch)
        return source

    return written


def compiled(task, way, batch):
    """Returns a compiled rollout, once it has run, and its trajectory."""
    env = ours.Loop(make(task), STEPS)
    network, actor = ours.untrained(env)
    choose(task, way)

    def play(actor, key):
        return native.native_rollout(
            env,
            functools.partial(act, network),
            actor,
            network.distribution,
            key,
            num_episodes=batch,
            horizon=STEPS,
        )

    began = time.perf_counter()
    program = jax.jit(play).lower(actor, jax.random.key(0)).compile()
    result = jax.block_until_ready(program(actor, jax.random.key(1)))
    NOTES["all"] = time.perf_counter() - began
    return functools.partial(program, actor), result


def main():
    """Prints a line for each task, way and batch."""
    prepare()
    print(jax.devices()[0].device_kind, "JAX", jax.__version__, nvrtc.version(), flush=True)
    for task in sys.argv[1:] or ("HalfCheetah-v5", "Hopper-v5"):
        for batch in BATCHES:
            runs = {}
            rewards = {}
            for way in WAYS:
                try:
                    runs[way], result = compiled(task, way, batch)
                except Exception as error:
                    print(task, way, "fails:", str(error)[:500], flush=True)
                    continue
                rewards[way] = np.asarray(result.reward)
                simulated = int(np.sum(result.simulated)) / (batch * STEPS)
                if batch == BATCHES[0]:
                    seconds = {
                        part: round(NOTES[part], 2)
                        for part in ("write", "llvm", "assemble", "all")
                        if part in NOTES
                    }
                    print(task, way, "seconds", seconds, NOTES.get("log"), flush=True)
                del result
                print(task, way, batch, f"simulated/played {simulated:.3f}", end="; ")
                print(f"mean reward {rewards[way].mean():.5f}", flush=True)
            seconds = {way: [] for way in runs}
            for repeat in range(REPEATS):
                for way, run in runs.items():
                    key = jax.random.key(2 + repeat)
                    began = time.perf_counter()
                    jax.block_until_ready(run(key))
                    seconds[way].append(time.perf_counter() - began)
            for way in runs:
                speeds = [batch * STEPS / x for x in seconds[way]]
                ratio = statistics.median(seconds["ptx"]) / statistics.median(seconds[way])
                line = " ".join(f"{x:.4g}" for x in speeds)
                print(f"{task} {way} {batch} x {STEPS}: {line} env steps/s, {ratio:.3f} of ptx")
                gap = np.abs(rewards[way][:10] - rewards["ptx"][:10])
                print(
                    f"{task} {way} {batch}: reward - ptx's: step 1 max {gap[0].max():.2g}, 10 steps"
                    f" max {gap.max():.2g}, 99.9 % {np.quantile(gap, 0.999):.2g}, median"
                    f" {np.median(gap):.2g}",
                    flush=True,
                )


if __name__ == "__main__":
    main()
