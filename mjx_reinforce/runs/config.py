"""All settings of a run side by side, as config.json shows them, and the rules they obey."""

import dataclasses
import math
import reprlib
from collections.abc import Callable
from typing import Any

from mjx_reinforce import envs
from mjx_reinforce.checks import changed, check_type
from mjx_reinforce.registry import DISTRIBUTIONS, ESTIMATORS, check_name
from mjx_reinforce.runs.settings import (
    CheckpointSettings,
    EstimatorSettings,
    EvaluationSettings,
    LogSettings,
    PolicySettings,
    RunSettings,
    SearchSettings,
    UpdateSettings,
)

#: What is counted exactly up to 2^53, as a double does; see ``learners.counts``.
COUNTED = ("env_steps", "max_updates", "decay_steps")
MAX_COUNT = 2**53
#: The greatest of what an update counts, such as its env steps: they are int32.
MAX_OF_UPDATE = 2**31 - 1
#: The greatest learning rate.
_MAX_RATE = 1000
#: The greatest of other numbers, and one over the least: float32 holds their cubes.
_MAX_SIZE = 1e12
#: The most steps that an update may make one after the other, besides those of the episodes.
_MAX_STEPS = 1_000_000
#: The greatest number of layers: each is a matrix of its own in the program.
_MAX_LAYERS = 100


@dataclasses.dataclass(frozen=True, kw_only=True)
class Config(
    LogSettings,
    CheckpointSettings,
    EvaluationSettings,
    SearchSettings,
    UpdateSettings,
    EstimatorSettings,
    PolicySettings,
    RunSettings,
):
    """Train policies, many seeds at once, and report over the seeds."""

    def __repr__(self) -> str:
        return f"Config({changed(self)})"

    @property
    def episodes_per_update(self) -> int:
        """Episodes that a seed plays for an update, at most."""
        if self.algorithm == "ars":
            return 2 * self.num_directions
        return self.max_episodes if self.num_episodes == "auto" else self.num_episodes

    @property
    def fewest_episodes(self) -> int:
        """Episodes that a seed plays for an update, at least."""
        auto = self.algorithm == "reinforce" and self.num_episodes == "auto"
        return self.min_episodes if auto else self.episodes_per_update


def check(config: Config) -> None:
    """Raises ValueError for settings that make no sense: what, the value, the remedy."""
    for field in dataclasses.fields(Config):
        check_type(flag(field.name), getattr(config, field.name), field.type)
    envs.check_id(config.env)
    check_name("policy", config.policy, {"auto": None} | DISTRIBUTIONS)
    check_name("estimator", config.estimator, ESTIMATORS)
    for names, holds, rule in _RULES:
        for name in names.split():
            value = getattr(config, name)
            spoken = isinstance(value, str) or (value is None and name in _OPTIONAL)
            if not (spoken or holds(value)):
                raise ValueError(f"{flag(name)} must be {rule}, got {reprlib.repr(value)}")
    if config.env_steps is None and config.max_updates is None:
        raise ValueError("nothing would end this run: give --env-steps or --max-updates a number")
    (_check_reinforce if config.algorithm == "reinforce" else _check_ars)(config)


def flag(name: str) -> str:
    """Returns the flag of a setting."""
    return f"--{name.replace('_', '-')}"


def check_step_count(config: Config, horizon: int) -> None:
    """Raises ValueError if a seed may play more env steps than are counted.

    A seed stops after the update that reaches its budget, so it may pass ``env_steps`` by
    one update of full episodes.

    Args:
      config: the settings; at least one of the two budgets is given.
      horizon: the time limit of an episode in steps.
    """
    an_update = config.episodes_per_update * horizon
    bounds = []
    if config.env_steps is not None:
        bounds.append(config.env_steps - 1 + an_update)
    if config.max_updates is not None:
        bounds.append(config.max_updates * an_update)
    each = f"{config.episodes_per_update:,} episodes an update, up to {horizon:,} steps each"
    if an_update > MAX_OF_UPDATE:
        raise ValueError(
            f"an update may play {an_update:,} env steps of a seed ({each}), more than the "
            "2^31 - 1 that can be counted; lower --num-episodes or --horizon"
        )
    if min(bounds) > MAX_COUNT:
        raise ValueError(
            f"a seed may play {min(bounds):,} env steps ({each}), more than the 2^53 that can be "
            "counted; give --env-steps, or lower --max-updates or --horizon"
        )


_OPTIONAL = {field.name for field in dataclasses.fields(Config) if "None" in str(field.type)}

