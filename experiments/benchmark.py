"""How fast every engine is, beside what a user would otherwise pick, in one table from one run.

    python experiments/benchmark.py --quick          # two minutes on a CPU
    python experiments/benchmark.py --json rows.json # everything

All engines play the same looping task: an episode that ends starts again from its own start state,
so that every simulated step is a real one. Runs are interleaved and the median is reported; compare
rows of one run with each other, not with another machine's.
"""

import dataclasses
import functools
import json
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import tyro
from flax import struct
from rich.console import Console
from rich.table import Table

from benchmark_peers import Candidate, peers
from mjx_reinforce import Actor, act, envs, load_policy, mlp_policy, reinforce
from mjx_reinforce.engines.choice import Player, choose
from mjx_reinforce.learners.reinforce import default_distribution
from mjx_reinforce.policies import normalize
from mjx_reinforce.types import action_space, observation_size

#: Name in the table -> engine, and the solver of the environment's physics.
ENGINES = {
    "mjx": ("vmap", "mjx"),
    "mjx, 1 iteration": ("vmap", "fast"),
    "vmap": ("vmap", "exact"),
    "fused": ("fused", "exact"),
    "native": ("native", "exact"),
}
KEYS = (
    "what",
    "engine",
    "env",
    "batch",
    "device",
    "env_steps_per_second",
    "physics_steps_per_second",
    "compile_seconds",
    "peak_memory_bytes",
    "ratio_to_mjx",
)


@dataclasses.dataclass(frozen=True)
class Settings:
    """Measure engines and peers: rollouts with their policy, and whole training updates."""

    env: tuple[str, ...] = ("InvertedPendulum-v5",)
    """Environments."""
    engine: tuple[str, ...] = ()
    """Rows of the table: mjx, "mjx, 1 iteration", vmap, fused and native; all but vmap if not
    given."""
    batch: tuple[int, ...] = (128, 512, 2048, 8192)
    """Episodes played at once."""
    max_mjx_batch: int = 2048
    """Plain MJX is not run on more, which takes minutes on a CPU."""
    steps: int = 100
    """Env steps of each episode."""
    repeats: int = 5
    """Timed runs of each row; the median counts."""
    train: bool = True
    """Also measure training updates (16-32 and 64-64 networks) at the greatest batch."""
    policy: Path | None = None
    """The policy folder of a run, instead of an untrained 16-32 network."""
    json: Path | None = None
    """Where to write the rows."""
    png: Path = Path("benchmark.png")
    """Where to draw steps per second against batch."""
    quick: bool = False
    """InvertedPendulum on mjx, fused, native and C MuJoCo only, in under two minutes."""


@struct.dataclass
class LoopState:
    """A state of a looping environment, and where it starts again."""

    inner: Any
    start: Any
    obs: jax.Array
    reward: jax.Array
    done: jax.Array


class Loop:
    """An environment whose episodes never end: they start again where they started."""

    def __init__(self, env: Any, steps: int):
        self.env, self.max_episode_steps = env, steps
        self.action_size, self.action_space = env.action_size, action_space(env)

    def reset(self, rng):
        """Starts an episode, and remembers the start."""
        state = self.env.reset(rng)
        return LoopState(state, state, state.obs, state.reward, state.done)

    def step(self, state, action):
        """Steps, or goes back to the start where the episode is over."""
        after = self.env.step(state.inner, action)
        over = after.done > 0
        inner = jax.tree.map(lambda s, x: jnp.where(over, s, x), state.start, after)
        return LoopState(inner, state.start, inner.obs, after.reward, jnp.zeros_like(after.done))


def main() -> None:
    """Measures, prints, draws and writes."""
    settings = tyro.cli(Settings, description=__doc__)
    if settings.quick:
        settings = dataclasses.replace(
            settings,
            engine=("mjx", "fused", "native"),
            batch=(128, 1024, 4096),
            max_mjx_batch=128,
            repeats=3,
            train=False,
        )
    jax.config.update("jax_default_matmul_precision", "highest")
    if not settings.engine:
        engine = ("mjx", "mjx, 1 iteration", "fused", "native")
        settings = dataclasses.replace(settings, engine=engine)
    rows = []
    for env in settings.env:
        candidates = [
            *rollouts(env, settings),
            *trainings(env, settings),
            *peers(env, settings.quick),
        ]
        rows += measure(candidates, settings.repeats)
    show(rows)
    draw(rows, settings.png)
    if settings.json:
        settings.json.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")


def rollouts(env_id: str, settings: Settings) -> list[Candidate]:
    """Whole rollouts, policy included, for every engine and batch."""
    candidates = []
    for name in settings.engine:
        engine_name, solver = ENGINES[name]
        env = Loop(make(env_id, solver), settings.steps)
        policy, actor = the_policy(env, settings.policy)

        play_act = functools.partial(act, policy)
        began = time.perf_counter()
        player = Player(play_act, actor, policy.distribution)
        engine = choose(engine_name, env, player, settings.steps)
        choosing = time.perf_counter() - began
        for batch in settings.batch:
            if engine_name == "vmap" and batch > settings.max_mjx_batch:
                continue

            def play(actor, key, env=env, act=play_act, engine=engine, policy=policy, batch=batch):
                return engine.rollout(
                    env,
                    act,
                    actor,
                    policy.distribution,
                    key,
                    num_episodes=batch,
                    horizon=settings.steps,
                )

            row = {"what": "rollout", "engine": name, "env": env_id, "batch": batch}
            candidate = compiled(row, play, actor, settings.steps * batch, env.env)
            row["compile_seconds"] += choosing  # machine code is made when its engine is chosen
            candidates.append(candidate)
    return candidates


