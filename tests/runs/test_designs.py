"""The design of a sweep: its grid, its groups in chunks."""

import dataclasses
from types import MappingProxyType

import numpy as np
import pytest

from mjx_reinforce.runs import design, plan
from mjx_reinforce.runs.design import Design
from mjx_reinforce.runs.plan import Group, describe, make_groups, make_plan
from mjx_reinforce.settings.config import Config

CONFIG = Config(env_steps=1000, max_updates=7, num_seeds=3, num_episodes=16)


def group(members=(0, 1, 2, 3, 4), **changes):
    rates = {"learning_rate": 0.1 * np.array(members)}
    return Group(dataclasses.replace(CONFIG, **changes), np.array(members), rates)


# The grid.


def test_a_grid_has_every_combination_and_the_last_changes_fastest():
    over = {"discount": [0.9, 0.99], "num_episodes": [4, 8]}
    values = [tuple(entry.values()) for entry in Design(base=Config(), over=over).configurations]
    assert values == [(0.9, 4), (0.9, 8), (0.99, 4), (0.99, 8)]


def test_words_become_values_of_the_type_of_their_setting():
    given = [
        ["learning-rate", "1e-3", "1"],
        ["--hidden-sizes", "8,4", "none"],
        ["max-kl", "None", "0.1"],
    ]
    assert design.read_over(given) == {
        "learning_rate": [1e-3, 1.0],
        "hidden_sizes": [(8, 4), ()],
        "max_kl": [None, 0.1],
    }


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ([[]], "needs a setting and its values"),
        ([["learning-rat", "1"]], "unknown setting 'learning-rat'.*Did you mean 'learning-rate'"),
        ([["discount", "0.9"], ["discount", "0.8"]], "given twice"),
        ([["num-episodes", "4.5", "8"]], "'4.5', not a whole number"),
        ([["learning-rate", "0.1,0.2"]], "write spaces between values"),
        ([["hidden-sizes", "8", "32,x"]], "value '32,x', not layers, such as 32,32, or none$"),
    ],
)
def test_words_that_are_no_values_are_refused(given, said):
    with pytest.raises(ValueError, match=said):
        design.read_over(given)


# The plan and its chunks.


@pytest.mark.parametrize(("limit", "expected"), [(15, 1), (14, 2), (5, 3), (1, 15)])
def test_runs_are_in_as_few_chunks_as_there_is_room(limit, expected):
    assert plan.divide(group(), limit, 1, exact=False)[0] == expected
    assert plan.divide(group(), limit, 2, exact=True) == (expected, 2)


def test_slots_are_no_wider_than_the_chunk(monkeypatch):
    monkeypatch.setattr(plan, "_CPU_EPISODES", 128)
    assert plan.divide(group(), 15, 1, exact=False)[1] == 8
    assert plan.divide(group(), 3, 1, exact=False)[1] == 3
    assert plan.divide(group(), 15, 4, exact=False)[1] == 16


@pytest.mark.parametrize("num_chunks", [1, 2, 4, 15])
def test_every_run_is_in_one_chunk_and_every_chunk_has_its_share(num_chunks):
    whole = group((3, 5, 8, 9, 11))
    parts = plan.split_runs(whole, "0", num_chunks)
    assert len(parts) == num_chunks
    runs = [(c, s) for part in parts for c, s in zip(part.configuration, part.seed, strict=True)]
    assert sorted(runs) == [(c, s) for c in (3, 5, 8, 9, 11) for s in range(3)]
    for part in parts:
        assert np.array_equal(whole.members[part.member], part.configuration)
        number = np.bincount(part.member, minlength=5)
        assert number.max() - number.min() <= 1
    assert len({part.name for part in parts}) == num_chunks


# Settings of the environment.


def test_settings_of_the_environment_are_swept_as_words():
    over = design.read_over(
        [("env-set.frame_skip", "2", "1e1"), ("env-set.xml_file", "a.xml", "b.xml")]
    )
    assert over == {"env_set.frame_skip": [2, 10], "env_set.xml_file": ["a.xml", "b.xml"]}
    base = Config(env="Hopper-v5", env_set=("reset_noise_scale=0.1", "frame_skip=4"))
    design.check_over(base, over)
    swept = Design(base=base, over=over)
    kept = "reset_noise_scale=0.1"
    assert swept.configs[1].env_set == (kept, "frame_skip=2", "xml_file=b.xml")
    assert swept.configs[2].env_set == (kept, "frame_skip=10", "xml_file=a.xml")
    assert len(make_groups(swept)) == 4


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
        design.check_over(Config(), over)


# From a design to groups, chunks and a plan, without a program.


BASE = Config(
    env="ContinuousCartPole-v0", num_seeds=3, env_steps=None, max_updates=2, engine="vmap"
)
OVER = {"num_episodes": [2, 4], "learning_rate": [1e-3, 1e-2, 1e-1]}


def prepared(base=BASE, known=MappingProxyType({}), **changes):
    return make_plan(Design(base=base, over=OVER, **changes), known, None, pytest.fail)


def test_a_group_is_what_shares_its_programs():
    sweep = prepared()
    groups = [group_plan.group for group_plan in sweep.group_plans]
    assert [group.members.tolist() for group in groups] == [[0, 1, 2], [3, 4, 5]]
    assert [group.config.num_episodes for group in groups] == [2, 4]
    assert groups[1].settings["learning_rate"].tolist() == [1e-3, 1e-2, 1e-1]
    assert [group_plan.ready.horizon for group_plan in sweep.group_plans] == [50, 50]
    assert describe(sweep).startswith("Training 6 configurations of 3 seeds of Cont")


def test_a_chunk_has_as_many_runs_as_asked_or_as_it_had(monkeypatch, tmp_path):
    assert [group_plan.limit for group_plan in prepared(chunk_runs=4).group_plans] == [4, 4]
    known = {"chunk_runs": [2, 9], "local_devices": 1}
    monkeypatch.setattr(plan.resume, "check_same_program", lambda *given: None)
    base = dataclasses.replace(BASE, resume=tmp_path)
    group_plans = prepared(base, known, chunk_runs=4).group_plans
    assert [group_plan.limit for group_plan in group_plans] == [2, 9]
    known["local_devices"] = 3
    with pytest.raises(ValueError, match="was begun on 3 devices, and here are 1"):
        prepared(base, known)


def test_exact_sweeps_have_one_device_and_trace_every_number():
    sweep = prepared(exact=True)
    assert sweep.division.count == 1
    assert len(sweep.group_plans[0].group.settings) > 5


def test_a_task_that_refuses_its_settings():
    wrong = Config(env="ContinuousCartPole-v0", env_set=("no_such=1",), env_steps=10)
    with pytest.raises(ValueError, match="no_such"):
        prepared(wrong)
