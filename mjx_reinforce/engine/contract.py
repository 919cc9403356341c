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
_NEED_VALUES = (jax.errors.ConcretizationTypeError, jax.errors.TracerArrayConversionError)
_TRACED = "; it is compiled by JAX: write jnp.where for `if`, and jnp for numpy, math and float()"
#: Ends of names of brax's and Playground's wrappers that map an environment, or reset it where an
#: episode ends: what the last action led to is lost there.
_NOT_HERE = ("AutoResetWrapper", "VmapWrapper")


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
    after = _shapes(name, "step", env.step, start, _action_shape(env))
    _check_same(name, start, after)


def _check_wrappers(env: object) -> None:
    """Raises ValueError for many environments, or one that begins its next episode by itself."""
    wrapper: Any = env
    while wrapper is not None:
        name = type(wrapper).__name__
        require(
            not name.endswith(_NOT_HERE),
            f"{name} does what is done here: give the environment that it wraps, its env, "
            "as brax.envs.create(..., auto_reset=False) makes it",
        )
        wrapper = getattr(wrapper, "__dict__", {}).get("env")


def _check_limits(name: str, env: object) -> None:
    """Raises ValueError for a time limit or threshold that is none."""
    limit, threshold = (_declared(name, env, x) for x in ("max_episode_steps", "reward_threshold"))
    if limit is not None:
        _require_count(f"{name}.max_episode_steps", limit)
    is_number = isinstance(threshold, numbers.Real) and not checks.is_nan(threshold)
    said = f"{name}.reward_threshold must be a number or None, got {threshold!r}"
    require(threshold is None or is_number, said)


def _check_action_space(name: str, env: Environment) -> None:
    """Raises ValueError for actions that cannot be drawn."""
    size, declared = env.action_size, _declared(name, env, "action_space")
    _require_count(f"{name}.action_size", size)
    if isinstance(declared, Discrete):
        count = f"{declared.num_actions} actions"
        said = f"{name}.action_size is {size}, but its action_space has {count}"
        require(declared.num_actions == size, said)
    elif isinstance(declared, Box):
        require(
            _are_bounds(declared, size),
            f"{name}.action_space must have low < high, of {size} entries each as action_size "
            f"says, got low {declared.low} and high {declared.high}",
        )
    else:
        require(
            declared is None,
            f"{name}.action_space is a {type(declared).__module__}.{type(declared).__name__}; "
            "make it a mjx_reinforce.Box(low, high) or mjx_reinforce.Discrete(num_actions)",
        )


def _declared(name: str, env: object, what: str) -> Any:
    """Returns what an environment says of itself, None if it says nothing."""
    try:
        return getattr(env, what, None)
    except Exception as error:  # it may be a property, the user's code
        raise BadEnvironmentError(f"{name}.{what} fails: {checks.explain(error)}") from error


def _require_count(name: str, value: Any) -> None:
    """Raises ValueError for what is no whole number, 1 or more; True is none."""
    whole = isinstance(value, numbers.Integral) and not isinstance(value, bool)
    require(whole and int(value) >= 1, f"{name} must be a whole number, 1 or more, got {value!r}")


def _are_bounds(space: Box, size: int) -> bool:
    """Returns whether a space has two vectors of numbers [size], the lower one below the other."""
    try:
        low, high = np.asarray(space.low, float), np.asarray(space.high, float)
    except (TypeError, ValueError):
        return False
    return low.shape == high.shape == (size,) and bool(np.all(low < high))


def _shapes(name: str, what: str, function: Callable[..., Any], *arguments: PyTree) -> Any:
    """Returns the shapes of what a method returns."""
    try:
        return shapes(function, *arguments)
    except BadEnvironmentError:
        raise
    except (Exception, SystemExit) as error:  # it is the user's code, which may raise anything
        remedy = _TRACED if isinstance(error, _NEED_VALUES) else ""
        raise BadEnvironmentError(
            f"{name}.{what} fails: {checks.explain(error)}{remedy}"
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
        got = f"there is no {field}" if value is None else f"it is {described(value)}"
        said = f"{name}.reset must return a state whose {field} is {shape}, and {got}; "
        require(hasattr(value, "shape"), f"{said}brax.envs.State has all that is needed")
        array: Any = value
        the_field, found = f"the {field} of {name}.reset must", list(array.shape)
        said = f"{the_field} be {shape}, its shape is {found}; {remedy}"
        require(len(found) == axes and 0 not in found, said)
        said = f"{the_field} hold real numbers, it holds {array.dtype}"
        require(jnp.isrealobj(array), said)


def _check_same(name: str, start: PyTree, after: PyTree) -> None:
    """Raises ValueError if ``step`` returns a state of another kind than ``reset``."""
    before, now = _paths(start), _paths(after)
    only = [f"{path} only after reset" for path in before if path not in now]
    only += [f"{path} only after step" for path in now if path not in before]
    require(
        jax.tree.structure(start) == jax.tree.structure(after),
        f"{name}.step must return a state with the entries that reset's has"
        f"{': ' if only else ''}{', '.join(only[:4])}",
    )
    for (path, old), new in zip(before.items(), now.values(), strict=True):
        # May a new value be kept in place of an old one, as ``hold`` does?
        holds = old.dtype == new.dtype or jnp.promote_types(old.dtype, new.dtype) == old.dtype
        require(
            old.shape == new.shape and holds,
            f"{name}.step must return a state like reset's: {path} is {described(old)} after "
            f"reset, and {described(new)} after step",
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
    found = jax.eval_shape(act, params, observation).shape
    of_network = getattr(distribution, "num_outputs", None)
    constants = len(getattr(distribution, "constants", ()))
    if of_network is not None and found != (of_network + constants,):
        behind = f", and behind them {constants} that no observation changes" if constants else ""
        raise ValueError(
            f"act must return [{of_network + constants}] outputs of one observation: {of_network} "
            f"that a network computes{behind} (they start at distribution.constants); it returns "
            f"the shape {list(found)}"
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
        expected = " or ".join(str(list(shape)) for shape in shapes)
        raise ValueError(f"{name} must be {expected}, got {in_words(value)}{remedy}")


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
    return f"{value!r}"[:80] if shape is None else f"the shape {list(shape)}"
