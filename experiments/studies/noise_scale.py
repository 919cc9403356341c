"""How many episodes an update needs: the noise scale of the gradient, estimator by estimator.

    python -m experiments.studies.noise_scale --env Hopper-v5 --env-steps 300000 --num-episodes 512

trains a policy with the task's default settings, plays fresh episodes with it, and prints for each
estimator at how many episodes the noise of the mean gradient is as large as its signal (McCandlish
et al. 2018, arXiv:1812.06162, section 2.2 and appendix A.1; docs/statistics.md). A learned value is
fitted to as many other episodes first. ``--csv`` adds the rows to a file.
"""

import dataclasses
import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from jax.flatten_util import ravel_pytree
from rich.console import Console
from rich.table import Table

from experiments.kit import rows as kit
from mjx_reinforce import envs
from mjx_reinforce.console.jax_setup import configure_jax
from mjx_reinforce.learners.estimators import Estimator, leave_one_out, shift_rewards
from mjx_reinforce.learners.learner import Learner, TrainState
from mjx_reinforce.learners.value_baseline import value_baseline
from mjx_reinforce.policies import normalize
from mjx_reinforce.policies.policy import Policy
from mjx_reinforce.settings.config import Config
from mjx_reinforce.settings.defaults import of_task
from mjx_reinforce.store.build import build
from mjx_reinforce.types import Trajectory

#: Episodes whose gradients are computed at once.
_TOGETHER = 16
#: Half the width of a 95 % interval, in standard errors.
_WIDE = 1.96


@dataclasses.dataclass(frozen=True)
class Settings:
    """Measure the noise scale of the policy gradient."""

    env: str = "Hopper-v5"
    """Environment id."""
    env_steps: tuple[int, ...] = (0, 300_000)
    """After so many env steps of training; 0 is the untrained policy. In increasing order."""
    num_episodes: int = 512
    """Episodes from whose gradients the noise scale is measured; for the value, as many others."""
    discount: tuple[float, ...] = (1.0, 0.995, 0.99)
    """Discounts of the rewards."""
    reward_shift: tuple[float, ...] = (0.0, 1.0)
    """Subtracted from every reward, such as the bonus for staying alive (5 for Humanoid)."""
    value_fits: int = 600
    """Gradient steps of the value network."""
    value_batch_size: int = 512
    """Steps a minibatch."""
    seed: int = 0
    """Root of all randomness."""
    csv: Path | None = None
    """A file that gets the rows; one that exists goes on."""


class NoiseScale(NamedTuple):
    """What the gradients of N episodes say.

    signal: an estimate of |E g|^2
    noise: an estimate of tr Cov(g), of a single episode
    ratio: signal / noise, one over the noise scale
    error: the standard error of the ratio
    half_cosine: cosine of the angle between the mean gradients of both halves
    """

    signal: float
    noise: float
    ratio: float
    error: float
    half_cosine: float

    @property
    def episodes(self) -> float:
        """Episodes at which noise and signal are equal; infinite where no signal is seen."""
        return _inverse(self.ratio)

    @property
    def interval(self) -> tuple[float, float]:
        """A 95 % interval for them."""
        return _inverse(self.ratio + _WIDE * self.error), _inverse(self.ratio - _WIDE * self.error)


def noise_scale(gradients: np.ndarray) -> NoiseScale:
    """Returns the noise scale of gradients [N, P] that are independent and alike, N at least 3.

    With K = g g', |E g|^2 is the mean of K over pairs of two different episodes, and tr Cov(g) that
    of its diagonal less that: both are unbiased. The standard error of their ratio is the
    jackknife's (Efron and Tibshirani 1993, chapter 11), over episodes.
    """
    count = len(gradients)
    products = gradients @ gradients.T
    own = np.diag(products)
    across = products.sum() - own.sum()
    signal = across / (count * (count - 1))
    noise = own.mean() - signal
    left_signal = (across - 2 * (products.sum(axis=1) - own)) / ((count - 1) * (count - 2))
    left_ratio = left_signal / ((own.sum() - own) / (count - 1) - left_signal)
    error = np.sqrt((count - 1) * np.var(left_ratio))
    halves = [half.mean(axis=0) for half in np.array_split(gradients, 2)]
    cosine = halves[0] @ halves[1] / np.prod([np.linalg.norm(half) for half in halves])
    return NoiseScale(signal, noise, signal / noise, float(error), float(cosine))


def episode_gradients(
    policy: Policy, params: Any, trajectory: Trajectory, weight: jax.Array
) -> np.ndarray:
    """Returns the gradient of sum_t weight log pi of each episode, [N, P], in float64.

    Args:
      policy: the policy.
      params: its parameters.
      trajectory: N episodes, their observations normalised.
      weight: [T, N]
    """

    def one(episode):
        observation, action, weight = episode

        def surrogate(params):
            log_prob = policy.distribution.log_prob(policy.apply(params, observation), action)
            return jnp.sum(jnp.where(weight != 0, weight * log_prob, 0.0))

        return ravel_pytree(jax.grad(surrogate)(params))[0]

    episodes = (trajectory.observation, trajectory.action, weight)
    first = jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), episodes)
    return np.asarray(_map(one, first), np.float64)


