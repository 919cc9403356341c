"""`make_vec` beside `gymnasium.make_vec`, step by step in float64 through ends and resets, a table.

    python -m experiments.checks.vector_parity                        # all tasks, some minutes
    python -m experiments.checks.vector_parity --envs Hopper-v5 --steps 500

Gymnasium's environments start from what ours drew; after that each side goes on from its own state,
so that differences grow with the length of an episode. Episodes are cut at 50 steps for that reason
(and for resets of tasks that never terminate).
"""

import dataclasses
import functools
import warnings
from typing import Any, NamedTuple

import gymnasium
import jax
import numpy as np
import tyro
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from mjx_reinforce import VectorEnv, envs, make_vec
from mjx_reinforce.console.jax_setup import configure_jax

TASKS = tuple(id for id in envs.names() if id.endswith("-v5"))


@dataclasses.dataclass(frozen=True)
class Settings:
    """Compares vectorized environments."""

    envs: tuple[str, ...] = TASKS
    """The tasks."""
    num_envs: int = 8
    """Environments on each side."""
    steps: int = 200
    """Steps of each."""
    limit: int = 50
    """Steps of an episode at most."""


class Difference(NamedTuple):
    """How far the two sides were apart at most.

    observation, reward, final: of observations, rewards and last observations
    flags: steps in which they disagreed about an end
    ends: episodes that ended
    """

    observation: float
    reward: float
    final: float
    flags: int
    ends: int


class GymnasiumSide:
    """Gymnasium's own vector environment, whose resets take the states that ours drew."""

    def __init__(self, env_id: str, num: int, limit: int, autoreset: str):
        self._starts: list[Any] = [None] * num
        self.envs = SyncVectorEnv(
            [functools.partial(self._one, env_id, i, limit) for i in range(num)],
            autoreset_mode=AutoresetMode[autoreset.upper()],
        )

    def _one(self, env_id: str, i: int, limit: int) -> gymnasium.Env:
        env = gymnasium.make(env_id, max_episode_steps=limit)
        inner: Any = env.unwrapped

        def reset_model() -> Any:
            inner.set_state(*self._starts[i])
            if hasattr(inner, "goal"):  # Reacher and Pusher draw it into qpos
                inner.goal = self._starts[i][0][-2:]
            return inner._get_obs()

        inner.reset_model = reset_model
        return env

    def take(self, physics: Any) -> None:
        """Takes positions and velocities [N, ...] for the resets of the next step."""
        rows = zip(np.asarray(physics.qpos), np.asarray(physics.qvel), strict=True)
        self._starts = list(rows)


def compare(vec: VectorEnv, peer: GymnasiumSide, steps: int) -> Difference:
    """Plays the same random actions on both sides; call it with jax_enable_x64."""
    step = jax.jit(vec.step)
    state = jax.jit(vec.reset)(jax.random.key(0))
    peer.take(state.simulation.pipeline_state)
    found = [_apart(state.obs, peer.envs.reset()[0]), 0.0, 0.0]
    flags = ends = 0
    for t in range(steps):
        action = np.asarray(vec.sample_actions(jax.random.key(t + 1)))
        state = step(state, action)
        peer.take(state.simulation.pipeline_state)
        obs, reward, terminated, truncated, info = peer.envs.step(action)
        wrong = (state.terminated != terminated) | (state.truncated != truncated)
        flags, ends = flags + int(wrong.sum()), ends + int(state.done.sum())
        rows = np.flatnonzero(info.get("_final_obs", np.zeros(vec.num_envs, bool)))
        final = [_apart(state.final_obs[i], info["final_obs"][i]) for i in rows]
        apart = _apart(state.obs, obs), _apart(state.reward, reward), max(final, default=0.0)
        found = list(map(max, found, apart))
    return Difference(found[0], found[1], found[2], flags, ends)


def _apart(x: Any, y: Any) -> float:
    return float(np.max(np.abs(np.asarray(x) - np.asarray(y))))


def main(settings: Settings) -> None:
    """Prints a row a task and mode."""
    configure_jax()
    warnings.simplefilter("ignore")
    print("| task | autoreset | observation | reward | last observation | flags | ends |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    with jax.enable_x64(True):
        for env_id in settings.envs:
            for autoreset in ("next_step", "same_step"):
                vec = make_vec(
                    env_id, settings.num_envs, autoreset=autoreset, max_episode_steps=settings.limit
                )
                peer = GymnasiumSide(env_id, settings.num_envs, settings.limit, autoreset)
                d = compare(vec, peer, settings.steps)
                print(
                    f"| {env_id} | {autoreset} | {d.observation:.1e} | {d.reward:.1e} | "
                    f"{d.final:.1e} | {d.flags} | {d.ends} |",
                    flush=True,
                )


if __name__ == "__main__":
    main(tyro.cli(Settings))
