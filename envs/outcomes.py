"""Checks of what a task's methods return, while they are traced."""

import dataclasses
import math
from collections.abc import Callable
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
from mujoco import mjx

from mjx_reinforce.engine.base import MjModel
from mjx_reinforce.engine.checks import require
from mjx_reinforce.engine.contract import check_shape, described, in_words, shape_of
from mjx_reinforce.envs.models import RANDOM
from mjx_reinforce.envs.refusals import UnsupportedError

#: The names of an ``mjx.Model``, which no quantity of a task may have.
_MODEL_FIELDS = frozenset(field.name for field in dataclasses.fields(cast(Any, mjx.Model)))
#: So many draws show what a task moves.
_DRAWS = 8


def check_start(
    name: str, start: object, shapes: dict[str, tuple[int, ...]]
) -> dict[str, jax.Array]:
    """Returns what ``initial`` returned by mjData's names, if it is where an episode can start.

    Args:
      name: of the task.
      start: what it returned: qpos and qvel, or fields by their names.
      shapes: of each field with which an episode may start, as ``starts.start_shapes`` has them.

    Returns:
      The fields without those that have no entries in the model.

    Raises:
      ValueError: it is something else.
    """
    fields: Any = start
    if isinstance(start, tuple | list) and len(start) == 2:
        fields = dict(zip(("qpos", "qvel"), start, strict=True))
    require(
        isinstance(fields, dict),
        f"{name}.initial must return qpos and qvel, a dict of fields of mjData, or the name of a "
        f"key frame, got {in_words(start)}",
    )
    arrays: dict[str, jax.Array] = {}
    for field, value in fields.items():
        require(
            field in shapes,
            f"{name}.initial cannot start with {field!r}; it can with {', '.join(shapes)}",
        )
        shape = shapes[field]
        requirement = f"{name}.initial must return {field} {[*shape]}, as the model has it"
        require(shape_of(value) == shape, f"{requirement}, got {in_words(value)}")
        if math.prod(shape):
            arrays[field] = jnp.asarray(value, jnp.result_type(value, float))  # also of integers
    return arrays


def check_control(name: str, control: Any, action: Any, size: int) -> Any:
    """Returns what ``control`` returned, if it is a control for each actuator.

    Args:
      name: of the task.
      control: what it returned.
      action: [A] what it was given.
      size: nu of the model.

    Raises:
      ValueError: it is something else.
    """
    require(
        shape_of(control) == (size,),
        f"{name}.control must return [{size}], a control for each actuator, got "
        f"{in_words(control)}; an action is {[*action.shape]}, as the action_space says",
    )
    return control


def check_episode(name: str, episode: object, model: MjModel) -> dict[str, jax.Array]:
    """Returns what ``randomize`` returned, as arrays, if it is quantities by their names.

    Args:
      name: of the task.
      episode: what it returned.
      model: the ``MjModel`` of which it may replace fields.

    Raises:
      ValueError: it is something else, or replaces what cannot be replaced.
    """
    is_named = isinstance(episode, dict) and all(isinstance(key, str) for key in episode)
    requirement = f"{name}.randomize must return a dict of quantities by their names"
    require(is_named, f"{requirement}, got {in_words(episode)}")
    arrays: dict[str, jax.Array] = {}
    for key, value in dict(cast(Any, episode)).items():
        quantity = f"{key!r} of {name}.randomize"
        require(shape_of(value) is not None, f"{quantity} must be an array, got {in_words(value)}")
        require(
            key in RANDOM or key not in _MODEL_FIELDS,
            f"{name}.randomize cannot replace {key} of the model; it can replace "
            f"{', '.join(RANDOM)}; a quantity of another kind needs another name",
        )
        arrays[key] = jnp.asarray(value)
        # In the model's dtype: one field in float64 would make all physics of the episode so.
        if key in RANDOM:
            field = getattr(model, key)
            check_shape(quantity, value, field.shape)
            arrays[key] = arrays[key].astype(jnp.result_type(float))
    return arrays


