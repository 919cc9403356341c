r"""How fast `make_vec` steps under random actions, beside what people use otherwise, in one run.

    python -m experiments.speed.vector_speed           # four tasks, some minutes
    python -m experiments.speed.vector_speed --envs Hopper-v5 --csv rows.csv
    python -m experiments.speed.vector_speed --num-envs 32768 --steps 1000 \
        --engines native fused --alone

Ours in float32, within one compiled loop, as single calls from Python, and through Gymnasium's
interface with NumPy arrays; Gymnasium's vector environments and C MuJoCo's rollout in float64;
EnvPool where it is installed. All play on all threads, in turn.
"""

import dataclasses
import functools
import importlib.util
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium
import jax
import numpy as np
import tyro
from jax import lax

from experiments.kit.rows import threads, write
from experiments.speed.benchmark.peers import c_mujoco
from experiments.speed.benchmark.rows import Candidate, measure
from mjx_reinforce import make_vec
from mjx_reinforce.console.jax_setup import configure_jax
from mjx_reinforce.vector import for_gymnasium

TASKS = ("InvertedPendulum-v5", "HalfCheetah-v5", "Ant-v5", "Humanoid-v5")


@dataclasses.dataclass(frozen=True)
class Settings:
    """Times env steps of vectorised environments."""

    envs: tuple[str, ...] = TASKS
    """The tasks."""
    num_envs: int = 512
    """Environments that play at once; 8 for Gymnasium's own, whose speed does not depend on it."""
    steps: int = 200
    """Steps of each environment in one timing, fewer where they are slow."""
    repeats: int = 5
    """Timings of each; the median is shown."""
    engines: tuple[str, ...] = ("auto",)
    """What steps ours, one after the other."""
    alone: bool = False
    """Leaves out what people use otherwise."""
    csv: Path | None = None
    """File for the rows."""


def ours(env_id: str, num: int, steps: int, engine: str) -> Iterator[Candidate]:
    """`make_vec` in a compiled loop, in single calls, and under Gymnasium's interface."""
    vec = make_vec(env_id, num, engine=engine)
    row = {"task": env_id, "batch": num, "engine": f"ours, {vec.engine.name}"}
    one = jax.jit(vec.step)
    state, actions = jax.jit(vec.reset)(jax.random.key(0)), vec.sample_actions(jax.random.key(1))

    @jax.jit
    def loop(state, key):
        def step(state, key):
            state = vec.step(state, vec.sample_actions(key))
            return state, state.reward

        return lax.scan(step, state, jax.random.split(key, steps))

    def calls():
        after = state
        for _ in range(steps):
            after = one(after, actions)
        jax.block_until_ready(after)

    env = for_gymnasium.GymnasiumVectorEnv(vec)
    env.reset(seed=0)
    yield Candidate(
        row | {"what": "in a compiled loop"},
        lambda: jax.block_until_ready(loop(state, jax.random.key(2))),
        num * steps,
    )
    yield Candidate(row | {"what": "single calls from Python"}, calls, num * steps)
    yield Candidate(
        row | {"what": "Gymnasium's interface, NumPy"},
        functools.partial(_play, env, np.asarray(actions), steps),
        num * steps,
    )


def others(env_id: str, num: int) -> Iterator[Candidate]:
    """What people use otherwise."""
    steps = 20 if "Humanoid" in env_id else 100
    for mode in ("sync", "async"):
        env = gymnasium.make_vec(env_id, num_envs=8, vectorization_mode=mode)
        env.reset(seed=0)
        row = {"task": env_id, "batch": 8, "engine": f"Gymnasium, {mode}", "what": "NumPy"}
        actions = env.action_space.sample()
        yield Candidate(row, functools.partial(_play, env, actions, steps), 8 * steps)
    if importlib.util.find_spec("envpool"):
        yield _envpool(env_id, num, steps)
    bare = c_mujoco(env_id, num)
    yield bare._replace(row={**bare.row, "what": "physics alone"})


def _envpool(env_id: str, num: int, steps: int) -> Candidate:
    import envpool  # pyright: ignore[reportMissingImports]

    name = env_id if env_id in envpool.list_all_envs() else env_id.replace("-v5", "-v4")
    env: Any = envpool.make_gymnasium(name, num_envs=num, num_threads=threads())
    env.reset()
    actions = np.stack([env.action_space.sample() for _ in range(num)])
    row = {"task": env_id, "batch": num, "engine": f"EnvPool, {name[-2:]}", "what": "NumPy"}
    return Candidate(row, functools.partial(_play, env, actions, steps), num * steps)


def _play(env: Any, actions: np.ndarray, steps: int) -> None:
    for _ in range(steps):
        env.step(actions)


def main(settings: Settings) -> None:
    """Times all, and prints a table."""
    configure_jax()
    rows = []
    for env_id in settings.envs:
        steps = settings.steps // 10 if "Humanoid" in env_id else settings.steps
        candidates = [
            candidate
            for engine in settings.engines
            for candidate in ours(env_id, settings.num_envs, steps, engine)
        ]
        if not settings.alone:
            candidates += others(env_id, settings.num_envs)
        for row in measure(candidates, settings.repeats):
            speed = float(np.median(row.pop("env_steps_per_second")))
            row = {name: row[name] for name in ("task", "engine", "what", "batch")}
            rows.append(row | {"env_steps_per_second": f"{speed:.3g}"})
            print("  ".join(f"{value!s:<30}" for value in rows[-1].values()), flush=True)
    if settings.csv:
        write(settings.csv, rows)


if __name__ == "__main__":
    main(tyro.cli(Settings))
