r"""RSL-RL's PPO on the engine: its own runner, with our environments as its ``VecEnv``.

    pip install 'mjx-reinforce[rsl-rl]'
    python experiments/examples/rsl_rl_ppo.py                              # HalfCheetah
    python experiments/examples/rsl_rl_ppo.py --env InvertedPendulum-v5 --iterations 60
    XLA_PYTHON_CLIENT_PREALLOCATE=false python experiments/examples/rsl_rl_ppo.py --num-envs 4096

The last line is for a GPU, whose memory JAX would take from torch. The settings of the algorithm
are those that robots of legs are trained with, but for the noise, which begins at 0.6.
"""

import copy
import dataclasses
import time
from typing import Any

import torch  # pyright: ignore[reportMissingImports]
import tyro
from rsl_rl.runners import OnPolicyRunner  # pyright: ignore[reportMissingImports]

from mjx_reinforce import make_vec
from mjx_reinforce.engine.vector.for_torch import TorchVectorEnv


@dataclasses.dataclass(frozen=True)
class Settings:
    """Trains a policy by RSL-RL's PPO, and says what it earns."""

    env: str = "HalfCheetah-v5"
    """The task."""
    seed: int = 0
    """Of the networks, the episodes, and the noise."""
    iterations: int = 200
    """Updates."""
    num_envs: int = 256
    """Environments that play at once, and episodes of an evaluation."""
    num_steps: int = 64
    """Steps of each environment between two updates."""
    reports: int = 4
    """How often the policy is evaluated."""


def training(settings: Settings) -> dict[str, Any]:
    """Returns the settings of the runner."""
    model = {
        "class_name": "MLPModel",
        "hidden_dims": [64, 64],
        "activation": "elu",
        "obs_normalization": True,
    }
    noise = {"class_name": "GaussianDistribution", "init_std": 0.6, "std_type": "log"}
    return {
        "seed": settings.seed,
        "num_steps_per_env": settings.num_steps,
        "save_interval": 1_000_000,
        "obs_groups": {"actor": ["policy"], "critic": ["policy"]},
        "actor": model | {"distribution_cfg": noise},
        "critic": model,
        "algorithm": {
            "class_name": "PPO",
            "num_learning_epochs": 5,
            "num_mini_batches": 4,
            "gamma": 0.99,
            "lam": 0.95,
            "entropy_coef": 0.0,
            "desired_kl": 0.01,
            "schedule": "adaptive",
        },
    }


def evaluate(env: TorchVectorEnv, policy: Any) -> float:
    """Returns the mean return of an episode in each environment, without noise."""
    observation, _ = env.reset(seed=1_000_000)
    total = torch.zeros(env.num_envs, device=env.device)
    running = torch.ones(env.num_envs, dtype=torch.bool, device=env.device)
    with torch.inference_mode():
        while running.any():
            observation, reward, done, _ = env.step(policy(observation))
            total += torch.where(running, reward, 0)
            running &= ~done
    return float(total.mean())


def main(settings: Settings) -> None:
    """Trains, and prints a line an evaluation; seconds are those of the training alone."""
    # Networks this small are slower with more threads, which wait for each other.
    torch.set_num_threads(1)
    torch.manual_seed(settings.seed)
    env = make_vec(settings.env, settings.num_envs, framework="torch")
    env.reset(settings.seed)
    # Its twin is evaluated on, so that the training's episodes go on.
    twin = copy.copy(env)
    device = str(env.device)
    runner = OnPolicyRunner(env, training(settings), device=device)
    seconds = 0.0
    block = -(-settings.iterations // settings.reports)
    for report in range(settings.reports + 1):
        if report:
            began = time.perf_counter()
            runner.learn(block, init_at_random_ep_len=report == 1)
            seconds += time.perf_counter() - began
        earned = evaluate(twin, runner.get_inference_policy(device))
        steps = report * block * settings.num_steps * settings.num_envs
        print(f"{steps:>11,} steps  {seconds:6.1f} s  return {earned:8.1f}", flush=True)


if __name__ == "__main__":
    main(tyro.cli(Settings))