def check_memory(
    name: str, method: str, entries: object, before: dict[str, jax.Array] | None = None
) -> dict[str, jax.Array]:
    """Returns what an episode is to remember, as arrays, if it is entries by their names.

    Args:
      name: of the task.
      method: which of its methods returned the entries.
      entries: what it returned.
      before: what the episode remembered so far, of which shapes and dtypes stay.

    Raises:
      ValueError: it is something else.
    """
    is_named = isinstance(entries, dict) and all(isinstance(key, str) for key in entries)
    requirement = f"{name}.{method} must return a dict of arrays by their names"
    require(is_named, f"{requirement}, got {in_words(entries)}")
    memory = dict(cast(Any, entries))
    for key, value in memory.items():
        dtype = getattr(value, "dtype", type(value))
        is_numeric = dtype in (bool, int, float) or jnp.issubdtype(dtype, np.number)
        entry = f"{key!r} of {name}.{method}"
        require(is_numeric, f"{entry} must be an array of numbers, got {described(value)}")
    if before is None:
        # A number of Python has no dtype of its own, and would be compiled for once more.
        return {key: jnp.asarray(x, jnp.result_type(x)) for key, x in memory.items()}
    require(
        memory.keys() == before.keys(),
        f"{name}.{method} must return what {name}.memory does ({', '.join(before) or 'nothing'}), "
        f"got {', '.join(memory) or 'nothing'}",
    )
    for key, value in memory.items():
        check_shape(f"{key!r} of {name}.{method}", value, before[key].shape)
        dtype = before[key].dtype
        # A count that becomes a fraction would lose it in each step.
        next_dtype = jnp.result_type(dtype, value)
        require(
            next_dtype == dtype,
            f"{key!r} of {name}.{method} must be {dtype}, as {name}.memory returns it, got "
            f"{next_dtype}; return another number there, or write .astype({dtype}) here",
        )
    return {key: jnp.asarray(memory[key], before[key].dtype) for key in before}


def check_push(name: str, push: Any, size: int) -> jax.Array:
    """Returns what ``push`` returned, if it is a change of each velocity.

    Args:
      name: of the task.
      push: what it returned.
      size: nv of the model.

    Raises:
      ValueError: it is something else.
    """
    require(
        shape_of(push) == (size,),
        f"{name}.push must return [{size}], a change of each velocity, got {in_words(push)}",
    )
    return jnp.asarray(push, jnp.result_type(float))


def check_centers(
    name: str, randomize: Callable[[jax.Array], dict[str, Any]], center: jax.Array, model: MjModel
) -> None:
    """Checks that ``randomize`` moves no center of mass that MuJoCo compiled to be a body's origin.

    The inertia matrix then has no entries in which the moved center would show; ``mj_setConst``
    refuses it, too. The bodies that it moves are those of a few draws.

    Args:
      name: of the task.
      randomize: of the task; it replaces ``body_ipos``.
      center: [nbody, 3] the model's ``body_ipos``, in the precision of JAX.
      model: an ``MjModel``.

    Raises:
      UnsupportedError: it does.
    """
    # The check is made while ``draw`` is traced, but it needs numbers.
    with jax.ensure_compile_time_eval():
        keys = jax.random.split(jax.random.key(0), _DRAWS)
        draws = np.asarray(jax.vmap(lambda key: jnp.asarray(randomize(key)["body_ipos"]))(keys))
    has_moved = np.any(draws != np.asarray(center), axis=(0, 2))
    # body_simple is not 0 where MuJoCo takes the body's block of the inertia matrix to be diagonal,
    # also of one degree of freedom or none. The world has no mass.
    has_moved[0] = False
    fixed_bodies = np.flatnonzero(has_moved & (model.body_simple != 0))
    if fixed_bodies.size:
        bodies = ", ".join(model.body(int(body)).name or f"number {body}" for body in fixed_bodies)
        raise UnsupportedError(
            f"body_ipos of {name}.randomize moves the center of mass of a body at whose origin "
            f'MuJoCo took it to be ({bodies}); write <body simple="false"> in the model'
        )


def check_outcome(name: str, outcome: object) -> tuple[Any, Any, dict[str, Any]]:
    """Returns what ``outcome`` returned, if it is a reward, a termination, and terms.

    Args:
      name: of the task.
      outcome: what it returned.

    Raises:
      ValueError: it is something else.
    """
    triple: Any = outcome if isinstance(outcome, tuple | list) else ()
    require(
        len(triple) == 3,
        f"{name}.outcome must return three values, the reward, whether the episode ended, and "
        f"a dict of the reward's terms, got {in_words(outcome)}",
    )
    reward, terminated, terms = triple
    requirement = f"the third value of {name}.outcome must be a dict of the reward's terms"
    require(isinstance(terms, dict), f"{requirement}, got {in_words(terms)}")
    # A reward [1] would broadcast in silence, and give all that follows an axis more.
    scalars = {f"term {key!r}": value for key, value in terms.items()}
    for quantity, value in {"reward": reward, "termination": terminated, **scalars}.items():
        requirement = f"the {quantity} of {name}.outcome must be a scalar []"
        require(
            shape_of(value) == (),
            f"{requirement}, got {in_words(value)}; sum it, or take an entry",
        )
    return reward, terminated, terms
