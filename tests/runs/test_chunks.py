"""What the runs of a chunk have measured so far."""

import numpy as np
import pytest

from mjx_reinforce.settings.config import Config
from mjx_reinforce.training.record import ChunkRecord, Runs
from mjx_reinforce.training.slots import Measured

CONFIG = Config(num_seeds=4, env_steps=100, max_updates=10)
RUNS = Runs("000-0000", np.zeros(4, int), np.zeros(4, int), np.arange(4))


def measured(runs, returns, lengths, active=(), env_steps=(), broken=()):
    """An evaluation, and the updates after it: [K, n] each."""
    looked = {"eval_return": np.array(returns), "eval_steps": np.array(lengths)}
    metrics = {"active": np.array(active, bool), "env_steps": np.array(env_steps, np.int32)}
    metrics |= {"nonfinite_episodes": np.array(broken), "skipped_update": np.array(broken)}
    return Measured(np.array(runs), metrics if len(active) else {}, looked)


def filled():
    record = ChunkRecord(CONFIG, RUNS)
    record.add([measured([2, 0, 1, 3], [3.0, 1, 2, 4], [30, 10, 20, 40])], 0.5)
    one = measured([3, 1], [7, 8], [5, 6], [[1, 1], [1, 1]], [[70, 20], [60, 30]], [[1, 0], [0, 0]])
    # In the second block the budget of run 3 is used.
    other = measured([3, 1], [0, 9], [0, 7], [[0, 1], [0, 1]], [[0, 5], [0, 5]], [[0, 1], [9, 1]])
    record.add([one, other], 1.5)
    return record


def test_runs_that_make_no_update_repeat_their_last():
    record = filled()
    assert record.curves()["eval_return"].tolist() == [[1, 2, 3, 4], [1, 8, 3, 7], [1, 9, 3, 7]]
    assert record.curves()["env_steps"].tolist() == [[0] * 4, [0] * 4, [0, 50, 0, 0]]
    assert not record.is_evaluated()
    record.add([measured([0, 1, 2, 3], [5, 6, 7, 8], [1, 2, 3, 4])], 2.0)
    assert record.curves()["env_steps"][-1].tolist() == [0, 60, 0, 130]
    assert record.is_evaluated()


def test_measurements_add_up():
    record = filled()
    moved, lengths = record.moved()
    assert moved.tolist() == [True, True, True, False]
    assert lengths.tolist() == [10, 7, 30, 5]
    assert record.nonfinite.tolist() == [0, 2, 0, 1]
    assert record.updates.tolist() == [0, 4, 0, 2]


def test_the_share_is_the_mean_of_all_budgets():
    now = filled().progress()
    assert now.fraction == pytest.approx((0.6 + 1.0) / 4)
    assert (now.updates, now.env_steps, now.num_seeds) == (4, 190 / 4, 4)
    assert now.worst == 1
    assert now.latest_per_second == 190
    assert now.env_steps_per_second == pytest.approx(190 / 1.5)


def test_a_record_is_restored():
    record, copy = filled(), ChunkRecord(CONFIG, RUNS)
    assert not copy.is_evaluated()
    copy.restore({name: x.copy() for name, x in record.arrays().items()})
    for each in (record, copy):
        each.add([measured([0], [5], [3], [[1]], [[99]], [[0]])], 2.0)
    one, other = record.arrays(), copy.arrays()
    assert one.keys() == other.keys()
    assert all(np.array_equal(one[name], other[name]) for name in one)
