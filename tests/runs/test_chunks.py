"""What the runs of a part of a sweep have measured so far."""

import numpy as np
import pytest

from mjx_reinforce.settings.config import Config
from mjx_reinforce.training.record import Measured, Record

CONFIG = Config(num_seeds=4, env_steps=100, max_updates=10)


def measured(runs, returns, lengths, active=(), env_steps=(), broken=()):
    """An evaluation, and the updates after it: [K, n] each."""
    eval_metrics = {"eval_return": np.array(returns), "eval_steps": np.array(lengths)}
    metrics = {"active": np.array(active, bool), "env_steps": np.array(env_steps, np.int32)}
    metrics |= {"nonfinite_episodes": np.array(broken), "skipped_update": np.array(broken)}
    return Measured(np.array(runs), metrics if len(active) else {}, eval_metrics)


def add(record, measured, seconds):
    record.add_evaluation(measured, seconds)
    if measured.metrics:
        record.add_updates(measured)


def filled():
    record = Record(CONFIG)
    add(record, measured([2, 0, 1, 3], [3.0, 1, 2, 4], [30, 10, 20, 40]), 0.5)
    one = measured([3, 1], [7, 8], [5, 6], [[1, 1], [1, 1]], [[70, 20], [60, 30]], [[1, 0], [0, 0]])
    # In the second block the budget of run 3 is used.
    other = measured([3, 1], [0, 9], [0, 7], [[0, 1], [0, 1]], [[0, 5], [0, 5]], [[0, 1], [9, 1]])
    add(record, one, 1.5)
    add(record, other, 2.5)
    return record


def test_runs_that_make_no_update_repeat_their_last():
    record = filled()
    assert record.history()["eval_return"].tolist() == [[1, 2, 3, 4], [1, 8, 3, 7], [1, 9, 3, 7]]
    assert record.history()["env_steps"].tolist() == [[0] * 4, [0] * 4, [0, 50, 0, 0]]
    assert not record.is_evaluated()
    add(record, measured([0, 1, 2, 3], [5, 6, 7, 8], [1, 2, 3, 4]), 3.0)
    assert record.history()["env_steps"][-1].tolist() == [0, 60, 0, 130]
    assert record.is_evaluated()


def test_measurements_add_up():
    record = filled()
    moved, lengths = record.moved()
    assert moved.tolist() == [True, True, True, False]
    assert lengths.tolist() == [10, 7, 30, 5]
    assert record.nonfinite.tolist() == [0, 2, 0, 1]
    assert record.updates.tolist() == [0, 4, 0, 2]


def test_progress_is_what_the_runs_have_made_and_last_returned():
    record = filled()
    now = record.progress_at(0.5, seconds=2.5, gained_fraction=0.25, seconds_passed=3.0)
    assert record.used().tolist() == pytest.approx([0, 0.6, 0, 1.3])
    assert now == (0.5, 4, 190 / 4, now.iqm, 1, 0, 4, 190 / 2.5, 6)
