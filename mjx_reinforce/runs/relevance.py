"""Which setting is read under which condition; what would do nothing is refused."""

import dataclasses
from collections.abc import Callable
from typing import Any

from mjx_reinforce.runs.config import Config, flag

#: Families whose standard deviation is a parameter, the same in all states.
FREE_STD = ("normal", "truncated-normal", "clipped-normal", "tanh-normal")
#: Names of settings, when they are read, and how to say it. A setting may stand in several rows,
#: the most general first. What stands in none is always read.
READ: tuple[tuple[str, Callable[[Config], bool], str], ...] = (
    (
        "num_episodes min_episodes max_episodes "
        "estimator ended_episodes discount final_discount reward_shift "
        "discount_weights standardize standardize_floor value_learning_rate value_fit value_fits "
        "value_batch_size value_hidden_sizes update natural_damping natural_iterations "
        "minibatch_updates minibatch_size loss_per entropy_cost optimizer learning_rate "
        "final_learning_rate decay_steps decay_updates weight_decay max_grad_norm max_kl "
        "final_std momentum",
        lambda c: c.algorithm == "reinforce",
        "--algorithm reinforce",
    ),
    (
        "num_directions top_directions step_size noise_std shared_starts ars_update",
        lambda c: c.algorithm == "ars",
        "--algorithm ars",
    ),
    (
        "value_learning_rate value_fit value_fits value_batch_size value_hidden_sizes",
        lambda c: c.estimator == "value-baseline",
        "--estimator value-baseline",
    ),
    ("value_batch_size", lambda c: c.value_fit == "minibatches", "--value-fit minibatches"),
    ("ended_episodes", lambda c: c.estimator == "leave-one-out", "--estimator leave-one-out"),
    (
        "min_episodes max_episodes",
        lambda c: c.num_episodes == "auto",
        "--num-episodes auto",
    ),
    ("standardize_floor", lambda c: c.standardize, "--standardize"),
    ("overwrite", lambda c: c.output is not None or c.resume is not None, "--output DIR"),
    (
        "minibatch_updates minibatch_size",
        lambda c: c.update == "minibatches",
        "--update minibatches",
    ),
    (
        "natural_damping natural_iterations",
        lambda c: c.update == "natural-gradient",
        "--update natural-gradient",
    ),
    (
        "natural_iterations",
        lambda c: bool(c.hidden_sizes) or c.policy != "normal",
        "hidden layers or another --policy than normal",
    ),
    # The natural gradient's step has its length from --max-kl.
    (
        "optimizer momentum weight_decay max_grad_norm",
        lambda c: c.update != "natural-gradient",
        "another --update than natural-gradient",
    ),
    (
        "learning_rate",
        lambda c: c.update != "natural-gradient" or c.final_learning_rate is not None,
        "another --update than natural-gradient, or --final-learning-rate",
    ),
    # A minibatch is averaged over its own steps.
    (
        "loss_per",
        lambda c: c.update != "minibatches",
        "--update full-batch or --update each-step",
    ),
    (
        "final_learning_rate",
        lambda c: c.decay_steps is not None or c.decay_updates is not None,
        "--decay-steps N (or --decay-updates N)",
    ),
    ("normalize_min_std", lambda c: c.normalize_steps != 0, "--normalize-steps N"),
    (
        "momentum",
        lambda c: c.optimizer in ("adam", "adamw"),
        "--optimizer adam or --optimizer adamw",
    ),
    ("final_std", lambda c: c.decay_steps is not None, "--decay-steps N"),
    (
        "final_std",
        lambda c: c.policy == "auto" or c.policy in FREE_STD,
        "a --policy whose standard deviation is the same in all states",
    ),
    (
        "initial_std",
        lambda c: (
            c.policy not in ("categorical", "deterministic")
            and not (c.policy == "auto" and c.algorithm == "ars")
        ),
        "a --policy with a standard deviation",
    ),
    (
        "rescale",
        lambda c: c.policy != "categorical",
        "a --policy for continuous actions",
    ),
)


def is_read(name: str, config: Config) -> bool:
    """Returns whether anything reads a setting in a run."""
    return all(holds(config) for names, holds, _ in READ if name in names.split())


def check_read(config: Config, default: Config) -> None:
    """Raises ValueError for settings that a user changed and that nothing would read.

    Args:
      config: the settings.
      default: those that hold where the user gave none: our own, or a preset's.
    """
    given = changed(config, default)
    for names, holds, condition in READ:
        idle = [name for name in given if name in names.split()]
        if idle and not holds(config):
            flags = " ".join(as_flag(name, getattr(config, name)) for name in idle)
            raise ValueError(
                f"{flags} would do nothing: only {condition} reads that; "
                f"{'leave it out' if len(idle) == 1 else 'leave them out'}, or choose {condition}"
            )


def check_read_by_policy(config: Config, default: Config, policy: str) -> None:
    """Raises ValueError for settings that a user changed and that the policy does not read.

    Args:
      config: the settings.
      default: those that hold where the user gave none.
      policy: the distribution that stands for ``auto``, which depends on the environment.
    """
    chosen = dataclasses.replace(config, policy=policy)
    read = {"initial_std", "final_std", "rescale", "natural_iterations"}
    given = read.intersection(changed(config, default))
    check_read(chosen, dataclasses.replace(chosen, **dict.fromkeys(given, object())))


def changed(config: Config, default: Config) -> tuple[str, ...]:
    """Returns the names of the settings in which two differ."""
    names = (field.name for field in dataclasses.fields(Config))
    return tuple(name for name in names if getattr(config, name) != getattr(default, name))


def as_flag(name: str, value: Any) -> str:
    """Returns a setting as it stands on the command line."""
    if isinstance(value, bool):
        return flag(name) if value else flag(f"no_{name}")
    values = value if isinstance(value, tuple) else (value,)
    return " ".join([flag(name), *map(str, values)])
