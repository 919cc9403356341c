"""How much of its budget a run has used, and how much a budget in time is on this machine."""

import time

import jax
import jax.numpy as jnp
import numpy as np

from mjx_reinforce.learners import counts
from mjx_reinforce.settings.config import MAX_COUNT, Config
from mjx_reinforce.training.programs import RunPrograms
from mjx_reinforce.training.state import Budget, RunState


def used(config: Config, env_steps: np.ndarray, updates: np.ndarray) -> np.ndarray:
    """Returns the fraction of its budget that each seed has used, of counts [..., S]."""
    fraction = np.zeros(env_steps.shape)
    if config.env_steps is not None:
        fraction = env_steps / config.env_steps
    if config.max_updates is not None:
        fraction = np.maximum(fraction, updates / config.max_updates)
    return fraction


#: The part of the time in which its speed is measured; what is trained in it is trained again.
_PART = 0.03


def env_steps_in(
    seconds: float, programs: RunPrograms, state: RunState, max_updates: int | None
) -> int:
    """Returns the env steps that a mean seed will have played in all after a time.

    A copy of the state is trained, and evaluated, for a small part of that time. The speed of the
    second half of that part counts: the first updates also have what a device does once, and the
    shortest episodes.

    Args:
      seconds: the time.
      programs: of the run.
      state: from which it goes on.
      max_updates: of the run, if any.
    """
    budget = Budget.of(None, max_updates)
    copy = jax.tree.map(jnp.copy, state)
    began, past = time.perf_counter(), [(0.0, _played(state))]
    going = True
    while going and past[-1][0] < _PART * seconds:
        copy, metrics, _ = programs.advance(copy, True, budget)
        past.append((time.perf_counter() - began, _played(copy)))
        going = bool(metrics["active"].any())
    end, played = past[-1]
    half, before = next((x for x in past[1:-1] if x[0] >= end / 2), past[-2])
    speed = (played - before) / (end - half)
    return min(max(1, round(past[0][1] + speed * max(seconds - end, 0.0))), MAX_COUNT)


def _played(state: RunState) -> float:
    """Returns the env steps of the mean seed."""
    return float(counts.to_int(state.train_states.env_steps).mean())
