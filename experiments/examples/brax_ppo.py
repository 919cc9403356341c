r"""brax's PPO on the engine: brax's own training, with our step in place of its wrappers.

    python experiments/examples/brax_ppo.py                                # HalfCheetah
    python experiments/examples/brax_ppo.py --env InvertedPendulum-v5 --env-steps 400000
    python experiments/examples/brax_ppo.py --num-envs 2048 --batch-size 512 --env-steps 50000000

The last line is for a GPU. The settings are those of brax's notebook for its halfcheetah, with
fewer environments and smaller batches.
"""

import dataclasses
import functools
import time
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import tyro
from brax.training.agents.ppo import networks
from brax.training.agents.ppo import train as ppo

from mjx_reinforce import envs


@dataclasses.dataclass(frozen=True)
class Settings:
    """Trains a policy by brax's PPO, and says what it earns."""

    env: str = "HalfCheetah-v5"
    """The task."""
    seed: int = 0
    """Of the networks, the episodes, and the noise."""
    env_steps: int = 3_000_000
    """Training budget."""
    num_envs: int = 128
    """Environments that play at once, and episodes of an evaluation."""
    batch_size: int = 128
    """Segments of a gradient step."""
    reports: int = 6
    """How often the policy is evaluated."""


def main(settings: Settings) -> None:
    """Trains, and prints a line an evaluation; seconds include compiling and evaluations."""
    if not hasattr(jax, "device_put_replicated"):  # brax 0.14.2 calls it; JAX 0.10 has none
        jax.device_put_replicated = _replicated  # pyright: ignore[reportAttributeAccessIssue]
    env = envs.make(settings.env)
    began = time.perf_counter()

    def report(steps: int, metrics: Mapping[str, Any]) -> None:
        seconds = time.perf_counter() - began
        earned = float(metrics["eval/episode_reward"])
        print(f"{steps:>11,} steps  {seconds:6.1f} s  return {earned:8.1f}", flush=True)

    ppo.train(
        env,
        wrap_env_fn=envs.for_brax,
        episode_length=env.max_episode_steps,
        num_timesteps=settings.env_steps,
        num_evals=settings.reports + 1,
        num_envs=settings.num_envs,
        num_eval_envs=settings.num_envs,
        deterministic_eval=True,
        batch_size=settings.batch_size,
        num_minibatches=16,
        unroll_length=20,
        num_updates_per_batch=8,
        learning_rate=3e-4,
        discounting=0.97,
        entropy_cost=1e-3,
        normalize_observations=True,
        network_factory=functools.partial(
            networks.make_ppo_networks,
            policy_hidden_layer_sizes=(64, 64),
            value_hidden_layer_sizes=(64, 64),
        ),
        seed=settings.seed,
        progress_fn=report,
    )


def _replicated(tree: Any, devices: Sequence[Any]) -> Any:
    """Returns a tree with an axis of devices before all others, of one device."""
    return jax.tree.map(lambda x: jnp.stack([x] * len(devices)), tree)


if __name__ == "__main__":
    main(tyro.cli(Settings))
