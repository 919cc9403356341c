"""The design of a sweep: its grid, its draws, its groups in chunks, its rungs."""

import dataclasses

import jax
import numpy as np
import pytest

from mjx_reinforce.settings.config import Config
from mjx_reinforce.sweeps import chunks
from mjx_reinforce.sweeps.designs import design, grid, plan, rungs
from mjx_reinforce.sweeps.designs.groups import Group, make_groups

CONFIG = Config(env_steps=1000, max_updates=7, num_seeds=3, num_episodes=16)


def group(members=(0, 1, 2, 3, 4), **changes):
    rates = {"learning_rate": 0.1 * np.array(members)}
    return Group(dataclasses.replace(CONFIG, **changes), np.array(members), rates)


# The grid.


def test_a_grid_has_every_combination_and_the_last_changes_fastest():
    over = {"discount": [0.9, 0.99], "num_episodes": [4, 8]}
    values = [tuple(entry.values()) for entry in grid.grid(over)]
    assert values == [(0.9, 4), (0.9, 8), (0.99, 4), (0.99, 8)]


def test_words_become_values_of_the_type_of_their_setting():
    given = [
        ["learning-rate", "1e-3", "1"],
        ["--hidden-sizes", "8,4", "none"],
        ["max-kl", "None", "0.1"],
        ["standardize", "True", "false"],
    ]
    assert grid.read_over(given) == {
        "learning_rate": [1e-3, 1.0],
        "hidden_sizes": [(8, 4), ()],
        "max_kl": [None, 0.1],
        "standardize": [True, False],
    }


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ([[]], "needs a setting and its values"),
        ([["learning-rat", "1"]], "unknown setting 'learning-rat'.*Did you mean 'learning-rate'"),
        ([["discount", "0.9"], ["discount", "0.8"]], "given twice"),
        ([["num-episodes", "4.5", "8"]], "'4.5', which is no whole number"),
        ([["learning-rate", "0.1,0.2"]], "write spaces between values"),
    ],
)
def test_words_that_are_no_values_are_refused(given, said):
    with pytest.raises(ValueError, match=said):
        grid.read_over(given)


# The search.


def test_draws_are_different_and_the_same_for_a_seed():
    over = {"learning_rate": [1e-4, 1e-1], "estimator": ["total-return", "reward-to-go"]}
    drawn = design.draw_configurations(over, 50, seed=3)
    assert len({tuple(entry.values()) for entry in drawn}) == 50
    assert drawn == design.draw_configurations(over, 50, seed=3)
    assert all(1e-4 <= entry["learning_rate"] <= 1e-1 for entry in drawn)


@pytest.mark.parametrize(
    ("over", "said"),
    [
        ({"learning_rate": [0.1, 0.01]}, "give the lower end first"),
        ({"discount": [0.9, 1.0]}, "ends below 1"),
        ({"learning_rate": [0.0, 1.0]}, "begins above 0"),
    ],
)
def test_a_range_without_a_scale_is_refused(over, said):
    with pytest.raises(ValueError, match=said):
        design.draw_configurations(over, 2, seed=0)


@pytest.mark.parametrize(
    ("values", "answer"),
    [([1, 2], True), ([1, 2, 3], False), ([True, False], False), (["a", "b"], False)],
)
def test_two_numbers_are_a_range(values, answer):
    assert design.is_range(values) == answer


# The plan and its chunks.


@pytest.mark.parametrize(("limit", "expected"), [(15, 1), (14, 2), (5, 3), (1, 15)])
def test_runs_are_in_as_few_chunks_as_there_is_room(limit, expected):
    part = plan.divide(group(), limit, 1, exact=False)
    assert part.num_chunks == expected
    assert plan.divide(group(), limit, 2, exact=True) == plan.GroupPlan(expected, (2,))


@pytest.mark.parametrize(
    ("side", "devices", "said"),
    [
        (8, 8, ""),
        (9, 8, ""),
        (3, 8, " Of 8 devices here, 5 stand idle: no more runs are under way at once."),
        (7, 8, " Of 8 devices here, 1 stands idle: no more runs are under way at once."),
        (3, 1, " Of 8 devices here, 7 stand idle: --exact computes on one."),
    ],
)
def test_a_plan_says_how_many_devices_stand_idle(monkeypatch, side, devices, said):
    monkeypatch.setattr(jax, "local_device_count", lambda: 8)
    assert plan._idle_devices(side, devices) == said


def test_slots_are_no_wider_than_the_chunk(monkeypatch):
    monkeypatch.setattr(plan, "_CPU_EPISODES", (128, 32))
    assert plan.divide(group(), 15, 1, exact=False).widths == (8, 2)
    assert plan.divide(group(), 3, 1, exact=False).widths == (3, 2)
    assert plan.divide(group(), 15, 4, exact=False).widths == (16, 8)


