"""A budget in time: how many env steps of a seed this machine trains in it."""

import time
from typing import Any

import jax
import numpy as np

from mjx_reinforce.learners import counts
from mjx_reinforce.runs.config import MAX_COUNT
from mjx_reinforce.runs.keys import plain
from mjx_reinforce.runs.state import Budget, Programs, RunState, restored

#: The part of the time in which it is measured, and that is then trained anew.
_PART = 0.03


def env_steps_in(
    seconds: float, programs: Programs, state: RunState, max_updates: int | None
) -> tuple[int, RunState]:
    """Measures how many env steps of a seed fit into a time.

    It trains from a state for a small part of that time. The speed of the second half of that part
    counts: the first updates also have what a device does once, and the shortest episodes.

    Args:
      seconds: the time.
      programs: of the run.
      state: from which it goes on; its memory is used again.
      max_updates: of the run, if any.

    Returns:
      The env steps that the seeds will have played in the mean, and the same state again.
    """
    like = jax.eval_shape(lambda: state)
    kept = jax.tree.map(np.array, jax.device_get(jax.tree.leaves(plain(state))))
    most = MAX_COUNT if max_updates is None else max_updates
    budget = Budget(counts.from_int(MAX_COUNT), counts.from_int(most))
    began, past = time.perf_counter(), [(0.0, _played(state))]
    while past[-1][0] < _PART * seconds:
        state, metrics, _ = programs.advance(state, False, budget)
        past.append((time.perf_counter() - began, _played(state)))
        if not metrics["active"].any():
            break
    half = next(x for x in past if x[0] >= past[-1][0] / 2) if len(past) > 2 else past[0]
    half = past[-2] if half == past[-1] else half
    speed = (past[-1][1] - half[1]) / (past[-1][0] - half[0])
    left = max(seconds - past[-1][0], 0.0)
    steps = max(1, round(past[0][1] + speed * left))
    return min(steps, MAX_COUNT), restored([jax.numpy.array(x) for x in kept], like)


def _played(state: Any) -> float:
    """Returns the env steps of the mean seed."""
    return float(counts.to_int(state.train_states.env_steps).mean())
