"""What a user would otherwise pick, as far as it is installed here, for `benchmark.py` to time."""

import importlib.util
import os
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from mjx_reinforce import envs


class Candidate(NamedTuple):
    """Something to time.

    row: what the table says of it so far
    run: plays once and waits for the end
    env_steps: how many env steps that is
    """

    row: dict[str, Any]
    run: Callable[[], Any]
    env_steps: int


def peers(env_id: str, quick: bool) -> list[Candidate]:
    """C MuJoCo on all threads and, where installed, Gymnasium's vector env."""
    candidates = []
    if hasattr(envs.make(env_id), "mj_model"):
        candidates.append(c_mujoco(env_id))
    if quick:
        return candidates
    if importlib.util.find_spec("gymnasium") and _in_gymnasium(env_id):
        candidates.append(gymnasium_vector(env_id))
    return candidates


def c_mujoco(env_id: str, batch: int = 1024, steps: int = 20) -> Candidate:
    """``mujoco.rollout`` under random actions, for as long as a pendulum takes to fall."""
    from mujoco import MjData, mj_getState, mj_stateSize, mjtState, rollout  # type: ignore

    env = envs.make(env_id)
    model, threads = env.mj_model, os.cpu_count() or 1
    full = mjtState.mjSTATE_FULLPHYSICS
    start = np.empty(mj_stateSize(model, full))
    mj_getState(model, MjData(model), start, full)
    data = [MjData(model) for _ in range(threads)]
    low, high = env.action_space
    control = np.random.default_rng(0).uniform(low, high, (batch, steps, model.nu))
    control = np.repeat(control, env.frame_skip, axis=1)
    pool = rollout.Rollout(nthread=threads)

    def run():
        pool.rollout(model, data, np.tile(start, (batch, 1)), control)

    row = {"what": "rollout", "engine": f"C MuJoCo, {threads} threads", "env": env_id}
    row |= {"batch": batch, "device": "cpu", "frame_skip": env.frame_skip}
    return Candidate(row, run, batch * steps)


def gymnasium_vector(env_id: str, batch: int = 8, steps: int = 200) -> Candidate:
    """Gymnasium's synchronous vector environment under random actions."""
    import gymnasium

    env = gymnasium.make_vec(env_id, num_envs=batch, vectorization_mode="sync")
    env.reset(seed=0)
    actions = [env.action_space.sample() for _ in range(steps)]

    def run():
        for action in actions:
            env.step(action)

    row = {"what": "rollout", "engine": "Gymnasium vector", "env": env_id, "batch": batch}
    frame_skip = getattr(envs.make(env_id), "frame_skip", 1)
    row |= {"device": "cpu", "frame_skip": frame_skip}
    return Candidate(row, run, batch * steps)


def _in_gymnasium(env_id: str) -> bool:
    import gymnasium

    return env_id in gymnasium.registry
