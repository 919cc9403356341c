"""How far machine code is from the physics it was written from, over one env step.

From states that random actions led to, contacts, limits and falls among them: the largest error of
positions, velocities and reward, relative where a number is greater than one, in double precision,
and in single precision beside that of the ``vmap`` engine. Prints a table; takes some minutes a
task.
"""

import dataclasses
import multiprocessing
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from mjx_reinforce import envs, normal
from mjx_reinforce.engines import rollouts
from mjx_reinforce.engines.native import rollout as native

#: Random actions before the step that is compared.
STEPS = 20


@dataclasses.dataclass(frozen=True)
class Settings:
    """Compare machine code with the physics it was written from."""

    env: tuple[str, ...] = ("HalfCheetah-v5", "Hopper-v5", "Walker2d-v5", "Pusher-v5", "Ant-v5")
    """Tasks."""
    states: int = 10_000
    """From so many states."""
    references: Path | None = None
    """Folder of states and of what double precision gives from them. It is made on a CPU; where it
    has a task, single precision alone is compared, also on a GPU."""


class Shown:
    """A task that shows qpos and qvel, never ends, and may start from a row of a table."""

    def __init__(self, id: str, table: np.ndarray | None = None):
        self.env, self.table = envs.make(id), table
        self.action_size, self.action_space = self.env.action_size, self.env.action_space

    def reset(self, rng: jax.Array) -> Any:
        """Starts as the task does, or from a row of the table."""
        if self.table is None:
            return self._show(self.env.reset(rng))
        row = jnp.asarray(self.table, jnp.result_type(float))
        row = row[jax.random.randint(rng, (), 0, len(self.table), jnp.int32)]
        nq = self.env.mj_model.nq
        return self._show(self.env.set_state(row[:nq], row[nq:]))

    def step(self, state: Any, action: jax.Array) -> Any:
        """Steps as the task does."""
        return self._show(self.env.step(state, action))

    def _show(self, state: Any) -> Any:
        physics = state.pipeline_state
        shown = jnp.concatenate([physics.qpos, physics.qvel])
        return state.replace(obs=shown, done=jnp.zeros_like(state.done))


def act(actor: jax.Array, observation: jax.Array) -> jax.Array:
    """Returns outputs whose mean are the last velocities, the same number in both precisions."""
    size = actor.size // 2
    fixed = jnp.broadcast_to(actor[size:], (*observation.shape[:-1], size))
    return jnp.concatenate([observation[..., -size:], fixed], axis=-1)


def play(engine: Any, env: Shown, states: int, steps: int, deterministic: bool) -> Any:
    """Plays ``states`` episodes of ``steps`` steps, without noise if so wished."""
    distribution = normal(env.action_space)
    actor = jnp.concatenate([jnp.zeros(env.action_size), jnp.asarray(distribution.constants)])
    size = {"num_episodes": states, "horizon": steps, "deterministic": deterministic}
    roll = jax.jit(lambda actor, key: engine(env, act, actor, distribution, key, **size))
    return jax.tree.map(np.asarray, roll(actor, jax.random.key(0)))


def after_a_step(engine: Any, id: str, table: np.ndarray) -> np.ndarray:
    """Returns qpos, qvel and the reward after one env step, [states, nq + nv + 1]."""
    played = play(engine, Shown(id, table), len(table), 2, True)
    return np.column_stack([played.observation[1], played.reward[0]]).astype(np.float64)


def errors(got: np.ndarray, want: np.ndarray) -> np.ndarray:
    """Returns the largest error of each state, relative where a number is greater than one."""
    return np.max(np.abs(got - want) / np.maximum(np.abs(want), 1.0), axis=1)


def double(id: str, states: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns states, and what follows a step by the physics and by machine code, in float64."""
    jax.config.update("jax_enable_x64", True)
    played = play(native.rollout, Shown(id), states, STEPS + 1, False)
    table = played.observation[STEPS].astype(np.float32)
    reference, native_step = (after_a_step(x.rollout, id, table) for x in (rollouts, native))
    return table, reference, native_step


def single(id: str, table: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns what follows a step by machine code and by the ``vmap`` engine, in float32."""
    native_step, vmap_step = (after_a_step(x.rollout, id, table) for x in (native, rollouts))
    return native_step, vmap_step


def apart(function: Callable[..., Any], *args: Any) -> Any:
    """Calls a function in a process of its own: what MJX keeps of one precision breaks another."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        return pool.submit(function, *args).result()


def main() -> None:
    """Compares and prints."""
    settings = tyro.cli(Settings, description=__doc__)
    print(f"{'task':24}{'':22}{'median':>10}{'99 %':>10}{'largest':>10}")
    for id in settings.env:
        kept = settings.references and settings.references / f"{id}.npz"
        rows = {}
        if kept and kept.exists():
            with np.load(kept) as arrays:
                table, reference = arrays["states"], arrays["after"]
        else:
            table, reference, rows["native, float64"] = apart(double, id, settings.states)
        if kept and not kept.exists():
            kept.parent.mkdir(parents=True, exist_ok=True)
            np.savez(kept, states=table, after=reference)
        rows["native, float32"], rows["vmap, float32"] = apart(single, id, table)
        for name, got in rows.items():
            found = errors(got, reference)
            quantiles = [np.quantile(found, q) for q in (0.5, 0.99, 1.0)]
            print(f"{id:24}{name:22}" + "".join(f"{x:10.1e}" for x in quantiles), flush=True)


if __name__ == "__main__":
    main()
