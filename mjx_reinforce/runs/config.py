"""The settings of a training run, as the command line and config.json show them.

One class a group of ``--help``; ``Config`` has all their fields side by side.
"""

import dataclasses
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

from mjx_reinforce import envs
from mjx_reinforce.registry import DISTRIBUTIONS, ESTIMATORS, check_name


@dataclasses.dataclass(frozen=True, kw_only=True)
class Run:
    """What is trained, for how long, and where it is written."""

    env: str = "InvertedPendulum-v5"
    """Environment id; `python -m mjx_reinforce.envs` lists them. Or module:Class for your own."""
    algorithm: Literal["reinforce", "ars"] = "reinforce"
    """reinforce follows the policy gradient; ars (augmented random search, Mania et al. 2018)
    tries out changes of the parameters, and reads its own group below besides this one."""
    num_seeds: int = 4
    """How many independent seeds are trained together, in one compiled program."""
    seed: int = 0
    """Root of all randomness; the seeds' keys are split from it."""
    env_steps: int | None = 280_000
    """Training budget of each seed in env steps; it stops after the update that reaches it.
    None leaves it to --max-updates."""
    max_updates: int | None = None
    """Stop every seed after this many updates; with --num-episodes 1, as many episodes."""
    stop_when_solved: bool = False
    """Stop once every seed's last evaluation reached the environment's reward threshold."""
    num_episodes: int = 16
    """Complete episodes played for one update, for each seed. (ars: see --num-directions.)"""
    horizon: int | None = None
    """Steps after which an episode ends; the environment's own limit if not given."""
    one_start: bool = False
    """Begin all training episodes of a seed in one state, each seed in its own. Evaluations keep
    their own starts, and show what such training knows of the others."""
    engine: Literal["auto", "vmap", "fused", "kernel"] = "auto"
    """How episodes are played: vmap (jax.vmap of the step), fused (the step written out), kernel (all in
    one GPU kernel), or the fastest of them here."""
    output: Path | None = None
    """Run directory; runs/<env>-<time> if not given."""
    overwrite: bool = False
    """Write into an output directory that is not empty, replacing a run's files there."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Policy:
    """The network and the distribution of its actions."""

    policy: str = "auto"
    """Action distribution: normal (one trained std), normal-softplus and normal-sigmoid (std from
    the state), truncated-normal, clipped-normal, tanh-normal (on the action bounds), categorical
    (discrete actions), deterministic (ars only); auto is categorical where the actions are
    discrete, else normal, or deterministic for ars."""
    hidden_sizes: tuple[int, ...] = (32, 32)
    """Units of the policy network's tanh layers; the flag alone makes it linear."""
    shared_trunk: bool = True
    """Compute means and stds in one network; else stds from the state have their own."""
    initializer: Literal["orthogonal", "torch"] = "orthogonal"
    """Initial weights: orthogonal, the last layer's scaled by 0.01, so that a fresh policy acts
    alike everywhere; or torch.nn.Linear's uniform ones."""
    initial_std: float = 0.5
    """Standard deviation of the actions before training, in the action's unit."""
    rescale: bool = True
    """Scale the network's output 1 to the end of the action's range; else it is the mean itself."""
    normalize_steps: int | None = 1000
    """Scale observations by the statistics of about the first so many steps; 0 does not, None
    goes on for ever."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Weights:
    """What multiplies the gradient of an action's log-probability (reinforce)."""

    estimator: str = "leave-one-out"
    """total-return; reward-to-go; leave-one-out (less that of the other episodes);
    value-baseline (less a learned value); and two that are published but odd: mean-log-prob,
    normalized-returns (their docstrings say how)."""
    discount: float = 0.99
    """Discount of rewards, in [0, 1]."""
    discount_weights: bool = False
    """Multiply the weight at step t by discount^t, which most programs leave out."""
    standardize: bool = True
    """Divide the weights by their standard deviation plus the floor below."""
    standardize_floor: float = 10.0
    """Added to that standard deviation, in units of return."""
    value_learning_rate: float = 3e-3
    """Adam's learning rate for the value network of value-baseline."""
    value_fits: int = 10
    """Its gradient steps an update, on the squared error over the rollout."""
    value_hidden_sizes: tuple[int, ...] = (64, 64)
    """Units of its tanh layers."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Updates:
    """How the gradient becomes changes of the parameters (reinforce)."""

    update: Literal["full-batch", "minibatches", "each-step"] = "full-batch"
    """full-batch: one optimiser step a rollout; minibatches: several, on steps drawn from it;
    each-step: one for every time step, in order."""
    minibatch_updates: int = 50
    """Optimiser steps a rollout, of minibatches."""
    minibatch_size: int = 128
    """Steps of the episodes a minibatch, drawn with replacement; their loss is averaged."""
    loss_per: Literal["episode", "step"] = "episode"
    """Average the gradient over episodes (the definition) or over steps."""
    entropy_cost: float = 0.0
    """Weight of the policy's entropy in the objective."""
    optimizer: Literal["adam", "adamw", "sgd"] = "adam"
    """What makes a step of a gradient."""
    learning_rate: float = 1e-2
    """Its learning rate at the start."""
    final_learning_rate: float | None = None
    """Learning rate after the decay, which is linear; a tenth of the first if not given."""
    decay_updates: int | None = 100
    """Updates over which the learning rate decays; None keeps it constant."""
    weight_decay: float = 0.0
    """adamw: the parameters shrink by learning rate times this; adam, sgd: this times the
    parameters is added to the gradient (L2, as in PyTorch)."""
    max_grad_norm: float | None = 1.0
    """The gradient is scaled down to at most this Euclidean norm; None leaves it."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Search:
    """Augmented random search (ars)."""

    num_directions: int = 8
    """Directions tried in an update, by an episode forwards and one backwards."""
    top_directions: int | None = None
    """How many of them count, those with the greatest returns; all if not given."""
    step_size: float = 0.02
    """Learning rate."""
    noise_std: float = 0.03
    """How far along a direction the policies are that are tried."""
    shared_starts: bool = False
    """Start the two episodes of a direction alike."""
    ars_update: Literal["paper", "document"] = "paper"
    """paper, or that of a published notebook with its mistakes."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Evaluation:
    """Playing the policies without training them."""

    eval_every: int = 5
    """Updates between evaluations."""
    eval_episodes: int = 16
    """Episodes of an evaluation, with the mode and as many with samples; the starts are fixed."""
    eval_seed: int = 0
    """Root of the evaluation's keys, apart from all training keys whatever its value."""


