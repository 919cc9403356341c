"""Draws docs/engine.png: env steps a second against the size of the task, engine by engine.

``python -m experiments.speed.benchmark.figure`` reads docs/benchmarks.csv, and from
docs/operations.csv the scalar operations of a step. With ``--count`` it counts the operations
first, in some minutes: a step is what ``native`` plays, with a 16-32 policy and its noise. Those in
the file were counted with JAX 0.12; 0.10.2 gives Pusher 0.1 % more. Machine code for GPUs writes
few contacts out, so that its count differs from a CPU's.
"""

import functools
from collections import defaultdict

import jax
import tyro
from matplotlib.figure import Figure

from experiments.kit import rows as kit
from experiments.kit.pictures import save_picture
from experiments.kit.places import DOCS
from experiments.speed.benchmark.ours import the_policy
from experiments.speed.benchmark.rows import read, speed
from experiments.speed.benchmark.tables import best, last_calls
from mjx_reinforce import act, envs
from mjx_reinforce.engines.chunks import CHUNK_STEPS
from mjx_reinforce.engines.native import program, step
from mjx_reinforce.fused import scalarized

#: engine and precision -> colour (Okabe and Ito's, for all eyes) and marker
STYLES = {
    ("native", "float32"): ("#0072B2", "o"),
    ("native", "float64"): ("#56B4E9", "s"),
    ("plain MJX", "float32"): ("#999999", "v"),
    ("MuJoCo Warp", "float32"): ("#009E73", "^"),
    ("C MuJoCo", "float64"): ("#D55E00", "D"),
}
#: Task, or task and device -> where its name stands, in points from its own, and on which side.
PLACES = {
    ("HalfCheetah", "CPU"): ((7, -8), "left"),
    ("Pusher", "CPU"): ((7, 3), "left"),
    "InvertedDoublePendulum": ((-6, -4), "right"),
    "Hopper": ((-7, 1), "right"),
    "HalfCheetah": ((0, 10), "center"),
    "Walker2d": ((-7, -4), "right"),
    "Pusher": ((7, -6), "left"),
    "HumanoidStandup": ((7, -2), "left"),
}


def main(count: bool = False) -> None:
    """Reads and draws.

    Args:
      count: write the operations again first.
    """
    path = DOCS / "operations.csv"
    counted = kit.read(path)
    if count:
        for row in counted:
            row["operations"] = operations(row["task"], row["device"] == "CPU")
        kit.write(path, counted)
    size = {(row["task"], row["device"]): float(row["operations"]) for row in counted}
    raw = last_calls(read())
    cards = {row["device"] for row in raw.gpu} - {"cpu"}
    panels = {"GPU": (" and ".join(sorted(cards)), raw.gpu), "CPU": ("two CPU cores", raw.cpu)}
    figure = Figure(figsize=(5.5 * len(panels), 4.8), dpi=150, layout="constrained")
    for axes, (device, (title, rows)) in zip(
        figure.subplots(1, len(panels), sharex=True), panels.items(), strict=True
    ):
        lines = defaultdict(list)
        for task in dict.fromkeys(row["task"] for row in rows if (row["task"], device) in size):
            for kind in STYLES:
                if row := best(rows, task, *kind):
                    lines[kind].append((size[task, device], speed(row)))
            name = task.removesuffix("-v5")
            usual = PLACES.get(name, ((7, 4), "left"))
            place, side = PLACES.get((name, device), usual)
            axes.annotate(
                name,
                lines["native", "float32"][-1],
                place,
                textcoords="offset points",
                size=7,
                ha=side,
            )
        for (engine, precision), points in lines.items():
            colour, marker = STYLES[engine, precision]
            x, y = zip(*points, strict=True)
            axes.loglog(x, y, marker, color=colour, label=f"{engine}, {precision}")
        axes.set(title=title, xlabel="scalar operations of a step, a loop's body once")
        axes.set_ylabel("env steps a second")
        axes.margins(x=0.6, y=0.12)
        axes.grid(alpha=0.3)
        axes.legend(fontsize="small")
    save_picture(figure, DOCS / "engine.png")


@functools.cache
def operations(task: str, on_cpu: bool) -> int:
    """Counts the operations of the program for a CPU or a GPU."""
    env = envs.make(task)
    policy, actor = the_policy(env, None)
    function = step.step_function(
        env, functools.partial(act, policy), policy.distribution, CHUNK_STEPS
    )
    examples = step.examples(env, actor)
    loops = program.LOOPS
    if not on_cpu:
        function, examples = program.while_running(function), examples[:-1]
        loops = program.GPU_LOOPS
    varying = [True] * len(jax.tree.leaves(examples))
    written = scalarized.build(function, examples, varying, step.BRANCH_COST, loops)
    return sum(written.operations.values())


if __name__ == "__main__":
    tyro.cli(main)
