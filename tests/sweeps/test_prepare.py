"""From a design to groups, chunks and a plan, without a program."""

import pytest

from mjx_reinforce.settings.config import Config
from mjx_reinforce.sweeps.design import Design
from mjx_reinforce.sweeps.plan import prepare_sweep

BASE = Config(
    env="ContinuousCartPole-v0", num_seeds=3, env_steps=None, max_updates=2, engine="vmap"
)
OVER = {"num_episodes": [2, 4], "learning_rate": [1e-3, 1e-2, 1e-1]}


def prepared(limits=None, **changes):
    return prepare_sweep(Design(base=BASE, over=OVER, **changes), limits)


def test_a_group_is_what_shares_its_programs():
    sweep = prepared()
    groups = [part.group for part in sweep.parts]
    assert [group.members.tolist() for group in groups] == [[0, 1, 2], [3, 4, 5]]
    assert [group.config.num_episodes for group in groups] == [2, 4]
    assert groups[1].settings["learning_rate"].tolist() == [1e-3, 1e-2, 1e-1]
    assert len(sweep.configurations) == 6
    assert [part.horizon for part in sweep.parts] == [50, 50]
    assert sweep.engine == "vmap"
    assert "18 runs" in sweep.plan


def test_a_chunk_has_as_many_runs_as_asked_or_as_it_had():
    assert [part.limit for part in prepared(chunk_runs=4).parts] == [4, 4]
    assert [part.limit for part in prepared([2, 9], chunk_runs=4).parts] == [2, 9]


def test_exact_sweeps_have_one_device_and_trace_every_number():
    sweep = prepared(exact=True)
    assert sweep.devices.count == 1
    assert len(sweep.parts[0].group.settings) > 5


def test_a_task_that_refuses_its_settings():
    wrong = Config(env="ContinuousCartPole-v0", env_set=("no_such=1",), env_steps=10)
    with pytest.raises(ValueError, match="no_such"):
        prepare_sweep(Design(base=wrong, over=OVER), None)
