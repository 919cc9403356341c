"""From settings to a learner."""

import math
from collections.abc import Mapping
from typing import Any, cast

import optax

from mjx_reinforce.engine.base import Box, Discrete, Environment, action_space, observation_size
from mjx_reinforce.engine.checks import check_kind, explain
from mjx_reinforce.engine.contract import check_environment
from mjx_reinforce.engine.devices import Devices
from mjx_reinforce.export.policy_files import build_policy
from mjx_reinforce.learning import estimators, schedules
from mjx_reinforce.learning.contract import check_horizon
from mjx_reinforce.learning.distributions import default_std
from mjx_reinforce.learning.estimators import Estimator
from mjx_reinforce.learning.learner import Learner, reinforce
from mjx_reinforce.learning.natural_gradient import natural_gradient
from mjx_reinforce.learning.policy import MLP, Policy
from mjx_reinforce.learning.updates import Update, full_batch, make_optimizer
from mjx_reinforce.learning.value import value_baseline
from mjx_reinforce.registry import (
    ALGORITHMS,
    ESTIMATORS,
    find_algorithm,
    is_own,
    load_choice,
    load_definition,
)
from mjx_reinforce.settings.config import Config
from mjx_reinforce.setup.room import check_networks
from mjx_reinforce.training import wrappers


def build(
    env: Environment,
    config: Config,
    policy: Policy | None = None,
    devices: Devices | None = None,
    num_seeds: int = 1,
) -> tuple[Learner, int]:
    """Builds the learner that the settings describe.

    Args:
      env: what it learns on.
      config: the settings.
      policy: a ready policy, in place of the one that the settings describe.
      devices: among which the episodes of an update are divided, of ``reinforce`` alone.
      num_seeds: how many a device trains at once, for whose networks there must be memory.

    Returns:
      The learner, and the horizon in env steps.

    Raises:
      ValueError: the settings do not fit the environment.
    """
    check_environment(env)
    horizon = check_horizon(env, config.horizon)
    forever, described = config.normalize_steps is None, policy_settings(env, config)
    policy = build_policy(described) if policy is None else policy
    check_networks(env, config, policy, config.training_horizon(horizon), num_seeds)
    shared = {  # of all algorithms, the user's too
        "policy": policy,
        "horizon": config.training_horizon(horizon),
        "normalize_steps": math.inf if forever else config.normalize_steps,
        "normalize_min_std": config.normalize_min_std,
        "engine": config.engine,
    }
    if is_own(config.algorithm):
        learner = _made_by_user("algorithm", config.algorithm, ALGORITHMS, env, config, **shared)
        wrappers.check_learner(config.algorithm, learner)
        return learner, horizon
    algorithm = find_algorithm(config.algorithm)
    learner = load_definition(algorithm.make)(env, config, **shared)
    if not algorithm.search_episodes:
        learner = _for_many_seeds(learner, config, shared["horizon"], devices)
    return learner, horizon


def policy_settings(env: Environment, config: Config) -> dict[str, Any]:
    """Returns what ``policy_files.build_policy`` needs to build the policy without the env."""
    space, algorithm = action_space(env), find_algorithm(config.algorithm)
    if isinstance(space, Discrete):
        family, described = "categorical", {"num_actions": space.num_actions}
    else:
        family = "deterministic" if algorithm.search_episodes else "normal"
        described = {"action_low": space.low.tolist(), "action_high": space.high.tolist()}
    return {
        "env": config.env,
        "policy": family if config.policy == "auto" else config.policy,
        "hidden_sizes": list(config.hidden_sizes),
        "initializer": "orthogonal",
        "initial_std": config.initial_std,
        "rescale": True,
        "observation_size": observation_size(env),
        **described,
        **algorithm.policy,
    }


def build_reinforce(env: Environment, config: Config, **shared: Any) -> Learner:
    """Returns the learner of ``--algorithm reinforce``; arguments are those of a program."""
    return reinforce(
        env,
        estimator=_build_estimator(config, shared["horizon"]),
        optimizer=_build_optimizer(config, action_space(env)),
        update=_build_update(config, shared["policy"]),
        num_episodes=config.num_episodes,
        entropy_cost=config.entropy_cost,
        max_kl=config.max_kl,
        **shared,
    )


def _for_many_seeds(
    learner: Learner, config: Config, horizon: int, devices: Devices | None
) -> Learner:
    """Returns a learner with what many seeds need, see ``training.wrappers``."""
    cut_steps = 0
    if config.train_horizon is not None and config.whole_after < 1:
        cut_steps = config.train_horizon
        learner = schedules.Cut(cut_steps, config.whole_after)(learner)
    learner = wrappers.in_one_launch(learner, devices)
    return wrappers.short_episodes(learner, horizon, config.num_seeds, cut_steps)


def _made_by_user(
    kind: str, name: str, known: Mapping[str, Any], *arguments: object, **more: object
) -> Any:
    """Returns what the user's own function returns, or raises ValueError with what it raised."""
    make = load_choice(kind, name, known)
    try:
        return make(*arguments, **more)
    except (Exception, SystemExit) as error:  # the user's code may raise anything
        raise ValueError(f"cannot build the {kind} {name!r}: {explain(error)}") from error


def _build_estimator(config: Config, horizon: int) -> Estimator:
    if config.estimator == "value-baseline":
        estimator = _build_value_baseline(config, horizon)
    elif is_own(config.estimator):
        estimator = _made_by_user("estimator", config.estimator, ESTIMATORS, config.discount)
        example = "mjx_reinforce.reward_to_go(0.99)"
        check_kind(f"what {config.estimator} returns", estimator, estimators.Estimator, example)
    else:
        estimator = load_definition(ESTIMATORS[config.estimator])(config.discount)
    if config.standardize_floor is None:
        return estimator
    return estimators.standardize(estimator, floor=config.standardize_floor)


def _build_value_baseline(config: Config, horizon: int) -> Estimator:
    return value_baseline(
        config.discount,
        horizon=horizon,
        network=MLP(config.value_hidden_sizes, 1),
        optimizer=optax.adam(config.value_learning_rate),
        num_fits=config.value_fits,
        batch_size=config.value_batch_size,
    )


def _build_optimizer(config: Config, space: Box | Discrete) -> optax.GradientTransformation:
    rate = config.learning_rate
    final = rate / 10 if config.final_learning_rate is None else config.final_learning_rate
    optimizer = make_optimizer(
        config.optimizer, rate, max_grad_norm=config.max_grad_norm, momentum=config.momentum
    )
    if config.update == "natural-gradient":
        # Its steps have their length from max_kl; of that a decaying rate leaves a share.
        optimizer = optax.chain(optax.sgd(rate), optax.scale(1 / config.learning_rate))
    if config.decay_steps is None:
        return optimizer
    length = None if config.decay_steps == "budget" else config.decay_steps
    optimizer = optax.chain(optimizer, schedules.decay_rate(final / config.learning_rate, length))
    if config.final_std is None:
        return optimizer
    initial_std = config.initial_std
    if initial_std is None:  # a trained deviation has bounds of actions, or none
        initial_std = default_std(cast(Box, space))
    ratio = config.final_std / initial_std
    return optax.chain(optimizer, schedules.shrink_std(ratio, length))


def _build_update(config: Config, policy: Policy) -> Update:
    if config.update == "full-batch":
        return full_batch()
    assert config.max_kl is not None  # checked
    return natural_gradient(policy, config.max_kl)