def _map(function: Any, data: Any) -> jax.Array:
    return jax.jit(lambda data: jax.lax.map(function, data, batch_size=_TOGETHER))(data)


def estimators(settings: Settings, horizon: int) -> Iterator[tuple[dict[str, Any], Estimator]]:
    """Yields what names an estimator in the table, and the estimator."""
    for discount, shift in itertools.product(settings.discount, settings.reward_shift):
        made = {
            "leave-one-out": leave_one_out(discount),
            "of those alive": leave_one_out(discount, ended="skip"),
            "V(o, t)": value_baseline(
                discount,
                horizon=horizon,
                num_fits=settings.value_fits,
                batch_size=settings.value_batch_size,
            ),
        }
        for name, estimator in made.items():
            shifted = shift_rewards(estimator, shift) if shift else estimator
            yield {"estimator": name, "discount": discount, "reward_shift": shift}, shifted


def measure(
    settings: Settings, learner: Learner, state: TrainState, key: jax.Array, horizon: int
) -> Iterator[dict[str, Any]]:
    """Yields a row for each estimator at one policy; ``learner`` plays the episodes."""
    play = jax.jit(learner.play)
    others, fresh = (_normalised(state, play(state, k)) for k in jax.random.split(key))
    length = float(jnp.sum(fresh.mask) / jnp.sum(fresh.mask[0]))
    shared = {
        "episodes": settings.num_episodes,
        "return": float(jnp.sum(fresh.reward) / jnp.sum(fresh.mask[0])),
        "length": length,
    }
    for name, estimator in estimators(settings, horizon):
        update = jax.jit(estimator.update)
        critic = estimator.init(jax.random.key(settings.seed), fresh.observation.shape[-1])
        # What an estimator learns it learns of the other episodes.
        weight, _, metrics = update(update(critic, others)[1], fresh)
        each = episode_gradients(learner.policy, state.actor.params, fresh, weight)
        found = noise_scale(each[np.asarray(fresh.mask[0])])
        low, high = found.interval
        yield (
            shared
            | name
            | {
                "explained_variance": float(metrics["explained_variance"]),
                "noise_scale": found.episodes,
                "low": low,
                "high": high,
                "noise_scale_env_steps": found.episodes * length,
                "half_cosine": found.half_cosine,
            }
        )


def _normalised(state: TrainState, trajectory: Trajectory) -> Trajectory:
    seen = normalize.apply(state.actor.normalizer, trajectory.observation)
    return dataclasses.replace(trajectory, observation=seen)


def rows(settings: Settings) -> Iterator[dict[str, Any]]:
    """Trains, and yields the rows of every point in training."""
    if settings.num_episodes < 4:
        raise ValueError(f"--num-episodes must be at least 4, got {settings.num_episodes}")
    env, config = envs.make(settings.env), _config(settings.env)
    trained, horizon = build(env, config)
    measured, _ = build(env, dataclasses.replace(config, num_episodes=settings.num_episodes))
    state = jax.jit(trained.init)(jax.random.key(settings.seed))
    step, played = jax.jit(lambda state: trained.step(state)), 0
    for point, env_steps in enumerate(settings.env_steps):
        while played < env_steps:
            state, metrics = step(state)
            played += int(metrics["env_steps"])
        where = {"env": settings.env, "env_steps": played, "device": jax.devices()[0].device_kind}
        key = jax.random.fold_in(jax.random.key(settings.seed + 1), point)
        for row in measure(settings, measured, state, key, horizon):
            yield where | row


def _config(env: str) -> Config:
    return dataclasses.replace(of_task(env), num_seeds=1)


def _inverse(ratio: float) -> float:
    return 1 / ratio if ratio > 0 else float("inf")


def main(settings: Settings) -> None:
    """Prints the table, and writes the rows as they come."""
    configure_jax()
    table = Table(title="Episodes at which the gradient's noise equals its signal")
    columns = ("trained", "estimator", "discount", "shift")
    for name in (*columns, "episodes (95 %)", "env steps", "half cosine"):
        left = "left" if name == "estimator" else "right"
        table.add_column(name, justify=left, no_wrap=name == "estimator")
    for row in rows(settings):
        if settings.csv is not None:
            kit.append(settings.csv, [kit.rounded(row, 6)], list(row))
        table.add_row(
            f"{row['env_steps']:,}",
            row["estimator"],
            f"{row['discount']:g}",
            f"{row['reward_shift']:g}",
            f"{row['noise_scale']:,.0f} ({row['low']:,.0f} to {row['high']:,.0f})",
            f"{row['noise_scale_env_steps']:,.0f}",
            f"{row['half_cosine']:.2f}",
        )
    Console().print(table)


if __name__ == "__main__":
    main(tyro.cli(Settings))
