"""Engines: ways to play the same episodes, from the same noise, at different speeds.

``mjx`` maps the environment's step with ``jax.vmap``. ``fused`` writes it out in
scalars and lets XLA fuse what is left (``mjx_reinforce.fused``). Trajectories
agree up to rounding.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from mjx_reinforce import fused
from mjx_reinforce.registry import check_name
from mjx_reinforce.rollouts import rollout
from mjx_reinforce.types import Environment, Trajectory

#: An env step of more operations takes minutes to compile and runs slower than plain MJX.
MAX_OPERATIONS = 20_000
#: On a CPU, branches of more operations are skipped where no episode needs them.
_CPU_BRANCH_COST = 32


class Engine(NamedTuple):
    """A way to play episodes.

    name: "mjx" or "fused"
    why: the reason it was chosen, for people
    rollout: as ``mjx_reinforce.rollouts.rollout``
    """

    name: str
    why: str
    rollout: Callable[..., Trajectory]


NAMES = ("auto", "mjx", "fused")


def choose(name: str, env: Environment) -> Engine:
    """Returns an engine by name; "auto" is the fastest that supports the environment.

    Raises:
      ValueError: the name is unknown, or the engine does not support the environment.
    """
    check_name("engine", name, dict.fromkeys(NAMES))
    if name == "mjx":
        return Engine(name, "chosen by name", rollout)
    # On a GPU a branch costs a look at the predicate by the host, and computing it nothing.
    cost = _CPU_BRANCH_COST if jax.default_backend() == "cpu" else MAX_OPERATIONS
    step = fused.vmap(env.step, in_axes=-1, out_axes=-1, branch_cost=cost)
    reason = unsupported_by_fused(env, step)
    if not reason:
        why = "the env step is small enough to write out" if name == "auto" else "chosen by name"
        return Engine("fused", why, functools.partial(rollout, env_step=step))
    if name == "fused":
        raise ValueError(f"the fused engine does not support this environment: {reason}")
    return Engine("mjx", f"fused does not support this environment: {reason}", rollout)


def unsupported_by_fused(env: Environment, step: Any) -> str | None:
    """Returns why an environment does not run, or not well, on the fused engine; None if it does.

    Nothing is compiled: the step is traced and written out, about a second.

    Args:
      env: the environment.
      step: ``fused.vmap`` of its step, over the last axis.
    """

    def one():
        states = jax.vmap(env.reset, out_axes=-1)(jax.random.split(jax.random.key(0), 1))
        return states, jnp.zeros((env.action_size, 1))

    try:
        written = step.write(*jax.eval_shape(one))
    except (fused.UnsupportedPrimitive, TypeError) as error:
        return str(error)
    count = sum(written.operations.values())
    if count > MAX_OPERATIONS:
        return f"one env step takes {count:,} scalar operations, more than {MAX_OPERATIONS:,}"
    return None
