"""Does a policy do what a policy must? Found from shapes: nothing is compiled."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from mjx_reinforce.checks import check_kind, explain
from mjx_reinforce.policies.distributions.distribution import Distribution
from mjx_reinforce.policies.policy import Policy
from mjx_reinforce.types import Environment, PyTree, null_action


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
    params = _shapes_returned("policy.init(key)", policy.init, jax.random.key(0))
    observation = jax.ShapeDtypeStruct((2, observation_size), jnp.result_type(float))
    given = f"policy.apply(params, observation [2, {observation_size}])"
    outputs = _shapes_returned(given, policy.apply, params, observation)
    count, constants = distribution.num_outputs, len(distribution.constants)
    if getattr(outputs, "shape", None) != (2, count + constants):
        fixed = f", then distribution.constants [2, {constants}], as parameters" * bool(constants)
        raise ValueError(
            f"{given} must return [2, {count + constants}]: what a network computes [2, {count}]"
            f"{fixed}; got {_shape_or_type(outputs)}"
        )
    if not jnp.issubdtype(outputs.dtype, jnp.floating):
        raise ValueError(f"{given} must return floating-point numbers, got {outputs.dtype}")

    def draw(outputs):
        return distribution.sample(outputs, distribution.noise(jax.random.key(0), (2,)))

    action, expected = (
        _shapes_returned("policy.distribution.sample", draw, outputs),
        null_action(env),
    )
    if getattr(action, "shape", None) != (2, *expected.shape):
        raise ValueError(
            f"policy.distribution draws actions {_shape_or_type(action)} for two observations, "
            f"{type(env).__name__} takes [2{''.join(f', {n}' for n in expected.shape)}]; make it "
            "for the actions of this environment"
        )
    if likelihood:
        _shapes_returned("policy.distribution.log_prob", distribution.log_prob, outputs, action)


def _shapes_returned(name: str, function: Callable[..., PyTree], *arguments: PyTree) -> Any:
    """Returns the shapes of what a user's function returns."""
    try:
        return jax.eval_shape(function, *arguments)
    except Exception as error:  # it is the user's code, which may raise anything
        raise ValueError(f"{name} fails: {explain(error)}") from error


def _shape_or_type(value: Any) -> str:
    """Returns the shape of an array, or the type of what is none."""
    return str(list(value.shape)) if hasattr(value, "shape") else f"a {type(value).__name__}"
