"""Environments whose physics C MuJoCo computes, on the cores of the CPU.

An environment offers this by two names: ``in_c_mujoco()`` returns the same task with its physics
computed by C MuJoCo, and ``best_in_c_mujoco`` says in a few words why nothing here is faster.
"""

import copy
from typing import Any

from mjx_reinforce.engine.base import Environment
from mjx_reinforce.engine.memory import num_cores


def played_by_c(env: Environment) -> Environment | str:
    """Returns an environment with its physics computed by C MuJoCo, or why that is not possible.

    The wrappers around it are copied.
    """
    task = innermost(env)
    if not hasattr(task, "in_c_mujoco"):
        return "it simulates no model of MuJoCo's"
    try:
        return _with_innermost(env, task.in_c_mujoco())
    except ValueError as error:
        return str(error)


def innermost(env: Any) -> Any:
    """Returns the environment that wrappers are around."""
    while hasattr(env, "env"):
        env = env.env
    return env


def _with_innermost(env: Any, task: Any) -> Any:
    """Returns an environment with another in the place of its innermost."""
    if not hasattr(env, "env"):
        return task
    # The user's own wrapper stays around the environment that it was made for.
    wrapper = copy.copy(env)
    wrapper.env = _with_innermost(env.env, task)
    return wrapper


def why_best(env: Environment) -> str | None:
    """Returns in a few words why no other engine plays an environment faster; None if one does."""
    return getattr(innermost(env), "best_in_c_mujoco", None)


def in_words(reason: str) -> str:
    """Returns what plays an environment, and why, for people."""
    count = num_cores()
    unit = "core" if count == 1 else "cores"
    return f"C MuJoCo on {count} {unit}: {reason}"
