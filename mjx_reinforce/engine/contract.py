"""Is what a user gives what it must be? Found from shapes: nothing is simulated."""

import numbers
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mjx_reinforce.engine import checks
from mjx_reinforce.engine.base import (
    Act,
    Acts,
    Box,
    Discrete,
    Environment,
    PyTree,
    action_space,
    shapes,
)
from mjx_reinforce.engine.checks import BadEnvironmentError, require

#: What JAX raises where Python or NumPy asks for the value of a traced array.
_VALUE_ERRORS = (jax.errors.ConcretizationTypeError, jax.errors.TracerArrayConversionError)
_ADVICE = "; it is compiled by JAX: write jnp.where for `if`, and jnp for numpy, math and float()"
#: Ends of names of wrappers of brax and Playground, and of ours for brax, that map an environment,
#: or reset it where an episode ends: what the last action led to is lost there.
_FOREIGN_WRAPPERS = ("AutoResetWrapper", "BraxVectorWrapper", "VmapWrapper")


def check_environment(env: Environment) -> None:
    """Raises ValueError for an environment that cannot be played, in one line that says why.

    Args:
      env: what a user gave. Its ``reset`` and ``step`` are traced, and nothing is compiled.
    """
    name = type(env).__name__
    checks.check_parts(env)
    _check_wrappers(env)
    _check_limits(name, env)
    _check_action_space(name, env)
    start = _shapes(name, "reset", env.reset, jax.random.key(0))
    _check_state(name, start)
    next_shapes = _shapes(name, "step", env.step, start, _action_shape(env))
    _check_same(name, start, next_shapes)


def _check_wrappers(env: object) -> None:
    """Raises ValueError for many environments, or one that begins its next episode by itself."""
    wrapper: Any = env
    while wrapper is not None:
        name = type(wrapper).__name__
        require(
            not name.endswith(_FOREIGN_WRAPPERS),
            f"{name} does what is done here: give the environment that it wraps, its env, "
            "as brax.envs.create(..., auto_reset=False) makes it",
        )
        wrapper = getattr(wrapper, "__dict__", {}).get("env")


def _check_limits(name: str, env: object) -> None:
    """Raises ValueError for a time limit or threshold that is none."""
    # Both are read before either is checked: reading one may raise the user's own error.
    limit = _attribute(name, env, "max_episode_steps")
    threshold = _attribute(name, env, "reward_threshold")
    if limit is not None:
        _require_count(f"{name}.max_episode_steps", limit)
    is_number = isinstance(threshold, numbers.Real) and not checks.is_nan(threshold)
    require(
        threshold is None or is_number,
        f"{name}.reward_threshold must be a number or None, got {threshold!r}",
    )


def _check_action_space(name: str, env: Environment) -> None:
    """Raises ValueError for actions that cannot be drawn."""
    size = env.action_size
    space = _attribute(name, env, "action_space")
    _require_count(f"{name}.action_size", size)
    if isinstance(space, Discrete):
        require(
            space.num_actions == size,
            f"{name}.action_size is {size}, but its action_space has {space.num_actions} actions",
        )
    elif isinstance(space, Box):
        require(
            _are_bounds(space, size),
            f"{name}.action_space must have low < high, of {size} entries each as action_size "
            f"says, got low {space.low} and high {space.high}",
        )
    else:
        # A space of Gymnasium has the same name and other fields: the message says whose it is.
        require(
            space is None,
            f"{name}.action_space is a {type(space).__module__}.{type(space).__name__}; "
            "make it a mjx_reinforce.Box(low, high) or mjx_reinforce.Discrete(num_actions)",
        )


def _attribute(name: str, env: object, attribute: str) -> Any:
    """Returns what an environment says of itself, None if it says nothing."""
    try:
        return getattr(env, attribute, None)
    except Exception as error:  # it may be a property, the user's code
        raise BadEnvironmentError(f"{name}.{attribute} fails: {checks.explain(error)}") from error


def _require_count(name: str, value: Any) -> None:
    """Raises ValueError for what is no whole number, 1 or more; True is none."""
    is_whole = isinstance(value, numbers.Integral) and not isinstance(value, bool)
    is_count = is_whole and int(value) >= 1
    require(is_count, f"{name} must be a whole number, 1 or more, got {value!r}")


def _are_bounds(space: Box, size: int) -> bool:
    """Returns whether a space has two vectors of numbers [size], the lower one below the other."""
    try:
        low = np.asarray(space.low, float)
        high = np.asarray(space.high, float)
    except (TypeError, ValueError):
        return False
    return low.shape == high.shape == (size,) and bool(np.all(low < high))


def _shapes(name: str, method: str, function: Callable[..., Any], *arguments: PyTree) -> Any:
    """Returns the shapes of what a method returns."""
    try:
        return shapes(function, *arguments)
    except BadEnvironmentError:
        raise
    except (Exception, SystemExit) as error:  # it is the user's code, which may raise anything
        remedy = _ADVICE if isinstance(error, _VALUE_ERRORS) else ""
        raise BadEnvironmentError(
            f"{name}.{method} fails: {checks.explain(error)}{remedy}"
        ) from error


def _action_shape(env: Environment) -> jax.ShapeDtypeStruct:
    if isinstance(action_space(env), Discrete):
        return jax.ShapeDtypeStruct((), jnp.int32)
    return jax.ShapeDtypeStruct((env.action_size,), jnp.result_type(float))


