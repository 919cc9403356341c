"""The documents' programs with something put right, as ``--algorithm`` takes them."""

from typing import Any

import mjx_reinforce as mr
from mjx_reinforce.engine.base import action_space, observation_size
from mjx_reinforce.published import baseline_truncated_normal as baseline
from mjx_reinforce.published import categorical_cartpole, continuous_cartpole, gymnasium_tutorial


def fresh_starts(env: mr.Environment, config: Any, **shared: Any) -> mr.Learner:
    """003: every episode has a start of its own."""
    return gymnasium_tutorial.learner(env, config, mr.reward_to_go(config.discount), **shared)


def rescaled_actions(env: mr.Environment, config: Any, policy: Any, **shared: Any) -> mr.Learner:
    """001: an output of 1 is the end of the action's range, and the std as large."""
    family = mr.truncated_normal(action_space(env), initial_std=3.0, rescale=True)
    policy = mr.mlp_policy(observation_size(env), family, config.hidden_sizes, initializer="torch")
    return baseline.make(env, config, policy=policy, **shared)


def plain_returns(env: mr.Environment, config: Any, **shared: Any) -> mr.Learner:
    """002: returns to go as they are."""
    return continuous_cartpole.reinforce(env, config, mr.reward_to_go(config.discount), **shared)


def papers_update(env: mr.Environment, config: Any, **shared: Any) -> mr.Learner:
    """002: random search as Mania et al. have it."""
    return continuous_cartpole.corrected_search(env, config, **shared)


def one_step(env: mr.Environment, config: Any, **shared: Any) -> mr.Learner:
    """004: one optimizer step an episode."""
    return categorical_cartpole.make(env, config, mr.full_batch(), **shared)
