"""The comparison with the documents' programs: its statistics by hand, and one run end to end."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from toys import Toy, ToyState

from experiments.studies.reproduce import __main__ as reproduce
from experiments.studies.reproduce.cases import CASES, load_reference
from experiments.studies.reproduce.mistakes import stale_starts
from experiments.studies.reproduce.statistics import compare, rank_test, reached, windowed
from mjx_reinforce import reinforce
from mjx_reinforce.learning.estimators import reward_to_go
from mjx_reinforce.settings.config import check
from mjx_reinforce.settings.defaults import PRESETS

RECORD = {"every_updates": 50, "window_updates": 50, "seeds": {"1": [1.0, 2.0, 3.0], "2": [5.0]}}


def test_windows_end_at_the_count():
    scores = np.arange(6.0).reshape(6, 1) * [1.0, 10.0]
    np.testing.assert_allclose(windowed(scores, 4, 2), [2.5, 25.0])
    np.testing.assert_allclose(windowed(scores, 2, 50), [0.5, 5.0])


def test_seeds_count_as_far_as_they_got():
    np.testing.assert_allclose(reached(RECORD, 50), [1.0, 5.0])
    np.testing.assert_allclose(reached(RECORD, 150), [3.0])


def test_rank_test():
    ours = np.arange(20.0)
    assert rank_test(ours, ours[8:12]) > 0.5
    assert rank_test(ours, np.array([9.5])) > 0.5
    # All of five beyond all of twenty: 2 of the binom(25, 5) = 53130 ways, sampled 9999 times.
    assert rank_test(ours, ours[:5] + 100) <= 0.001
    # One of 21 places, at either end.
    assert rank_test(ours, np.array([100.0])) == pytest.approx(2 / 21, rel=0.15)
    assert rank_test(np.full(20, 50.0), np.full(3, 50.0)) == 1.0


def test_a_comparison_by_hand():
    case = dataclasses.replace(CASES[0], counts=(50,), updates=50)
    scores = np.ones((50, 101)) * np.arange(101.0)
    (row,) = compare(case, "000", RECORD, scores)
    assert (row["episode"], row["ours_mean"], row["theirs_mean"], row["theirs_n"]) == (50, 50, 3, 2)
    assert (row["ours_low"], row["ours_high"]) == (2.5, 97.5)
    assert row["inside"] == 1  # 1 is not, 5 is
    # Of the 103 * 102 / 2 pairs of ranks, 41 have a mean as far out as that of 1 and 5.
    assert row["p_value"] == pytest.approx(41 / 5253, abs=0.004)
    assert row["agrees"] is False
    middle = RECORD | {"seeds": {"1": [40.0], "2": [60.0]}}
    (row,) = compare(case, "000", middle, scores)
    assert (row["theirs_mean"], row["inside"]) == (50, 2)
    assert row["p_value"] > 0.9
    assert row["agrees"] is True


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.title)
def test_a_case_fits_its_record(case):
    reference = load_reference()
    check(reproduce.settings_of(case, 3))
    check(reproduce.settings_of(case, 3, case.repair and case.repair[1]))
    assert case.preset in PRESETS
    assert max(case.counts) <= case.updates
    for name in case.references:
        entry = reference[name]
        assert all(count % entry["every_updates"] == 0 for count in case.counts)
        assert all(len(reached(entry, count)) >= 1 for count in case.counts)
    own = reference[case.references[0]]
    assert len(reached(own, case.counts[-1])) == len(own["seeds"])


@pytest.mark.slow
def test_end_to_end(monkeypatch, capsys):
    case = next(case for case in CASES if case.references == ("002_ars_fixed2",))
    monkeypatch.setattr(reproduce, "CASES", (case,))
    results = reproduce.run(reproduce.Settings(preset=(case.preset,), seeds=3, max_updates=20))
    (row,) = results["agreement"]
    assert (row["document"], row["episode"], row["theirs_n"]) == ("002_ars_fixed2", 400, 3)
    assert 0 < row["ours_low"] <= row["ours_mean"] <= row["ours_high"] <= 50
    assert results["repairs"] == []
    assert f"== {case.title}" in capsys.readouterr().out


class Count(Toy):
    """Three steps; the observation is how many were made, whatever was shown."""

    max_episode_steps = 8

    def reset(self, rng):
        return ToyState(jnp.zeros(1), jnp.zeros(()), jnp.zeros(()), jnp.zeros(()))

    def step(self, state, action):
        count = state.info + 1
        done = jnp.where(count < 3, 0.0, 1.0)
        return ToyState(count[None], state.obs[0], done, count)


@pytest.mark.slow
def test_a_stale_start_shows_the_episode_before():
    """The reward is what was shown before the step: 0 + 1 + 2, then 2 + 1 + 2."""
    settings = {"num_episodes": 1, "normalize_steps": 0, "engine": "vmap"}
    stale = stale_starts(lambda env: reinforce(env, estimator=reward_to_go(), **settings), Count())
    step = jax.jit(stale.step)
    state = stale.init(jax.random.key(0))
    returns = []
    for _ in range(3):
        state, metrics = step(state, jnp.array(True))
        returns.append(metrics["episode_return"].item())
    assert returns == [3, 5, 5]
    still, _ = step(state, jnp.array(False))
    assert still.estimator_state[1] == state.estimator_state[1] == 2
