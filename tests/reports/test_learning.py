"""Pairs by their speed, of results whose numbers are made up."""

import types

import numpy as np

from mjx_reinforce.reports import findings
from mjx_reinforce.statistics.comparisons import holm
from mjx_reinforce.statistics.survival import log_rank

SEEDS = np.arange(6)
UNTIL = 1000


def result(base, *, seed=SEEDS, steps=None, solved=None, mean=None):
    """Scores about ``base``, areas at a tenth of it."""
    rng = np.random.default_rng(round(base))
    scores = base + rng.normal(size=len(seed))
    solving = None
    if steps is not None:
        steps, given = np.asarray(steps), [True] * len(seed)
        value = types.SimpleNamespace(value=steps.mean() if mean is None else mean)
        solved = np.asarray(given if solved is None else solved)
        solving = types.SimpleNamespace(steps=steps, solved=solved, mean=value)
    configuration = types.SimpleNamespace(seed=np.asarray(seed))
    return types.SimpleNamespace(
        configuration=configuration, scores=scores, areas=scores / 10, solving=solving
    )


QUICK, SLOW = np.arange(100, 160, 10), np.arange(400, 1000, 100)


def test_speeds_are_log_rank_tests_of_all_pairs():
    solved = [True, True, False, True, True, True]
    results = [result(9, steps=QUICK), result(8, steps=SLOW, solved=solved), result(7, steps=SLOW)]
    speeds = findings.compare_learning(results, UNTIL).speeds
    assert [(x.first, x.second) for x in speeds] == [(0, 1), (0, 2), (1, 2)]
    exact = [
        log_rank(*(x for k in pair for x in (results[k].solving.steps, results[k].solving.solved)))
        for pair in ((0, 1), (0, 2), (1, 2))
    ]
    np.testing.assert_allclose([x.p_value for x in speeds], [x.p_value for x in exact])
    np.testing.assert_allclose([x.adjusted for x in speeds], holm([x.p_value for x in exact]))
    assert speeds[0].p_value < 0.01 < speeds[2].p_value


def test_areas_are_compared_on_the_seeds_that_all_have():
    results = [result(9), result(5, seed=[5, 4, 3, 2, 7, 8]), result(7, seed=[2, 3, 4, 5])]
    found = findings.compare_learning(results, UNTIL)
    assert (found.until, found.speeds, len(found.areas)) == (UNTIL, [], 3)
    alone = findings.compare_learning([result(9), result(8, seed=[5, 6, 7, 8, 9, 10])], UNTIL)
    assert alone.areas == []
    assert findings.compare_learning([result(9)], UNTIL).areas == []


def test_no_more_than_the_best_are_compared(monkeypatch):
    monkeypatch.setattr(findings, "COMPARED", 2)
    results = [result(k, steps=QUICK) for k in (9, 8, 7)]
    found = findings.compare_learning(results, UNTIL)
    assert (len(found.speeds), len(found.areas)) == (1, 1)


def test_the_fastest_has_the_fewest_mean_steps():
    steps = [
        result(9, steps=SLOW),
        result(8),
        result(7, steps=SLOW, mean=1),
        result(6, steps=QUICK),
    ]
    assert findings.fastest(steps) == 2
    assert findings.fastest([result(9), result(8)]) == 0
