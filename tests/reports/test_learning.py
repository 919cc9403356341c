"""Pairs by their speed, and main effects of settings, of results whose numbers are made up."""

import types

import numpy as np
import pytest

from mjx_reinforce.reports import learning
from mjx_reinforce.reports.statistics.comparisons import holm, paired_difference
from mjx_reinforce.reports.statistics.survival import log_rank

SEEDS = np.arange(6)
UNTIL = 1000


def result(base, *, seed=SEEDS, steps=None, solved=None, mean=None, **settings):
    """Scores about ``base``, areas at a tenth of it."""
    rng = np.random.default_rng(round(base))
    scores = base + rng.normal(size=len(seed))
    solving = None
    if steps is not None:
        steps, given = np.asarray(steps), [True] * len(seed)
        value = types.SimpleNamespace(value=steps.mean() if mean is None else mean)
        solved = np.asarray(given if solved is None else solved)
        solving = types.SimpleNamespace(steps=steps, solved=solved, mean=value)
    configuration = types.SimpleNamespace(seed=np.asarray(seed), settings=settings)
    return types.SimpleNamespace(
        configuration=configuration, scores=scores, areas=scores / 10, solving=solving
    )


QUICK, SLOW = np.arange(100, 160, 10), np.arange(400, 1000, 100)


def test_speeds_are_log_rank_tests_of_all_pairs():
    solved = [True, True, False, True, True, True]
    results = [result(9, steps=QUICK), result(8, steps=SLOW, solved=solved), result(7, steps=SLOW)]
    speeds = learning.compare_learning(results, UNTIL).speeds
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
    found = learning.compare_learning(results, UNTIL)
    assert (found.until, found.speeds, len(found.areas)) == (UNTIL, [], 3)
    alone = learning.compare_learning([result(9), result(8, seed=[5, 6, 7, 8, 9, 10])], UNTIL)
    assert alone.areas == []
    assert learning.compare_learning([result(9)], UNTIL).areas == []


def test_no_more_than_the_best_are_compared(monkeypatch):
    monkeypatch.setattr(learning, "COMPARED", 2)
    results = [result(k, steps=QUICK) for k in (9, 8, 7)]
    found = learning.compare_learning(results, UNTIL)
    assert (len(found.speeds), len(found.areas)) == (1, 1)


def test_the_fastest_has_the_fewest_mean_steps():
    steps = [
        result(9, steps=SLOW),
        result(8),
        result(7, steps=SLOW, mean=1),
        result(6, steps=QUICK),
    ]
    assert learning.fastest(steps) == 2
    assert learning.fastest([result(9), result(8)]) == 0


GRID = [(rate, size) for size in (32, 64) for rate in (0.1, 0.01, 0.3)]


def crossed(**changes):
    """Rate 0.01 is better by 20, size by nothing but noise."""
    made = [
        result(50 + 20 * (rate == 0.01) + k, steps=SLOW - 300 * (rate == 0.3), rate=rate, size=size)
        for k, (rate, size) in enumerate(GRID)
    ]
    return [x for k, x in enumerate(made) if k not in changes.get("without", ())]


def test_a_level_is_the_mean_over_the_other_settings():
    results = crossed()
    levels = learning.compare_learning(results, UNTIL).levels
    assert [(x.setting, x.value) for x in levels] == [
        *(("rate", value) for value in (0.01, 0.1, 0.3)),
        *(("size", value) for value in (32, 64)),
    ]
    assert [x.number for x in levels] == [2, 2, 2, 3, 3]
    for level in levels:
        members = [x for x in results if x.configuration.settings[level.setting] == level.value]
        means = {
            "return": np.mean([x.scores for x in members]),
            "area": np.mean([x.areas for x in members]),
            "steps": np.mean([np.minimum(x.solving.steps, UNTIL) for x in members]),
        }
        assert level.means.keys() == means.keys()
        for name, mean in means.items():
            np.testing.assert_allclose(float(level.means[name].value), mean)


def test_each_value_is_compared_with_the_best_of_its_setting():
    """The best by steps has the fewest; p values are Holm's over the pairs of all settings."""
    results = crossed()
    levels = learning.compare_learning(results, UNTIL).levels
    best = {name: [x.value for x in levels if x.adjusted[name] is None] for name in levels[0].means}
    assert best["return"] == best["area"] == [0.01, 64]
    assert best["steps"][0] == 0.3

    def mean(setting, value):
        rows = [x.scores for x in results if x.configuration.settings[setting] == value]
        return np.mean(rows, axis=0)

    pairs = [("rate", 0.01, 0.1), ("rate", 0.01, 0.3), ("rate", 0.1, 0.3), ("size", 32, 64)]
    p_values = [float(paired_difference(mean(s, a), mean(s, b)).p_value) for s, a, b in pairs]
    adjusted = holm(p_values)
    found = {(x.setting, x.value): x.adjusted["return"] for x in levels}
    expected = {("rate", 0.1): adjusted[0], ("rate", 0.3): adjusted[1], ("size", 32): adjusted[3]}
    assert {k: v for k, v in found.items() if v is not None} == pytest.approx(expected)


def test_seeds_that_did_not_solve_count_until_the_end():
    solved = [True, True, True, False, False, False]
    results = crossed()
    results[0].solving.solved = np.array(solved)
    results[3].solving.solved = np.array(solved)
    results[3].solving.steps = results[3].solving.steps + 700
    level = learning.compare_learning(results, UNTIL).levels[1]
    assert (level.setting, level.value) == ("rate", 0.1)
    first = np.where(solved, SLOW, UNTIL)
    second = np.where(solved, np.minimum(SLOW + 700, UNTIL), UNTIL)
    np.testing.assert_allclose(float(level.means["steps"].value), (first + second).mean() / 2)


def test_a_value_that_was_not_tried_with_all_others_is_left_out():
    """Size 64 was not tried with every rate: rates are averaged over size 32 alone."""
    levels = learning.compare_learning(crossed(without=[5]), UNTIL).levels
    assert [x.number for x in levels] == [1, 1, 1, 2, 2]


def test_one_setting_or_one_seed_has_no_main_effects(monkeypatch):
    one = [result(k, rate=k) for k in (9, 8)]
    assert learning.compare_learning(one, UNTIL).levels == []
    apart = [result(9, rate=1, size=1), result(8, rate=2, size=1, seed=[5, 6, 7, 8, 9, 10])]
    assert learning.compare_learning(apart, UNTIL).levels == []
    monkeypatch.setattr(learning, "COMPARED", 2)
    levels = learning.compare_learning(crossed(), UNTIL).levels
    assert {x.setting for x in levels} == {"size"}
