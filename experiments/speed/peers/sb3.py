"""Stable-Baselines3's PPO and SAC on Gymnasium's tasks, for so many seconds on so many cores."""

import os
from collections.abc import Callable, Sequence
from typing import Any

import gymnasium
import numpy as np
import stable_baselines3  # pyright: ignore[reportMissingImports]
import torch  # pyright: ignore[reportMissingImports]
from stable_baselines3.common.callbacks import BaseCallback  # pyright: ignore
from stable_baselines3.common.env_util import make_vec_env  # pyright: ignore
from stable_baselines3.common.vec_env import VecNormalize  # pyright: ignore

from experiments.kit.rows import words
from experiments.speed.peers import rows
from experiments.speed.peers.clock import Budgets, Clock
from experiments.speed.peers.settings import Sb3, sb3

#: More env steps than any budget in seconds allows. The zoo's learning rates here do not fall.
_ENDLESS = 10**12
#: The first start of an evaluation; training's seeds are far smaller.
_EVALUATION = 1_000_000


def pin(cores: int) -> None:
    """Keeps this process, and PyTorch's threads, on so many of the cores that it may use.

    Raises:
      ValueError: there are fewer.
    """
    usable = sorted(os.sched_getaffinity(0))
    if not 1 <= cores <= len(usable):
        raise ValueError(f"--cores is {cores}; this process may use 1 to {len(usable)}")
    os.sched_setaffinity(0, usable[:cores])
    torch.set_num_threads(cores)


def facts() -> dict[str, Any]:
    """Returns what all rows of Stable-Baselines3 say."""
    import mujoco

    versions = {"torch": torch.__version__, "numpy": np.__version__}
    return {
        "device": f"cpu, {torch.get_num_threads()} threads",
        "version": stable_baselines3.__version__,
        "libraries": words(versions),
        "environment": f"gymnasium {gymnasium.__version__}, mujoco {mujoco.__version__}",
    }


def train(
    algorithm: str,
    task: str,
    seed: int,
    seconds: Sequence[float],
    episodes: int,
    report: Callable[[dict[str, Any]], None],
) -> None:
    """Trains until the last budget is used up; building the networks does not count.

    Args:
      algorithm: "PPO" or "SAC".
      task: an id of Gymnasium.
      seed: of all that is random in training.
      seconds: budgets of training (s).
      episodes: of an evaluation, on starts of their own.
      report: is called with what a row says, at each budget.
    """
    settings = sb3(algorithm, task)
    env: Any = make_vec_env(task, n_envs=settings.num_envs, seed=seed)
    if settings.normalize:
        env = VecNormalize(env, gamma=settings.arguments.get("gamma", 0.99))
    model = getattr(stable_baselines3, algorithm)(
        "MlpPolicy",
        env,
        seed=seed,
        device="cpu",
        policy_kwargs=_policy(settings),
        **settings.arguments,
    )

    def act(observation: np.ndarray) -> np.ndarray:
        seen = env.normalize_obs(observation) if settings.normalize else observation
        return model.predict(seen, deterministic=True)[0]

    said = {"num_envs": settings.num_envs, "normalize": settings.normalize}
    said |= {**settings.arguments, **settings.policy}

    def evaluated(budget: float, spent: float) -> None:
        returns = play(task, act, episodes, _EVALUATION + seed * episodes)
        row = rows.result(budget, spent, model.num_timesteps, returns)
        report(row | {"settings": words(said), "source": settings.source})

    try:
        model.learn(_ENDLESS, callback=_Timed(Budgets(seconds), evaluated))
    finally:
        env.close()


def play(
    task: str, act: Callable[[np.ndarray], np.ndarray], episodes: int, seed: int
) -> np.ndarray:
    """Returns the return of each of so many episodes [E], from the starts ``seed``, ``seed + 1``...

    Args:
      task: an id of Gymnasium.
      act: from observations [E, O] to actions [E, A].
      episodes: how many, E.
      seed: of the first.
    """
    env = gymnasium.make_vec(task, num_envs=episodes, vectorization_mode="sync")
    observation, _ = env.reset(seed=seed)
    returns, running = np.zeros(episodes), np.ones(episodes, bool)
    while running.any():
        observation, reward, terminated, truncated, _ = env.step(act(observation))
        returns += np.where(running, reward, 0)
        running &= ~(terminated | truncated)
    env.close()
    return returns


def _policy(settings: Sb3) -> dict[str, Any]:
    """Returns ``policy_kwargs``, the activation as PyTorch's class."""
    policy = dict(settings.policy)
    if "activation_fn" in policy:
        policy["activation_fn"] = getattr(torch.nn, policy["activation_fn"])
    return policy


class _Timed(BaseCallback):
    """Evaluates at each budget, with the clock stopped, and ends training after the last."""

    def __init__(self, budgets: Budgets, evaluated: Callable[[float, float], None]):
        super().__init__()
        self.budgets, self.evaluated = budgets, evaluated

    def _on_training_start(self) -> None:
        self.clock = Clock()

    def _on_step(self) -> bool:
        seconds = self.clock.seconds
        for budget in self.budgets.due(seconds):
            with self.clock.paused():
                self.evaluated(budget, seconds)
        return not self.budgets.spent
