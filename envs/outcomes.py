"""Checks of what a task's methods return, while they are traced."""

from typing import Any

import jax
import jax.numpy as jnp

from mjx_reinforce.engine.base import MjModel
from mjx_reinforce.engine.checks import BadEnvironmentError
from mjx_reinforce.envs.models import RANDOM


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


def check_episode(name: str, episode: object, model: MjModel) -> dict[str, jax.Array]:
    """Returns what ``randomize`` returned, as arrays, if it is quantities by their names.

    Args:
      name: of the task.
      episode: what it returned.
      model: the ``mjx.Model`` of which it may replace fields.

    Raises:
      ValueError: it is something else, or replaces what cannot be replaced.
    """
    if not isinstance(episode, dict) or not all(isinstance(key, str) for key in episode):
        raise BadEnvironmentError(
            f"{name}.randomize must return a dict of quantities by their names, "
            f"got {_shape_in_words(episode)}"
        )
    arrays = {}
    for key, value in episode.items():
        if _shape(value) is None:
            raise BadEnvironmentError(
                f"{key!r} of {name}.randomize must be an array, got {_shape_in_words(value)}"
            )
        arrays[key] = jnp.asarray(value)
        if key in RANDOM:
            field = getattr(model, key)
            check_shape(f"{key!r} of {name}.randomize", value, field.shape)
            arrays[key] = arrays[key].astype(field.dtype)
        elif hasattr(model, key):
            raise BadEnvironmentError(
                f"{name}.randomize cannot replace {key} of the model; it can replace "
                f"{', '.join(RANDOM)}; a quantity of another kind needs another name"
            )
    return arrays


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
