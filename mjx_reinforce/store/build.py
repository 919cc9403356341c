"""From settings to a learner."""

import math
from typing import TYPE_CHECKING, Any

from mjx_reinforce.engine.checks import check_kind, explain
from mjx_reinforce.registry import ALGORITHMS, ESTIMATORS, is_own, load_choice, load_definition
from mjx_reinforce.settings.config import Config, check_step_count

if TYPE_CHECKING:
    import jax
    import optax

    from mjx_reinforce.engine.base import Environment
    from mjx_reinforce.engine.devices import Devices
    from mjx_reinforce.learning.estimators import Estimator
    from mjx_reinforce.learning.learner import Learner
    from mjx_reinforce.learning.policy import Policy
    from mjx_reinforce.learning.schedules import Schedule
    from mjx_reinforce.learning.updates import Update


def build(
    env: "Environment",
    config: Config,
    policy: "Policy | None" = None,
    devices: "Devices | None" = None,
) -> "tuple[Learner, int]":
    """Builds the learner that the settings describe.

    Args:
      env: what it learns on.
      config: the settings.
      policy: a ready policy, in place of the one that the settings describe.
      devices: among which the episodes of an update are divided, of ``reinforce`` alone.

    Returns:
      The learner, and the horizon in env steps.

    Raises:
      ValueError: the settings do not fit the environment.
    """
    from mjx_reinforce.engine.contract import check_environment
    from mjx_reinforce.export.policy_files import build_policy
    from mjx_reinforce.learning.contract import check_horizon

    check_environment(env)
    if config.stop_when_solved and getattr(env, "reward_threshold", None) is None:
        raise ValueError(
            f"{config.env} names no return at which it is solved: leave --stop-when-solved out"
        )
    horizon = check_horizon(env, config.horizon)
    check_step_count(config, horizon)
    forever = config.normalize_steps is None
    shared = {
        "policy": build_policy(policy_settings(env, config)) if policy is None else policy,
        "horizon": config.training_horizon(horizon),
        "normalize_steps": math.inf if forever else config.normalize_steps,
        "normalize_min_std": config.normalize_min_std,
        "engine": config.engine,
    }
    if is_own(config.algorithm):
        return _build_own(env, config, shared), horizon
    if config.algorithm == "ars":
        return _build_ars(env, config, shared), horizon
    return _build_reinforce(env, config, shared, devices), horizon


def policy_settings(env: "Environment", config: Config) -> dict[str, Any]:
    """Returns what ``policy_files.build_policy`` needs to build the policy without the env."""
    from mjx_reinforce.engine.base import Discrete, action_space, observation_size

    space = action_space(env)
    if isinstance(space, Discrete):
        family, described = "categorical", {"num_actions": space.num_actions}
    else:
        family = "deterministic" if config.algorithm == "ars" else "normal"
        described = {"action_low": space.low.tolist(), "action_high": space.high.tolist()}
    return {
        "env": config.env,
        "policy": family if config.policy == "auto" else config.policy,
        "hidden_sizes": list(config.hidden_sizes),
        "shared_trunk": config.shared_trunk,
        "initializer": config.initializer,
        "initial_std": config.initial_std,
        "rescale": config.rescale,
        "observation_size": observation_size(env),
        **described,
    }


def _build_reinforce(
    env: "Environment", config: Config, shared: dict[str, Any], devices: "Devices | None"
) -> "Learner":
    from mjx_reinforce.console.streams import to_screen
    from mjx_reinforce.engine.play import available
    from mjx_reinforce.learning.learner import reinforce
    from mjx_reinforce.learning.schedules import Cut
    from mjx_reinforce.training import hosting

    if config.engine in ("auto", "native") and (said := available.announcement(env)):
        to_screen(said)
    learner = reinforce(
        env,
        estimator=_build_estimator(config, shared["horizon"]),
        optimizer=_build_optimizer(config),
        update=_build_update(config, shared["policy"]),
        num_episodes=config.num_episodes,
        entropy_cost=config.entropy_cost,
        max_kl=config.max_kl,
        **shared,
    )
    cut = None
    if config.train_horizon is not None and config.whole_after < 1:
        cut = Cut(config.train_horizon, config.whole_after)
    size = config.num_episodes, shared["horizon"]
    learner = hosting.hosted(
        learner, env, *size, cut=cut, devices=devices, one_start=config.one_start
    )
    return hosting.short_episodes(learner, size[1], config.num_seeds, cut.steps if cut else 0)


def _build_ars(env: "Environment", config: Config, shared: dict[str, Any]) -> "Learner":
    from mjx_reinforce.published.ars import ars

    return ars(
        env,
        num_directions=config.num_directions,
        top_directions=config.top_directions,
        step_size=config.step_size,
        noise_std=config.noise_std,
        shared_starts=config.shared_starts,
        update=config.ars_update,
        **shared,
    )