#: The groups of --help, in order, under their titles.
GROUPS = {
    "run": Run,
    "policy": Policy,
    "weights": Weights,
    "updates": Updates,
    "search": Search,
    "evaluation": Evaluation,
}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Config(Evaluation, Search, Updates, Weights, Policy, Run):
    """Train policies, many seeds at once, and report over the seeds."""

    @property
    def episodes_per_update(self) -> int:
        """Episodes that a seed plays for an update."""
        return self.num_episodes if self.algorithm == "reinforce" else 2 * self.num_directions


def check(config: Config) -> None:
    """Raises ValueError for settings that make no sense: what, the value, the remedy."""
    envs.check_id(config.env)
    check_name("policy", config.policy, {"auto": None} | DISTRIBUTIONS)
    check_name("estimator", config.estimator, ESTIMATORS)
    for names, holds, rule in _RULES:
        for name in names.split():
            value = getattr(config, name)
            if not ((value is None and name in _OPTIONAL) or holds(value)):
                raise ValueError(f"--{name.replace('_', '-')} must be {rule}, got {value}")
    if config.env_steps is None and config.max_updates is None:
        raise ValueError("nothing would end this run: give --env-steps or --max-updates a number")
    (_check_reinforce if config.algorithm == "reinforce" else _check_ars)(config)


_OPTIONAL = {field.name for field in dataclasses.fields(Config) if "None" in str(field.type)}

#: Names of settings, what must hold of a value that is given, and how to say it.
_RULES: tuple[tuple[str, Callable[[Any], bool], str], ...] = (
    (
        "num_seeds num_episodes env_steps max_updates horizon decay_updates eval_every "
        "eval_episodes value_fits minibatch_updates minibatch_size num_directions top_directions",
        lambda x: x >= 1,
        "at least 1",
    ),
    ("normalize_steps", lambda x: x >= 0, "at least 0"),
    ("env_steps", lambda x: x < 2**30, "less than 2^30, for each seed"),
    ("seed eval_seed", lambda x: 0 <= x < 2**32, "in [0, 2^32)"),
    ("discount", lambda x: 0 <= x <= 1, "in [0, 1]"),
    (
        "hidden_sizes value_hidden_sizes",
        lambda x: all(n >= 1 for n in x),
        "positive in every layer",
    ),
    (
        "initial_std learning_rate final_learning_rate max_grad_norm value_learning_rate "
        "step_size noise_std",
        lambda x: math.isfinite(x) and x > 0,
        "positive and finite",
    ),
    (
        "standardize_floor entropy_cost weight_decay",
        lambda x: math.isfinite(x) and x >= 0,
        "finite and not negative",
    ),
)


def _check_reinforce(config: Config) -> None:
    """Raises ValueError for settings that do not go together."""
    if config.estimator == "leave-one-out" and config.num_episodes < 2:
        raise ValueError(
            f"leave-one-out needs at least two episodes an update, got --num-episodes "
            f"{config.num_episodes}; raise it or choose --estimator reward-to-go"
        )
    if config.policy == "deterministic":
        raise ValueError(
            "--policy deterministic has no log-probability for --algorithm reinforce to follow; "
            "choose --policy auto or --algorithm ars"
        )
    if config.update == "each-step" and config.decay_updates is not None:
        raise ValueError(
            "--update each-step makes as many optimiser steps as an episode has, so a decay over "
            f"--decay-updates {config.decay_updates} has no length; pass --decay-updates None"
        )


def _check_ars(config: Config) -> None:
    """Raises ValueError for settings that do not go together."""
    if config.one_start:
        raise ValueError(
            "--one-start is for --algorithm reinforce; for ars, --shared-starts compares the two "
            "episodes of a direction from one start"
        )
    top = config.top_directions
    if top is not None and top > config.num_directions:
        raise ValueError(
            f"--top-directions must be at most --num-directions {config.num_directions}, got {top}"
        )
    if config.ars_update == "document" and (config.hidden_sizes or top is not None):
        raise ValueError(
            "--ars-update document is for linear policies and all directions, got --hidden-sizes "
            f"{' '.join(map(str, config.hidden_sizes))} and --top-directions {top}; "
            "pass --hidden-sizes alone and --top-directions None"
        )
