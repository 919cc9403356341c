"""What a user would otherwise pick, as far as it is installed here, for `benchmark.py` to time."""

import importlib.util
import os
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np

from mjx_reinforce import envs

#: Worlds that MuJoCo Warp simulates at once.
WARP_WORLDS = (8192, 32768)


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
    """C MuJoCo on all threads; where it can run, MuJoCo Warp and Gymnasium's vector env."""
    candidates = []
    if hasattr(envs.make(env_id), "mj_model"):
        candidates.append(c_mujoco(env_id))
        if importlib.util.find_spec("warp") and jax.default_backend() == "gpu":
            candidates += [mujoco_warp(env_id, batch) for batch in WARP_WORLDS]
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


def mujoco_warp(env_id: str, batch: int, steps: int = 20) -> Candidate:
    """MuJoCo Warp under constant random actions: no policy, no noise, nothing recorded.

    Its worlds have gone through fifty steps before, so that what falls has come to contacts.
    """
    import warp  # pyright: ignore
    from mujoco import MjData, mj_forward  # type: ignore
    from mujoco.mjx.third_party import mujoco_warp  # pyright: ignore

    env = envs.make(env_id)
    model = env.mj_model
    data = MjData(model)
    mj_forward(model, data)
    started = time.perf_counter()
    on_gpu = mujoco_warp.put_model(model)
    worlds = mujoco_warp.put_data(model, data, nworld=batch, nconmax=64, njmax=256)
    low, high = env.action_space
    control = np.random.default_rng(0).uniform(low, high, (batch, model.nu))
    worlds.ctrl.assign(control.astype(np.float32))

    def play(count):
        for _ in range(count * env.frame_skip):
            mujoco_warp.step(on_gpu, worlds)

    play(1)  # compiles
    with warp.ScopedCapture() as capture:
        play(1)
    for _ in range(50):
        warp.capture_launch(capture.graph)
    warp.synchronize()

    kept = on_gpu, worlds  # the graph has their addresses alone

    def run(kept=kept):
        for _ in range(steps):
            warp.capture_launch(capture.graph)
        warp.synchronize()

    row = {"what": "rollout", "engine": "MuJoCo Warp", "env": env_id, "batch": batch}
    row |= {"device": warp.get_device().name, "frame_skip": env.frame_skip}
    row["compile_seconds"] = time.perf_counter() - started
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