def _check_state(name: str, start: PyTree) -> None:
    """Raises ValueError for a state without a vector ``obs``, a scalar ``reward`` and ``done``."""
    for field, axes, shape, remedy in (
        ("obs", 1, "a vector [O]", "concatenate its parts"),
        ("reward", 0, "a scalar []", "sum it, or take an entry"),
        ("done", 0, "a scalar []", "reduce it, as with jnp.any"),
    ):
        value = getattr(start, field, None)
        complaint = f"there is no {field}" if value is None else f"it is {described(value)}"
        require(
            hasattr(value, "shape"),
            f"{name}.reset must return a state whose {field} is {shape}, and {complaint}; "
            "brax.envs.State has all that is needed",
        )
        leaf: Any = value
        sizes = list(leaf.shape)
        # An axis without entries would give a policy nothing to see.
        require(
            len(sizes) == axes and 0 not in sizes,
            f"the {field} of {name}.reset must be {shape}, its shape is {sizes}; {remedy}",
        )
        require(
            jnp.isrealobj(leaf),
            f"the {field} of {name}.reset must hold real numbers, it holds {leaf.dtype}",
        )


def _check_same(name: str, start: PyTree, next_shapes: PyTree) -> None:
    """Raises ValueError if ``step`` returns a state of another kind than ``reset``."""
    reset_leaves = _paths(start)
    step_leaves = _paths(next_shapes)
    orphans = [f"{path} only after reset" for path in reset_leaves if path not in step_leaves]
    orphans += [f"{path} only after step" for path in step_leaves if path not in reset_leaves]
    # Trees of the same leaves may still differ, as a tuple and a list do.
    message = f"{name}.step must return a state with the entries that reset's has"
    if orphans:
        message = f"{message}: {', '.join(orphans[:4])}"
    require(jax.tree.structure(start) == jax.tree.structure(next_shapes), message)
    for (path, x), y in zip(reset_leaves.items(), step_leaves.values(), strict=True):
        # May a new value be kept in place of an old one, as ``hold`` does?
        is_kept = x.dtype == y.dtype or jnp.promote_types(x.dtype, y.dtype) == x.dtype
        require(
            x.shape == y.shape and is_kept,
            f"{name}.step must return a state like reset's: {path} is {described(x)} after "
            f"reset, and {described(y)} after step",
        )


def _paths(tree: PyTree) -> dict[str, Any]:
    """Returns the leaves by where they are."""
    leaves = jax.tree_util.tree_flatten_with_path(tree)[0]
    return {jax.tree_util.keystr(path).lstrip("."): leaf for path, leaf in leaves}


def described(value: Any) -> str:
    """Returns the dtype and shape of an array, or the type of what is none."""
    if hasattr(value, "shape"):
        return f"{value.dtype}{list(value.shape)}"
    return f"a {type(value).__name__}"


def check_policy(
    act: Act, params: PyTree, distribution: Acts, observation: jax.ShapeDtypeStruct
) -> None:
    """Raises ValueError for a policy whose outputs are not the distribution's parameters.

    Args:
      act: (params, observation [O]) -> outputs [K].
      params: what ``act`` reads.
      distribution: the family whose parameters the outputs are.
      observation: shape and dtype of one.
    """
    if not callable(act):
        raise ValueError(f"act must be a function, such as learner.act, got a {type(act).__name__}")
    if not isinstance(distribution, Acts):
        raise ValueError(
            "distribution must have the functions noise, sample and mode, as "
            f"learner.policy.distribution has, got {distribution!r}"
        )
    shape = jax.eval_shape(act, params, observation).shape
    # A family need not say how long its outputs are; then any length may be right.
    num_outputs = getattr(distribution, "num_outputs", None)
    num_constants = len(getattr(distribution, "constants", ()))
    if num_outputs is None or shape == (num_outputs + num_constants,):
        return
    constants = ""
    if num_constants:
        constants = f", and behind them {num_constants} that no observation changes"
    raise ValueError(
        f"act must return [{num_outputs + num_constants}] outputs of one observation: "
        f"{num_outputs} that a network computes{constants} (they start at "
        f"distribution.constants); it returns the shape {list(shape)}"
    )


def check_shape(name: str, value: object, *shapes: tuple[int, ...], remedy: str = "") -> None:
    """Raises ValueError for an array whose shape is none of those it may have.

    Args:
      name: what it is called, for the message.
      value: what the user gave.
      *shapes: those that it may have.
      remedy: what to do instead, for the message.
    """
    if shape_of(value) not in shapes:
        shape_words = " or ".join(str(list(shape)) for shape in shapes)
        raise ValueError(f"{name} must be {shape_words}, got {in_words(value)}{remedy}")


def shape_of(value: Any) -> tuple[int, ...] | None:
    """Returns the shape of a number or an array, or None for what is neither."""
    if isinstance(value, bool | int | float):
        return ()
    return tuple(value.shape) if hasattr(value, "shape") else None


def in_words(value: object) -> str:
    """Returns the shape of what was given, for a message, or what it is instead of an array."""
    if isinstance(value, tuple | list):
        return f"a {type(value).__name__} of {len(value)}"
    shape = shape_of(value)
    if shape is None:
        return f"{value!r}"[:80]
    return f"the shape {list(shape)}"