#: Names of settings, what must hold of a value that is given, and how to say it.
_RULES: tuple[tuple[str, Callable[[Any], bool], str], ...] = (
    (
        "num_seeds num_episodes env_steps max_updates horizon decay_steps decay_updates eval_every "
        "checkpoint_every eval_episodes test_episodes value_fits value_batch_size "
        "natural_iterations minibatch_updates minibatch_size num_directions top_directions",
        lambda x: x >= 1,
        "at least 1",
    ),
    ("min_episodes max_episodes", lambda x: x >= 2, "at least 2: one alone shows no noise"),
    ("normalize_steps", lambda x: x >= 0, "at least 0"),
    (
        " ".join(COUNTED),
        lambda x: x <= MAX_COUNT,
        "at most 2^53, for no more is counted exactly",
    ),
    (
        "num_episodes min_episodes max_episodes horizon decay_updates eval_every eval_episodes "
        "test_episodes normalize_steps minibatch_size value_batch_size num_directions "
        "checkpoint_every",
        lambda x: x <= MAX_OF_UPDATE,
        "less than 2^31",
    ),
    (
        "value_fits natural_iterations minibatch_updates",
        lambda x: x <= _MAX_STEPS,
        f"at most {_MAX_STEPS:,}, for an update makes so many steps one after the other",
    ),
    ("seed eval_seed", lambda x: 0 <= x < 2**32, "in [0, 2^32)"),
    ("discount final_discount", lambda x: 0 <= x <= 1, "in [0, 1]"),
    ("momentum", lambda x: 0 <= x <= 1 - 2**-24, "in [0, 1 - 2^-24], the last float32 below 1"),
    (
        "hidden_sizes value_hidden_sizes",
        lambda x: all(n >= 1 for n in x),
        "positive in every layer",
    ),
    (
        "hidden_sizes value_hidden_sizes",
        lambda x: all(n <= MAX_OF_UPDATE for n in x),
        "less than 2^31 in every layer",
    ),
    (
        "hidden_sizes value_hidden_sizes",
        lambda x: len(x) <= _MAX_LAYERS,
        f"at most {_MAX_LAYERS} layers",
    ),
    (
        "initial_std final_std learning_rate final_learning_rate max_grad_norm max_kl "
        "value_learning_rate natural_damping "
        "step_size noise_std minutes",
        lambda x: math.isfinite(x) and x > 0,
        "positive and finite",
    ),
    (
        "standardize_floor entropy_cost weight_decay normalize_min_std",
        lambda x: math.isfinite(x) and x >= 0,
        "finite and not negative",
    ),
    ("reward_shift", lambda x: math.isfinite(x) and abs(x) <= _MAX_SIZE, "finite, in float32"),
    # Weights are about 1, and most optimisers move each of them by about the rate.
    (
        "learning_rate final_learning_rate value_learning_rate step_size",
        lambda x: 1 / _MAX_SIZE <= x <= _MAX_RATE,
        f"in [{1 / _MAX_SIZE:g}, {_MAX_RATE}], for a step moves a weight by about that",
    ),
    (
        "initial_std final_std noise_std max_grad_norm max_kl standardize_floor entropy_cost "
        "weight_decay normalize_min_std natural_damping",
        lambda x: x == 0 or 1 / _MAX_SIZE <= x <= _MAX_SIZE,
        f"in [{1 / _MAX_SIZE:g}, {_MAX_SIZE:g}], for runs compute in float32",
    ),
)


def _check_reinforce(config: Config) -> None:
    """Raises ValueError for settings that do not go together."""
    if config.num_episodes == "auto":
        _check_auto(config)
    elif config.estimator == "leave-one-out" and config.num_episodes < 2:
        raise ValueError(
            f"leave-one-out needs at least two episodes an update, got --num-episodes "
            f"{config.num_episodes}; raise it or choose --estimator reward-to-go"
        )
    if config.policy == "deterministic":
        raise ValueError(
            "--policy deterministic has no log-probability for --algorithm reinforce to follow; "
            "choose --policy auto or --algorithm ars"
        )
    if config.final_discount is not None and max(config.discount, config.final_discount) == 1:
        raise ValueError(
            f"--discount {config.discount} and --final-discount {config.final_discount}: one that "
            "changes must be less than 1, such as 0.9999"
        )
    if config.update == "natural-gradient" and config.max_kl is None:
        raise ValueError(
            "--update natural-gradient has the length of its steps from --max-kl, which is None: "
            "give a number, such as 0.01"
        )
    if config.decay_steps is not None and config.decay_updates is not None:
        raise ValueError(
            f"the learning rate decays over --decay-steps {config.decay_steps} or over "
            f"--decay-updates {config.decay_updates}, not both: pass --decay-steps None"
        )
    if config.update == "each-step" and config.decay_updates is not None:
        raise ValueError(
            "--update each-step makes as many optimiser steps as an episode has, so a decay over "
            f"--decay-updates {config.decay_updates} has no length; choose --decay-steps"
        )
    steps = (config.decay_updates or 0) * config.minibatch_updates
    if config.update == "minibatches" and steps > MAX_OF_UPDATE:
        raise ValueError(
            f"the learning rate would decay over {steps:,} optimiser steps, more than the 2^31 - 1 "
            "that can be counted; lower --decay-updates or --minibatch-updates"
        )


def _check_auto(config: Config) -> None:
    """Raises ValueError for settings that do not go with a number of episodes that changes."""
    if config.min_episodes > config.max_episodes:
        raise ValueError(
            f"--min-episodes must be at most --max-episodes {config.max_episodes}, got "
            f"{config.min_episodes}"
        )
    if config.update not in ("full-batch", "natural-gradient"):
        raise ValueError(
            "--num-episodes auto needs --update full-batch or natural-gradient, for "
            f"{config.update} does not measure the gradient's noise; choose one, or a number"
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
