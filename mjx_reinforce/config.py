"""The settings of a training run, as the command line and config.json show them."""

import dataclasses
import math
from pathlib import Path
from typing import Any, Literal

from mjx_reinforce import envs
from mjx_reinforce.registry import DISTRIBUTIONS, ESTIMATORS, check_name


@dataclasses.dataclass(frozen=True)
class Config:
    """Train policies by REINFORCE, many seeds at once, and report over the seeds."""

    env: str = "InvertedPendulum-v5"
    """Environment id; `python -m mjx_reinforce.envs` lists them."""
    num_seeds: int = 4
    """How many independent seeds are trained together, in one compiled program."""
    seed: int = 0
    """Root of all randomness; the seeds' keys are split from it."""
    env_steps: int = 280_000
    """Training budget of each seed in env steps; it stops after the update that reaches it."""
    max_updates: int | None = None
    """Stop all seeds after this many updates, to the next evaluation, whatever their env steps."""
    num_episodes: int = 16
    """Complete episodes played for one update, for each seed."""
    horizon: int | None = None
    """Steps after which an episode ends; the environment's own limit if not given."""

    engine: Literal["auto", "mjx", "fused", "kernel"] = "auto"
    """How episodes are played: mjx (plain jax.vmap), fused (the step written out), kernel (all in
    one GPU kernel), or the fastest of them here."""

    policy: str = "normal"
    """Action distribution: normal (one trained std) or normal-softplus (std from the state)."""
    hidden_sizes: tuple[int, ...] = (32, 32)
    """Units of the policy network's tanh layers."""
    initial_std: float = 0.5
    """Standard deviation of the actions before training, in the action's unit."""

    estimator: str = "leave-one-out"
    """Weight of each log-probability: total-return, reward-to-go, leave-one-out, value-baseline."""
    discount: float = 0.99
    """Discount of rewards, in [0, 1]."""
    discount_weights: bool = False
    """Multiply the weight at step t by discount^t, which most programs leave out."""
    standardize: bool = True
    """Divide the weights by their standard deviation plus the floor below."""
    standardize_floor: float = 10.0
    """Added to that standard deviation, in units of return."""
    entropy_cost: float = 0.0
    """Weight of the policy's entropy in the objective."""
    loss_per: Literal["episode", "step"] = "episode"
    """Average the gradient over episodes (the definition) or over steps."""
    normalize_steps: int = 1000
    """Scale observations by the statistics of about the first so many steps; 0 does not."""

    learning_rate: float = 1e-2
    """Adam's learning rate at the start."""
    final_learning_rate: float = 1e-3
    """Learning rate after the decay, which is linear."""
    decay_updates: int = 100
    """Updates over which the learning rate decays."""
    max_grad_norm: float = 1.0
    """The gradient is scaled down to at most this Euclidean norm."""

    eval_every: int = 5
    """Updates between evaluations."""
    eval_episodes: int = 16
    """Episodes of an evaluation, with the mode and as many with samples; the starts are fixed."""
    eval_seed: int = 0
    """Root of the evaluation's keys, apart from all training keys whatever its value."""

    output: Path | None = None
    """Run directory; runs/<env>-<time> if not given."""
    overwrite: bool = False
    """Write into an output directory that is not empty, replacing a run's files there."""


def check(config: Config) -> None:
    """Raises ValueError for settings that make no sense: what, the value, the remedy."""
    check_name("environment", config.env, dict.fromkeys(envs.names()))
    check_name("policy", config.policy, DISTRIBUTIONS)
    check_name("estimator", config.estimator, ESTIMATORS)
    for name in ("num_seeds", "num_episodes", "env_steps", "decay_updates", "eval_every"):
        _require(config, name, lambda x: x >= 1, "at least 1")
    _require(config, "eval_episodes", lambda x: x >= 1, "at least 1")
    _require(config, "max_updates", lambda x: x is None or x >= 1, "at least 1")
    _require(config, "horizon", lambda x: x is None or x >= 1, "at least 1")
    _require(config, "normalize_steps", lambda x: x >= 0, "at least 0")
    _require(config, "env_steps", lambda x: x < 2**30, "less than 2^30, for each seed")
    for name in ("seed", "eval_seed"):
        _require(config, name, lambda x: 0 <= x < 2**32, "in [0, 2^32)")
    _require(config, "discount", lambda x: 0 <= x <= 1, "in [0, 1]")
    _require(config, "hidden_sizes", lambda x: all(n >= 1 for n in x), "positive in every layer")
    for name in ("initial_std", "learning_rate", "final_learning_rate", "max_grad_norm"):
        _require(config, name, lambda x: math.isfinite(x) and x > 0, "positive and finite")
    for name in ("standardize_floor", "entropy_cost"):
        _require(config, name, lambda x: math.isfinite(x) and x >= 0, "finite and not negative")
    if config.estimator == "leave-one-out" and config.num_episodes < 2:
        raise ValueError(
            f"leave-one-out needs at least two episodes an update, got --num-episodes "
            f"{config.num_episodes}; raise it or choose --estimator reward-to-go"
        )


def _require(config: Config, name: str, holds: Any, rule: str) -> None:
    """Raises ValueError unless a setting obeys a rule."""
    value = getattr(config, name)
    if not holds(value):
        raise ValueError(f"--{name.replace('_', '-')} must be {rule}, got {value}")
