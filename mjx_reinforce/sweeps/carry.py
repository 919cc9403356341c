"""Runs that go on with another budget, from the last states of the chunks that they were in."""

from collections.abc import Callable, Sequence

import jax
import numpy as np

from mjx_reinforce.sweeps.chunks import Runs
from mjx_reinforce.sweeps.results import SweepFiles
from mjx_reinforce.training import checkpoint
from mjx_reinforce.training.state import RunState


def last_states(
    files: SweepFiles,
    chunks: Sequence[Runs],
    shape_of: Callable[[int], RunState],
    say: Callable[[str], None],
) -> RunState:
    """Returns the last states of the runs of several chunks, side by side.

    Args:
      files: of the sweep.
      chunks: which ended, and were kept.
      shape_of: the shapes of the states of so many runs.
      say: shows a line about a damaged file.

    Raises:
      ValueError: the states of a chunk are not there.
    """
    states = []
    for runs in chunks:
        folder = files.checkpoints(runs.name)
        found = next(checkpoint.read_checkpoints(folder, shape_of(len(runs.seed)), say), None)
        if found is None:
            raise ValueError(f"the last states in {folder} are damaged; start another sweep")
        states.append(jax.device_get(found.state))
    return jax.tree.map(lambda *xs: np.concatenate(xs), *states)


def select_runs(states: RunState, of: Sequence[Runs], runs: Runs) -> RunState:
    """Returns the states of some runs.

    Args:
      states: of the runs of the chunks ``of``, side by side.
      of: these chunks.
      runs: those that go on.
    """
    keys = [(c, s) for old in of for c, s in zip(old.configuration, old.seed, strict=True)]
    place = {key: i for i, key in enumerate(keys)}
    chosen = [place[key] for key in zip(runs.configuration, runs.seed, strict=True)]
    return jax.tree.map(lambda x: x[chosen], states)