def _build_own(env: "Environment", config: Config, shared: dict[str, Any]) -> "Learner":
    """Returns the learner of the user's own algorithm, a function of ``env``, ``config`` and these.

    ``shared`` are the keywords that ``reinforce`` and ``ars`` have in common.
    """
    from mjx_reinforce.training.hosting import check_learner

    learner = _made_by_user("algorithm", config.algorithm, ALGORITHMS, env, config, **shared)
    check_learner(config.algorithm, learner)
    return learner


def _made_by_user(
    kind: str, name: str, known: dict[str, str], *arguments: object, **more: object
) -> Any:
    """Returns what the user's own function returns, or raises ValueError with what it raised."""
    make = load_choice(kind, name, known)
    try:
        return make(*arguments, **more)
    except (Exception, SystemExit) as error:  # the user's code may raise anything
        raise ValueError(f"cannot build the {kind} {name!r}: {explain(error)}") from error


def _build_estimator(config: Config, horizon: int) -> "Estimator | Schedule":
    """Returns an estimator, or a schedule of one where its discount changes."""
    from mjx_reinforce.learning.schedules import Schedule, look_further

    first, last = config.discount, config.final_discount
    if last is None:
        return _estimator(config, horizon, first)
    return Schedule(lambda used: _estimator(config, horizon, look_further(first, last, used)))


def _estimator(config: Config, horizon: int, discount: "float | jax.Array") -> "Estimator":
    from mjx_reinforce.engine.checks import known_number
    from mjx_reinforce.learning import estimators

    if config.estimator == "value-baseline":
        estimator = _build_value_baseline(config, horizon, discount)
    elif is_own(config.estimator):
        estimator = _made_by_user("estimator", config.estimator, ESTIMATORS, discount)
        example = "mjx_reinforce.reward_to_go(0.99)"
        check_kind(f"what {config.estimator} returns", estimator, estimators.Estimator, example)
    else:
        settings = {"ended": config.ended_episodes} if config.estimator == "leave-one-out" else {}
        estimator = load_definition(ESTIMATORS[config.estimator])(discount, **settings)
    if known_number(config.reward_shift) != 0:
        estimator = estimators.shift_rewards(estimator, config.reward_shift)
    if config.standardize:
        estimator = estimators.standardize(estimator, floor=config.standardize_floor)
    if config.discount_weights:
        estimator = estimators.discount_weights(estimator, discount)
    return estimator


def _build_value_baseline(
    config: Config, horizon: int, discount: "float | jax.Array"
) -> "Estimator":
    import optax

    from mjx_reinforce.learning.policy import MLP
    from mjx_reinforce.learning.value import full_batch_value_baseline, value_baseline

    shared = {
        "network": MLP(config.value_hidden_sizes, 1, initializer=config.initializer),
        "optimizer": optax.adam(config.value_learning_rate),
        "num_fits": config.value_fits,
    }
    if config.value_fit == "full-batch":
        return full_batch_value_baseline(discount, **shared)
    return value_baseline(discount, horizon=horizon, batch_size=config.value_batch_size, **shared)


def _build_optimizer(config: Config) -> "optax.GradientTransformation":
    import optax

    from mjx_reinforce.learning import schedules
    from mjx_reinforce.learning.updates import make_optimizer

    rate: Any = config.learning_rate
    final = rate / 10 if config.final_learning_rate is None else config.final_learning_rate
    if config.decay_updates is not None:
        # The schedule counts optimiser steps.
        each = config.minibatch_updates if config.update == "minibatches" else 1
        rate = optax.linear_schedule(rate, final, config.decay_updates * each)
    optimizer = make_optimizer(
        config.optimizer,
        rate,
        weight_decay=config.weight_decay,
        max_grad_norm=config.max_grad_norm,
        momentum=config.momentum,
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
    ratio = config.final_std / config.initial_std
    return optax.chain(optimizer, schedules.shrink_std(ratio, length))


def _build_update(config: Config, policy: "Policy") -> "Update":
    from mjx_reinforce.learning import updates
    from mjx_reinforce.learning.natural_gradient import natural_gradient

    if config.update == "natural-gradient":
        assert config.max_kl is not None  # checked
        return natural_gradient(
            policy,
            config.max_kl,
            damping=config.natural_damping,
            iterations=config.natural_iterations,
        )
    if config.update == "minibatches":
        return updates.minibatches(config.minibatch_updates, config.minibatch_size)
    chosen = updates.full_batch() if config.update == "full-batch" else updates.each_step()
    return updates.per_step(chosen) if config.loss_per == "step" else chosen
