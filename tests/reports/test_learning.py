"""Pairs by their speed, of results whose numbers are made up."""

import types

import numpy as np

from mjx_reinforce.reports import findings
from mjx_reinforce.statistics.comparisons import holm
from mjx_reinforce.statistics.survival import log_rank


def result(steps=None, *, solved=None, mean=None):
    if steps is None:
        return types.SimpleNamespace(solving=None)
    solved = np.full(len(steps), True) if solved is None else np.asarray(solved)
    value = types.SimpleNamespace(value=steps.mean() if mean is None else mean)
    solving = types.SimpleNamespace(steps=steps, solved=solved, ever=solved.sum(), mean=value)
    return types.SimpleNamespace(solving=solving)


QUICK, SLOW = np.arange(100, 160, 10), np.arange(400, 1000, 100)


def test_speeds_are_log_rank_tests_of_all_pairs():
    solved = [True, True, False, True, True, True]
    results = [result(QUICK), result(SLOW, solved=solved), result(SLOW)]
    speeds = findings.compare_speeds(results)
    assert [*speeds] == [(0, 1), (0, 2), (1, 2)]
    exact = [
        log_rank(*(x for k in pair for x in (results[k].solving.steps, results[k].solving.solved)))
        for pair in ((0, 1), (0, 2), (1, 2))
    ]
    np.testing.assert_allclose([*speeds.values()], holm([x.p_value for x in exact]))
    assert speeds[0, 1] < 0.01 < speeds[1, 2]
    assert findings.compare_speeds([result(), result()]) == {}
    assert findings.compare_speeds([result(QUICK, solved=[False] * 6)] * 2) == {}


def test_the_fastest_has_the_fewest_mean_steps():
    results = [result(SLOW), result(SLOW, mean=1), result(QUICK)]
    assert findings.by_speed(results) == [1, 2, 0]
