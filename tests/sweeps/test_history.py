"""What the runs of a chunk have measured so far."""

import numpy as np
import pytest

from mjx_reinforce.settings.config import Config
from mjx_reinforce.sweeps.chunks import History
from mjx_reinforce.sweeps.programs import Measured

CONFIG = Config(num_seeds=4, env_steps=100, max_updates=10)


def measured(runs, **values):
    return Measured(np.array(runs), {name: np.array(x) for name, x in values.items()})


def filled():
    history = History(CONFIG)
    first = measured([2, 0, 1, 3], eval_return=[3.0, 1.0, 2.0, 4.0], eval_steps=[30, 10, 20, 40])
    history.keep([first], 0.5)
    shared = {"eval_steps": [5, 6], "updates": [5, 5]}
    one = measured([3, 1], eval_return=[7, 8], env_steps=[130, 50], nonfinite=[1, 0], **shared)
    other = measured(
        [1], eval_return=[9], eval_steps=[7], updates=[7], env_steps=[60], nonfinite=[2]
    )
    history.keep([one, other], 1.5)
    return history


def test_runs_that_are_not_moved_repeat_their_last():
    history = filled()
    assert history.curves()["eval_return"].tolist() == [[1, 2, 3, 4], [1, 8, 3, 7], [1, 9, 3, 7]]
    assert history.curves()["env_steps"].tolist() == [[0] * 4, [0] * 4, [0, 50, 0, 0]]
    assert not history.evaluated()
    last = measured([0, 1, 2, 3], eval_return=[5, 6, 7, 8], eval_steps=[1, 2, 3, 4])
    history.keep([last], 2.0)
    assert history.curves()["env_steps"][-1].tolist() == [0, 60, 0, 130]
    assert history.evaluated()


def test_measurements_add_up():
    history = filled()
    assert history.now["eval_steps"].tolist() == [10, 7, 30, 5]
    assert history.now["nonfinite"].tolist() == [0, 2, 0, 1]
    assert history.training().tolist() == [True, True, True, False]


def test_used_is_the_mean_share_of_all_budgets():
    now = filled().progress()
    assert now.fraction == pytest.approx((0.7 + 1.0) / 4)
    assert (now.updates, now.env_steps, now.num_seeds) == (7, 190 / 4, 4)
    assert now.worst == 1
    assert now.latest_per_second == 190
    assert now.env_steps_per_second == pytest.approx(190 / 1.5)


def test_a_history_is_restored():
    history, copy = filled(), History(CONFIG)
    assert not copy.evaluated()
    copy.restore({name: x.copy() for name, x in history.arrays().items()})
    for each in (history, copy):
        each.keep([measured([0], eval_return=[5], updates=[9], env_steps=[99])], 2.0)
    one, other = history.arrays(), copy.arrays()
    assert one.keys() == other.keys()
    assert all(np.array_equal(one[name], other[name]) for name in one)
