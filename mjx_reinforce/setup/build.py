"""From settings to a learner."""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple, cast

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
from mjx_reinforce.learning.policy import Policy
from mjx_reinforce.learning.updates import Update, full_batch, make_optimizer
from mjx_reinforce.learning.value import value_baseline, value_network
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


class Built(NamedTuple):
    """What the settings describe in an environment.

    learner: what trains the policy
    horizon: the time limit of an episode in steps
    training_horizon: that of a training episode, which may be lower
    policy: how to rebuild the policy of the settings, see ``policy_files.save_policy``
    """

    learner: Learner
    horizon: int
    training_horizon: int
    policy: dict[str, Any]


def build(
    env: Environment,
    config: Config,
    policy: Policy | None = None,
    devices: Devices | None = None,
    num_seeds: int = 1,
) -> Built:
    """Builds the learner that the settings describe.

    Args:
      env: what it learns on.
      config: the settings.
      policy: a ready policy, in place of the one that the settings describe.
      devices: among which the episodes of an update are divided, of ``reinforce`` alone.
      num_seeds: how many a device trains at once, for whose networks there must be memory.

    Raises:
      ValueError: the settings do not fit the environment.
    """
    check_environment(env)
    described_policy = policy_settings(env, config)
    if policy is None:
        policy = build_policy(described_policy)
    horizon = check_horizon(env, config.horizon)
    training_horizon = config.training_horizon(horizon)
    # First, so that settings that cannot fit are refused before anything is compiled.
    check_networks(env, config, policy, training_horizon, num_seeds)
    normalize_steps = config.normalize_steps
    if normalize_steps is None:  # without end
        normalize_steps = math.inf
    common = {  # of all algorithms, the user's too
        "policy": policy,
        "horizon": training_horizon,
        "normalize_steps": normalize_steps,
        "normalize_min_std": config.normalize_min_std,
        "engine": config.engine,
    }
    if is_own(config.algorithm):
        learner = _call_choice("algorithm", config.algorithm, ALGORITHMS, env, config, **common)
        # What the user's code returns fails here in one line, not inside of a program.
        wrappers.check_learner(config.algorithm, learner)
        return Built(learner, horizon, training_horizon, described_policy)
    algorithm = find_algorithm(config.algorithm)
    learner = load_definition(algorithm.make)(env, config, **common)
    # A search plays no ``Trajectory`` of one policy, which the wrappers take.
    if not algorithm.search_episodes:
        learner = _for_many_seeds(learner, config, training_horizon, devices)
    return Built(learner, horizon, training_horizon, described_policy)


def policy_settings(env: Environment, config: Config) -> dict[str, Any]:
    """Returns what ``policy_files.build_policy`` needs to build the policy without the env."""
    space = action_space(env)
    algorithm = find_algorithm(config.algorithm)
    if isinstance(space, Discrete):
        family = "categorical"
        space_settings: dict[str, Any] = {"num_actions": space.num_actions}
    else:
        # A search moves the parameters at random, and needs no random actions.
        family = "deterministic" if algorithm.search_episodes else "normal"
        space_settings = {"action_low": space.low.tolist(), "action_high": space.high.tolist()}
    if config.policy != "auto":
        family = config.policy
    # The algorithm's own settings come last: a published program has its initializer, for one.
    return {
        "env": config.env,
        "policy": family,
        "hidden_sizes": list(config.hidden_sizes),
        "initializer": "orthogonal",
        "initial_std": config.initial_std,
        "rescale": True,
        "observation_size": observation_size(env),
        "frames": getattr(env, "frames", 1),  # of a MujocoEnv, which a robot's program has to keep
        **space_settings,
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
    # The launch is wrapped around the cut, whose limit it applies to the episodes of training and
    # not to an evaluation's.
    if config.train_horizon is not None and config.whole_after < 1:
        cut_steps = config.train_horizon
        learner = schedules.Cut(cut_steps, config.whole_after)(learner)
    learner = wrappers.in_one_launch(learner, devices)
    return wrappers.short_episodes(learner, horizon, config.num_policies, cut_steps)


def _call_choice(
    kind: str, name: str, choices: Mapping[str, Any], *arguments: object, **options: object
) -> Any:
    """Returns what the user's own function returns, or raises ValueError with what it raised."""
    build_choice = load_choice(kind, name, choices)
    try:
        return build_choice(*arguments, **options)
    except (Exception, SystemExit) as error:  # the user's code may raise anything
        raise ValueError(f"cannot build the {kind} {name!r}: {explain(error)}") from error


def _build_estimator(config: Config, horizon: int) -> Estimator:
    """Returns the estimator of the settings, of the package or of the user."""
    if config.estimator == "value-baseline":
        estimator = _build_value_baseline(config, horizon)
    elif is_own(config.estimator):
        estimator = _call_choice("estimator", config.estimator, ESTIMATORS, config.discount)
        example = "mjx_reinforce.reward_to_go(0.99)"
        check_kind(f"what {config.estimator} returns", estimator, estimators.Estimator, example)
    else:
        estimator = load_definition(ESTIMATORS[config.estimator])(config.discount)
    if config.standardize_floor is None:
        return estimator
    return estimators.standardize(estimator, floor=config.standardize_floor)


def _build_value_baseline(config: Config, horizon: int) -> Estimator:
    """Returns the estimator with a value network for episodes of ``horizon`` steps."""
    return value_baseline(
        config.discount,
        horizon=horizon,
        network=value_network(config.value_hidden_sizes),
        optimizer=optax.adam(config.value_learning_rate),
        num_fits=config.value_fits,
        batch_size=config.value_batch_size,
    )


def _build_optimizer(config: Config, space: Box | Discrete) -> optax.GradientTransformation:
    """Returns the optimizer of the settings, with the schedules behind it."""
    rate = config.learning_rate
    final_rate = config.final_learning_rate
    if final_rate is None:
        final_rate = rate / 10
    optimizer = make_optimizer(
        config.optimizer, rate, max_grad_norm=config.max_grad_norm, momentum=config.momentum
    )
    if config.update == "natural-gradient":
        # Its steps have their length from max_kl; of that a decaying rate leaves a share.
        optimizer = optax.chain(optax.sgd(rate), optax.scale(1 / config.learning_rate))
    if config.decay_steps is None:
        return optimizer
    steps = config.decay_steps
    if steps == "budget":  # as long as that, of env steps or updates
        steps = None
    # Behind the optimizer: Adam would divide a factor on its gradients out again.
    optimizer = optax.chain(optimizer, schedules.decay_rate(final_rate / rate, steps))
    if config.final_std is None:
        return optimizer
    initial_std = config.initial_std
    if initial_std is None:  # a trained deviation has bounds of actions, or none
        initial_std = default_std(cast(Box, space))
    ratio = config.final_std / initial_std
    return optax.chain(optimizer, schedules.shrink_std(ratio, steps))


def _build_update(config: Config, policy: Policy) -> Update:
    if config.update == "full-batch":
        return full_batch()
    assert config.max_kl is not None  # checked
    return natural_gradient(policy, config.max_kl)
