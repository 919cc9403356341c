"""Checks of what a task's methods return, while they are traced."""

from typing import Any

import jax.numpy as jnp

from mjx_reinforce.checks import BadEnvironmentError


def check_start(name: str, start: object, sizes: tuple[int, int]) -> tuple[Any, Any]:
    """Returns what ``initial`` returned, if it is positions and velocities.

    Args:
      name: of the task.
      start: what it returned.
      sizes: nq and nv of the model.

    Raises:
      ValueError: it is something else.
    """
    if not (isinstance(start, tuple | list) and len(start) == 2):
        raise BadEnvironmentError(
            f"{name}.initial must return qpos and qvel, got {_shape_in_words(start)}"
        )
    for what, value, size in zip(("qpos", "qvel"), start, sizes, strict=True):
        if _shape(value) != (size,):
            raise BadEnvironmentError(
                f"{name}.initial must return {what} [{size}], as the model has it, "
                f"got {_shape_in_words(value)}"
            )
    qpos, qvel = (jnp.asarray(x, jnp.result_type(x, float)) for x in start)  # also of integers
    return qpos, qvel


def check_shape(name: str, value: object, expected: tuple[int, ...]) -> None:
    """Raises ValueError for an array of another shape."""
    if _shape(value) != expected:
        raise ValueError(f"{name} must be {list(expected)}, got {_shape_in_words(value)}")


def check_outcome(name: str, outcome: object) -> tuple[Any, Any, dict[str, Any]]:
    """Returns what ``outcome`` returned, if it is a reward, a termination, and terms.

    Args:
      name: of the task.
      outcome: what it returned.

    Raises:
      ValueError: it is something else.
    """
    if not (isinstance(outcome, tuple | list) and len(outcome) == 3):
        raise BadEnvironmentError(
            f"{name}.outcome must return three values, the reward, whether the episode ended, and "
            f"a dict of the reward's terms, got {_shape_in_words(outcome)}"
        )
    reward, terminated, terms = outcome
    if not isinstance(terms, dict):
        raise BadEnvironmentError(
            f"the third value of {name}.outcome must be a dict of the reward's terms, "
            f"got {_shape_in_words(terms)}"
        )
    named = {f"term {key!r}": value for key, value in terms.items()}
    for what, value in {"reward": reward, "termination": terminated, **named}.items():
        if _shape(value) != ():
            raise BadEnvironmentError(
                f"the {what} of {name}.outcome must be a scalar [], got {_shape_in_words(value)}; "
                "sum it, or take an entry"
            )
    return reward, terminated, terms


def _shape(value: Any) -> tuple[int, ...] | None:
    """Returns the shape of a number or an array, or None for what is neither."""
    if isinstance(value, bool | int | float):
        return ()
    return tuple(value.shape) if hasattr(value, "shape") else None


def _shape_in_words(value: object) -> str:
    if isinstance(value, tuple | list):
        return f"a {type(value).__name__} of {len(value)}"
    shape = _shape(value)
    return f"{value!r}"[:80] if shape is None else f"the shape {list(shape)}"
