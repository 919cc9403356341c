"""Stable-Baselines3's PPO on its own vector environment of Gymnasium's, and on ours."""

import time
from typing import Any

import numpy as np
import torch  # pyright: ignore[reportMissingImports]
from stable_baselines3 import PPO  # pyright: ignore[reportMissingImports]
from stable_baselines3.common.callbacks import BaseCallback  # pyright: ignore
from stable_baselines3.common.env_util import make_vec_env  # pyright: ignore
from stable_baselines3.common.vec_env import VecNormalize  # pyright: ignore

from experiments.kit.rows import words
from experiments.speed.trainers.sides import Trained
from mjx_reinforce.vector import for_stable_baselines3


def train(
    side: str, task: str, num_envs: int, seed: int, env_steps: int, *, rollout: int
) -> Trained:
    """Trains with its default settings, and with ``VecNormalize``, as its zoo does on these tasks.

    Args:
      side: a key of ``SIDES``.
      task: an id of Gymnasium.
      num_envs: N.
      seed: of all that is random.
      env_steps: of the training.
      rollout: env steps between updates, of all environments together, 2,048 by default; an epoch
        has 32 minibatches.
    """
    torch.set_num_threads(1)
    began = time.perf_counter()
    made: Any = make_vec_env if side == "gymnasium" else for_stable_baselines3.make
    inner = made(task, num_envs)
    inner.reset()
    inner.step(np.zeros((num_envs, *inner.action_space.shape), np.float32))
    start_seconds = time.perf_counter() - began
    arguments = {"n_steps": rollout // num_envs, "batch_size": rollout // 32}
    env = VecNormalize(inner)
    model = PPO("MlpPolicy", env, seed=seed, device="cpu", **arguments)
    episodes = _Episodes()
    began, cpu = time.perf_counter(), time.process_time()
    model.learn(env_steps, callback=episodes)
    seconds, cpu = time.perf_counter() - began, time.process_time() - cpu
    env.close()
    settings = words(arguments)
    return Trained(episodes.returns, start_seconds, seconds, cpu, model.num_timesteps, settings)


class _Episodes(BaseCallback):
    """Keeps the return of every episode, as the infos tell it."""

    def __init__(self):
        super().__init__()
        self.returns: list[float] = []

    def _on_step(self) -> bool:
        for i in np.flatnonzero(self.locals["dones"]):
            self.returns.append(self.locals["infos"][i]["episode"]["r"])
        return True
