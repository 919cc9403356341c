"""Do the parts of a learner fit together? Found from shapes: nothing is compiled."""

import inspect
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from mjx_reinforce.engine.base import Environment, PyTree, Trajectory, null_action
from mjx_reinforce.engine.checks import MAX_OF_UPDATE, check_count, check_kind, explain
from mjx_reinforce.engine.contract import described
from mjx_reinforce.learning import updates
from mjx_reinforce.learning.distributions import Distribution
from mjx_reinforce.learning.estimators import Estimator
from mjx_reinforce.learning.policy import Policy

#: Steps and episodes of the trajectory that an estimator is tried on: no two axes have one size.
_NUM_STEPS = 5


def check_horizon(env: Environment, horizon: int | None) -> int:
    """Returns the time limit in steps, or raises ValueError."""
    if horizon is None:
        horizon = getattr(env, "max_episode_steps", None)
    if horizon is None:
        raise ValueError("the env declares no max_episode_steps: give a horizon (--horizon N)")
    check_count("horizon", horizon)
    return horizon


def check_num_steps(num_episodes: int, horizon: int) -> None:
    """Raises ValueError where an update may have more env steps than are counted."""
    num_steps = num_episodes * horizon
    if num_steps > MAX_OF_UPDATE:
        raise ValueError(
            f"an update may have {num_steps:,} env steps ({num_episodes:,} episodes of "
            f"{horizon:,}), and fewer than 2^31 are counted; lower --num-episodes or --horizon"
        )


def check_policy(
    policy: Policy, env: Environment, observation_size: int, *, likelihood: bool = False
) -> None:
    """Raises ValueError for a policy that cannot play an environment, in one line that says why.

    Args:
      policy: what a user gave. Its functions are traced.
      env: what it plays, checked already.
      observation_size: O.
      likelihood: whether its log-probability is needed.
    """
    check_kind("policy", policy, Policy, "mjx_reinforce.mlp_policy(observation_size, distribution)")
    distribution = policy.distribution
    check_kind(
        "policy.distribution", distribution, Distribution, "mjx_reinforce.normal(env.action_space)"
    )
    params = traced("policy.init(key)", policy.init, jax.random.key(0))
    # Of two observations: a policy that takes a single one alone would fail in the rollout.
    observation = jax.ShapeDtypeStruct((2, observation_size), jnp.result_type(float))
    apply_call = f"policy.apply(params, observation [2, {observation_size}])"
    outputs = traced(apply_call, policy.apply, params, observation)
    num_outputs = distribution.num_outputs
    num_constants = len(distribution.constants)
    if getattr(outputs, "shape", None) != (2, num_outputs + num_constants):
        constants = ""
        if num_constants:
            constants = f", then distribution.constants [2, {num_constants}], as parameters"
        raise ValueError(
            f"{apply_call} must return [2, {num_outputs + num_constants}]: what a network computes "
            f"[2, {num_outputs}]{constants}; got {described(outputs)}"
        )
    if not jnp.issubdtype(outputs.dtype, jnp.floating):
        raise ValueError(f"{apply_call} must return floating-point numbers, got {outputs.dtype}")

    def draw(outputs):
        return distribution.sample(outputs, distribution.noise(jax.random.key(0), (2,)))

    action = traced("policy.distribution.sample", draw, outputs)
    action_shape = null_action(env).shape
    if getattr(action, "shape", None) != (2, *action_shape):
        raise ValueError(
            f"policy.distribution draws actions {described(action)} for two observations, "
            f"{type(env).__name__} takes {[2, *action_shape]}; make it for the actions of this "
            "environment"
        )
    if likelihood:
        traced("policy.distribution.log_prob", distribution.log_prob, outputs, action)


def check_update(update: updates.Update) -> None:
    """Raises ValueError for what is no update, or a function that makes one."""
    # By its arguments, as there is no class of updates: ``full_batch`` itself takes none.
    try:
        inspect.signature(update).bind("problem", "key", "params", "opt_state")
    except (TypeError, ValueError):
        name = f"{update.__name__}, which is to be called" if callable(update) else repr(update)
        raise ValueError(f"update must be such as mjx_reinforce.full_batch(), got {name}") from None


def check_estimator(
    estimator: Estimator, env: Environment, observation_size: int, num_episodes: int
) -> None:
    """Raises ValueError for an estimator whose weights are not [T, N], in one line that says why.

    Args:
      estimator: what a user gave. Its functions are traced.
      env: whose actions a trajectory holds.
      observation_size: O.
      num_episodes: N.
    """
    check_kind("estimator", estimator, Estimator, "mjx_reinforce.reward_to_go(0.99)")
    if num_episodes < estimator.min_episodes:
        raise ValueError(
            f"this estimator needs at least {estimator.min_episodes} episodes per update, "
            f"got num_episodes={num_episodes}"
        )
    mask_shape = (_NUM_STEPS, num_episodes)
    action = null_action(env)
    float_dtype = jnp.result_type(float)
    trajectory = Trajectory(
        observation=_ShapeDtype((*mask_shape, observation_size), float_dtype),
        action=_ShapeDtype((*mask_shape, *action.shape), action.dtype),
        reward=_ShapeDtype(mask_shape, float_dtype),
        mask=_ShapeDtype(mask_shape, bool),
        nonfinite=_ShapeDtype((num_episodes,), bool),
        simulated=_ShapeDtype((), jnp.int32),
    )

    def update(key, trajectory):
        return estimator.update(estimator.init(key, observation_size), trajectory)

    estimate = traced("estimator.init or update", update, jax.random.key(0), trajectory)
    if not (isinstance(estimate, tuple) and len(estimate) == 3):
        raise ValueError(
            "estimator.update must return three things, (weight [T, N], next state, metrics), "
            f"got {type(estimate).__name__}"
        )
    weight, _, metrics = estimate
    if getattr(weight, "shape", None) != mask_shape or not jnp.issubdtype(
        weight.dtype, jnp.floating
    ):
        raise ValueError(
            f"estimator.update must return a weight for every action, float [T, N], here "
            f"{list(mask_shape)}; got {described(weight)}"
        )
    if not isinstance(metrics, dict):
        raise ValueError(
            f"estimator.update must return its metrics as a dict, got {type(metrics).__name__}"
        )


def traced(name: str, function: Callable[..., PyTree], *arguments: PyTree) -> Any:
    """Returns the shapes of what a user's function returns, or raises ValueError if it fails."""
    try:
        return jax.eval_shape(function, *arguments)
    except Exception as error:  # it is the user's code, which may raise anything
        raise ValueError(f"{name} fails: {explain(error)}") from error


_ShapeDtype: Any = jax.ShapeDtypeStruct
