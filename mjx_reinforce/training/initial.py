"""Policies that a run begins with: the last policies of another run."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mjx_reinforce.policies.actor import Actor
from mjx_reinforce.settings.config import Config, flag
from mjx_reinforce.training.state import RunState

#: Settings of a policy that only say how its first parameters were drawn.
_DRAWN = ("initial_std", "initializer", "env")


def last_actors(config: Config, policy: Mapping[str, Any]) -> Actor:
    """Returns the actors [S, ...] with which the seeds of a run begin.

    Args:
      config: its settings, with ``init_from``.
      policy: what ``build.policy_settings`` returns.

    Raises:
      ValueError: there is no such run, it has no policies, or they are of another form.
    """
    from mjx_reinforce.export.policy_files import read_policy
    from mjx_reinforce.export.run_files import read_run

    assert config.init_from is not None
    directory = Path(config.init_from)
    run = read_run(directory)
    saved = read_policy(directory / "policy", own=config.policy)
    settings = {field.name for field in dataclasses.fields(Config)}
    for name in sorted(policy, key=lambda name: name in settings):  # what no flag sets goes first
        value, old = policy[name], saved.settings.get(name, policy[name])
        if name not in settings and old != value:
            raise ValueError(
                f"the policies in {directory} are for {run.env}, with {name} {old}, and "
                f"{config.env} has {value}; leave --init-from out, or give a run of {config.env}"
            )
        if name not in _DRAWN and old != value:
            raise ValueError(
                f"the policies in {directory} have {name} {old}, and this run {value}; give "
                f"{flag(name)} that value, or leave --init-from out"
            )
    seeds = np.arange(config.num_seeds) % saved.num_seeds
    return jax.tree.map(lambda x: x[seeds], saved.actor)


def begin_with(state: RunState, actors: Actor) -> RunState:
    """Returns the state of a run before its first update, with actors [S, ...] of another."""
    old = state.train_states.actor
    actor = jax.tree.map(lambda new, like: jnp.asarray(new, like.dtype), actors, old)
    return dataclasses.replace(
        state, train_states=dataclasses.replace(state.train_states, actor=actor)
    )