def trainings(env_id: str, settings: Settings) -> list[Candidate]:
    """Whole updates: rollout, estimator, gradient and optimiser."""
    candidates = []
    if not settings.train:
        return candidates
    batch = max(settings.batch)
    for name in settings.engine:
        engine_name, solver = ENGINES[name]
        if engine_name == "vmap":
            batch = min(batch, settings.max_mjx_batch)
        for sizes in ((16, 32), (64, 64)):
            env = Loop(make(env_id, solver), settings.steps)
            distribution = default_distribution(action_space(env))
            policy = mlp_policy(observation_size(env), distribution, sizes)
            began = time.perf_counter()
            learner = reinforce(env, policy=policy, num_episodes=batch, engine=engine_name)
            choosing = time.perf_counter() - began
            state = learner.init(jax.random.key(0))

            def update(state, key, learner=learner):
                return learner.step(dataclasses.replace(state, key=key))

            label = f"{name}, {sizes[0]}-{sizes[1]}"
            row = {"what": "train", "engine": label, "env": env_id, "batch": batch}
            candidate = compiled(row, update, state, settings.steps * batch, env.env)
            row["compile_seconds"] += choosing
            candidates.append(candidate)
        batch = max(settings.batch)
    return candidates


def make(env_id: str, solver: str) -> Any:
    """Builds an environment; one without a MuJoCo model has no solver."""
    env = envs.make(env_id)
    return envs.make(env_id, solver=solver) if hasattr(env, "mj_model") else env


def the_policy(env: Any, directory: Path | None) -> tuple[Any, Actor]:
    """A trained policy's first seed, or a fresh 16-32 network."""
    if directory is not None:
        return load_policy(directory, seed=0)
    size = observation_size(env)
    policy = mlp_policy(size, default_distribution(action_space(env)), (16, 32))
    return policy, Actor(params=policy.init(jax.random.key(0)), normalizer=normalize.init(size))


def compiled(
    row: dict[str, Any], fn: Callable[..., Any], argument: Any, env_steps: int, env: Any
) -> Candidate:
    """Compiles ``fn(argument, key)`` and notes how long that took and what memory it needs."""
    started = time.perf_counter()
    program = jax.jit(fn).lower(argument, jax.random.key(0)).compile()
    row["compile_seconds"] = time.perf_counter() - started
    memory = program.memory_analysis()
    row["peak_memory_bytes"] = (
        memory.temp_size_in_bytes + memory.output_size_in_bytes + memory.argument_size_in_bytes
        if memory
        else None
    )
    row["device"] = jax.devices()[0].device_kind
    row["frame_skip"] = getattr(env, "frame_skip", 1)
    keys = iter(jax.random.split(jax.random.key(1), 1000))
    return Candidate(row, lambda: jax.block_until_ready(program(argument, next(keys))), env_steps)


def measure(candidates: list[Candidate], repeats: int) -> list[dict[str, Any]]:
    """Times all candidates in turn, several times, and completes their rows."""
    times: list[list[float]] = [[] for _ in candidates]
    for repeat in range(repeats + 1):
        for candidate, taken in zip(candidates, times, strict=True):
            started = time.perf_counter()
            candidate.run()
            if repeat:  # the first warms up
                taken.append(time.perf_counter() - started)
    rows = []
    for candidate, taken in zip(candidates, times, strict=True):
        speed = candidate.env_steps / statistics.median(taken)
        row: dict[str, Any] = {"compile_seconds": None, "peak_memory_bytes": None}
        row |= candidate.row
        row["env_steps_per_second"] = speed
        row["physics_steps_per_second"] = speed * row.pop("frame_skip")
        rows.append(row)
    for what in ("rollout", "train"):
        same = [row for row in rows if row["what"] == what]
        plain = [r["env_steps_per_second"] for r in same if r["engine"] in ("mjx", "mjx, 16-32")]
        best = max(plain or [float("nan")])
        for row in same:
            row["ratio_to_mjx"] = row["env_steps_per_second"] / best
    return [{key: row[key] for key in KEYS} for row in rows]


def show(rows: list[dict[str, Any]]) -> None:
    """Prints the table."""
    table = Table(*(key.replace("_", " ") for key in KEYS))
    for row in rows:
        table.add_row(*(_format(row[key]) for key in KEYS))
    Console(width=180).print(table)
    print("ratio to mjx: to plain MJX at its best batch in this run")


def _format(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:,.0f}" if value >= 100 else f"{value:.2f}"
    return "" if value is None else f"{value:,}" if isinstance(value, int) else str(value)


def draw(rows: list[dict[str, Any]], path: Path) -> None:
    """Draws env steps per second against batch, both on logarithmic axes."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 5), dpi=150, layout="constrained")
    axes = figure.subplots()
    lines = {(row["env"], row["engine"]) for row in rows if row["what"] == "rollout"}
    for env, engine in sorted(lines):
        chosen = [r for r in rows if (r["env"], r["engine"], r["what"]) == (env, engine, "rollout")]
        x, y = zip(*((r["batch"], r["env_steps_per_second"]) for r in chosen), strict=True)
        axes.loglog(x, y, marker="o", label=f"{engine}, {env}")
    axes.set(xlabel="episodes at once", ylabel="env steps per second", title=rows[0]["device"])
    axes.grid(alpha=0.3, which="both")
    axes.legend(fontsize="small")
    figure.savefig(path)


if __name__ == "__main__":
    main()
