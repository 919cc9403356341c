"""Runs that go on with another budget, from the last states of the chunks that they were in."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mjx_reinforce.runs import checkpoint
from mjx_reinforce.runs.config import MAX_COUNT
from mjx_reinforce.runs.state import RunState
from mjx_reinforce.sweeps.chunks import Runs
from mjx_reinforce.sweeps.results import SweepFiles


def last_states(
    files: SweepFiles,
    chunks: Sequence[Runs],
    like: Sequence[RunState],
    say: Callable[[str], None],
) -> RunState:
    """Returns the last states of the runs of several chunks, side by side.

    Args:
      files: of the sweep.
      chunks: which ended, and were kept.
      like: the shapes of the slots of a chunk.
      say: shows a line about a damaged file.

    Raises:
      ValueError: the states of a chunk are not there.
    """
    states = []
    for runs in chunks:
        folder = files.checkpoints(runs.name)
        found = next(checkpoint.load(folder, list(like), say), None)
        if found is None:
            raise ValueError(f"the last states in {folder} are damaged; start another sweep")
        states.append(_take(_join(found.state), np.arange(len(runs.seed))))
    return _join(states)


def gather(
    states: RunState, of: Sequence[Runs], runs: Runs, width: int, slots: int
) -> list[RunState]:
    """Returns the chunk of some runs, filled up with runs that stand still.

    Args:
      states: of the runs of the chunks ``of``, side by side.
      of: these chunks.
      runs: those that go on.
      width: of a slot.
      slots: how many.
    """
    keys = [(c, s) for old in of for c, s in zip(old.configuration, old.seed, strict=True)]
    place = {key: i for i, key in enumerate(keys)}
    chosen = [place[key] for key in zip(runs.configuration, runs.seed, strict=True)]
    size = width * slots
    chunk = _take(states, np.resize(chosen, size))
    padding = np.arange(size) >= len(chosen)
    used = jnp.where(padding, MAX_COUNT, chunk.env_steps)
    chunk = dataclasses.replace(chunk, env_steps=used)
    return [_take(chunk, np.arange(i, i + width)) for i in range(0, size, width)]


def _take(states: RunState, index: np.ndarray) -> RunState:
    return jax.tree.map(lambda x: x[index], states)


def _join(states: Sequence[Any]) -> RunState:
    return jax.tree.map(lambda *xs: jnp.concatenate(xs), *states)
