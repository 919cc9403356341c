"""Stable-Baselines3's PPO on its own vector environment of Gymnasium's, and on ours."""

import time
from typing import Any

import numpy as np
import torch  # pyright: ignore[reportMissingImports]
from stable_baselines3 import PPO  # pyright: ignore[reportMissingImports]
from stable_baselines3.common.callbacks import BaseCallback  # pyright: ignore
from stable_baselines3.common.env_util import make_vec_env  # pyright: ignore
from stable_baselines3.common.vec_env import VecNormalize  # pyright: ignore

import peers_rows
from mjx_reinforce.vector import for_stable_baselines3
from peers_settings import sb3
from trainers_sides import Trained


def train(
    side: str, task: str, num_envs: int, seed: int, env_steps: int, *, rollout: int
) -> Trained:
    """Trains with the zoo's settings, whose rollout is split over the environments.

    Args:
      side: a key of ``SIDES``.
      task: an id of Gymnasium.
      num_envs: N.
      seed: of all that is random.
      env_steps: of the training.
      rollout: env steps between updates, of all environments together; where it is larger than the
        zoo's, minibatches grow with it, so that their number stays.
    """
    torch.set_num_threads(1)
    zoo = sb3("PPO", task)
    began = time.perf_counter()
    made: Any = make_vec_env if side == "gymnasium" else for_stable_baselines3.make
    inner = made(task, num_envs)
    inner.reset()
    inner.step(np.zeros((num_envs, *inner.action_space.shape), np.float32))
    start_seconds = time.perf_counter() - began
    arguments = dict(zoo.arguments)
    share = rollout / (arguments["n_steps"] * zoo.num_envs)
    arguments["n_steps"] = rollout // num_envs
    arguments["batch_size"] = int(arguments["batch_size"] * share)
    policy = dict(zoo.policy)
    if "activation_fn" in policy:
        policy["activation_fn"] = getattr(torch.nn, policy["activation_fn"])
    env = VecNormalize(inner, gamma=arguments["gamma"])
    model = PPO("MlpPolicy", env, seed=seed, device="cpu", policy_kwargs=policy, **arguments)
    episodes = _Episodes()
    began, cpu = time.perf_counter(), time.process_time()
    model.learn(env_steps, callback=episodes)
    seconds, cpu = time.perf_counter() - began, time.process_time() - cpu
    env.close()
    settings = peers_rows.words({**arguments, **zoo.policy})
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
