"""Runs that go on from the last states of the chunks that they were in."""

from types import SimpleNamespace

import jax
import numpy as np
import pytest

from mjx_reinforce.sweeps import results
from mjx_reinforce.sweeps.chunks import Runs
from mjx_reinforce.training import checkpoint
from mjx_reinforce.training.checkpoint import Checkpoint

FIRST = Runs("0-0", np.array([0, 1]), np.array([4, 5]), np.array([0, 0]))
SECOND = Runs("0-1", np.array([0, 1, 1]), np.array([4, 5, 5]), np.array([1, 1, 2]))


@pytest.fixture
def files(tmp_path):
    """A sweep whose runs have states that say which they are: 10 configuration + seed."""
    for runs in (FIRST, SECOND):
        state = {"run": (10 * runs.configuration + runs.seed).astype(np.int32)}
        content = Checkpoint(state, {"updates": np.ones(len(runs.seed))}, 0.0, 0, None, 1)
        checkpoint.save(tmp_path / runs.name, content, even=True)
    return SimpleNamespace(checkpoints=lambda chunk: tmp_path / chunk)


def shape_of(number):
    return {"run": jax.ShapeDtypeStruct((number,), np.int32)}


def test_states_lie_side_by_side_and_runs_find_theirs(files):
    states = results.last_states(files, [FIRST, SECOND], shape_of, pytest.fail)
    assert states["run"].tolist() == [40, 50, 41, 51, 52]
    on = Runs("1-0", np.array([0, 0]), np.array([5, 4]), np.array([2, 1]))
    assert results.select_runs(states, [FIRST, SECOND], on)["run"].tolist() == [52, 41]


def test_a_run_that_was_in_no_chunk_has_no_state(files):
    states = results.last_states(files, [FIRST], shape_of, pytest.fail)
    with pytest.raises(KeyError):
        results.select_runs(states, [FIRST], SECOND)


def test_damaged_states_are_named(files):
    said = []
    [path] = files.checkpoints("0-1").iterdir()
    path.write_bytes(path.read_bytes()[:-9])
    with pytest.raises(ValueError, match=r"0-1 are damaged; start another sweep"):
        results.last_states(files, [FIRST, SECOND], shape_of, said.append)
    assert len(said) == 1
    assert path.name in said[0]