@pytest.mark.parametrize("num_chunks", [1, 2, 4, 15])
def test_every_run_is_in_one_chunk_and_every_chunk_has_its_share(num_chunks):
    whole = group((3, 5, 8, 9, 11))
    parts = chunks.split_runs(whole, "0", num_chunks)
    assert len(parts) == num_chunks
    runs = [(c, s) for part in parts for c, s in zip(part.configuration, part.seed, strict=True)]
    assert sorted(runs) == [(c, s) for c in (3, 5, 8, 9, 11) for s in range(3)]
    for part in parts:
        assert np.array_equal(whole.members[part.place], part.configuration)
        number = np.bincount(part.place, minlength=5)
        assert number.max() - number.min() <= 1
    assert len({part.name for part in parts}) == num_chunks


# Settings of the environment.


def test_settings_of_the_environment_are_swept_as_words():
    over = grid.read_over([("env-set.frame_skip", "2", "1e1"), ("env-set.solver", "mjx", "fast")])
    assert over == {"env_set.frame_skip": [2, 10], "env_set.solver": ["mjx", "fast"]}
    base = Config(env="Hopper-v5", env_set=("reset_noise_scale=0.1", "frame_skip=4"))
    grid.check_over(base, over)
    configs = grid.configure(base, grid.grid(over))
    kept = "reset_noise_scale=0.1"
    assert configs[1].env_set == (kept, "frame_skip=2", "solver=fast")
    assert configs[2].env_set == (kept, "frame_skip=10", "solver=mjx")
    assert len(make_groups(configs, tuple(over), exact=False)) == 4


@pytest.mark.parametrize(
    ("over", "said"),
    [
        ({"env_set.max_episode_steps": [5, 6]}, "--over horizon"),
        ({"env_set.reward_threshold": [5, 6]}, "one return"),
        ({"env_set.frame_skip": [5]}, "pass --env-set frame_skip=5"),
        ({"env_sets.frame_skip": [5, 6]}, "unknown setting"),
    ],
)
def test_a_setting_of_the_environment_that_cannot_be_swept_is_refused(over, said):
    with pytest.raises(ValueError, match=said):
        grid.check_over(Config(), over)


# The rungs.


def measured(returns):
    """What a rung measured of configurations with two seeds each."""
    numbers = np.repeat(list(returns), 2)
    last = np.array([value for pair in returns.values() for value in pair], np.float32)
    return {"configuration": numbers, "eval_return": np.stack([np.zeros_like(last), last])}


def test_the_best_are_those_of_the_last_returns():
    found = measured({4: (1, 2), 7: (9, 8), 2: (5, 5), 3: (np.nan, np.nan), 6: (5, 5)})
    assert rungs.best(found, 1) == [7]
    assert rungs.best(found, 2) == [2, 7]
    assert rungs.best(found, 4) == [2, 4, 6, 7]


def test_halving_halves_the_configurations_and_doubles_the_budget():
    returns = {i: (i, i) for i in range(5)}
    seen = []

    def result(name):
        members = np.concatenate([each.members for each in seen[-1].groups.values()])
        assert name == seen[-1].name
        return measured({i: returns[i] for i in members.tolist()})

    for rung in rungs.plan_rungs([group()], "halving", result):
        seen.append(rung)
    chosen = [rung.groups[0].members.tolist() for rung in seen]
    assert chosen == [[0, 1, 2, 3, 4], [2, 3, 4], [3, 4], [4], [4]]
    budgets = [rung.groups[0].config for rung in seen]
    assert [config.env_steps for config in budgets] == [125, 250, 500, 1000, 1000]
    assert [config.max_updates for config in budgets] == [1, 2, 4, 7, 7]
    assert [config.seed for config in budgets] == [0, 0, 0, 0, 1]
    assert [rung.before for rung in seen] == [None, "0", "1", "2", None]
    assert len(seen) == rungs.num_rungs("halving", 5)
    np.testing.assert_allclose(seen[1].groups[0].settings["learning_rate"], [0.2, 0.3, 0.4])
    steps = sum(r.added * r.groups[0].config.env_steps * len(r.groups[0].members) for r in seen)
    assert rungs.part_trained("halving", 5) == pytest.approx(steps / (5 * 1000))


def test_a_grid_is_one_rung_of_the_whole_budget():
    (rung,) = rungs.plan_rungs([group()], "grid", measured)
    assert rung.groups[0].config == CONFIG
    assert rungs.num_rungs("grid", 5) == 1
    assert rungs.part_trained("grid", 5) == 1.0
