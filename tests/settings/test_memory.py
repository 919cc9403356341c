"""The memory of a run: what makes it larger, and what is refused."""

import dataclasses

import pytest

from mjx_reinforce.settings import memory
from mjx_reinforce.settings.config import Config
from mjx_reinforce.settings.tables import Task

TASK = Task(3, 2, 100, 1.0, 0.0)
CONFIG = Config(num_seeds=2, hidden_sizes=(4,), num_episodes=8)


def needed(**changes):
    return memory.needed(dataclasses.replace(CONFIG, **changes), TASK)


def test_a_network_has_a_weight_for_every_pair_and_a_bias():
    assert (TASK.observation, TASK.action) == (3, 2)
    assert memory.num_parameters(CONFIG, TASK) == (3 + 1) * 4 + (4 + 1) * 4
    assert memory.critic_parameters(CONFIG, TASK) == 0
    critic = dataclasses.replace(CONFIG, estimator="value-baseline", value_hidden_sizes=(5,))
    assert memory.critic_parameters(critic, TASK) == (3 + 1) * 5 + (5 + 1)
    ars = dataclasses.replace(critic, algorithm="ars")
    assert memory.critic_parameters(ars, TASK) == 0


def test_seeds_side_by_side_need_as_much_each():
    assert needed(num_seeds=200) == pytest.approx(100 * needed())


@pytest.mark.parametrize(
    "more",
    [
        {"num_episodes": 16},
        {"horizon": 200},
        {"hidden_sizes": (64, 64)},
        {"eval_episodes": 100},
        {"estimator": "value-baseline"},
    ],
)
def test_more_of_anything_needs_more(more):
    assert needed(**more) > needed()


def test_what_a_program_needs_besides_counts():
    total = needed()
    memory.check_fits(CONFIG, TASK, total + 10, 10)
    with pytest.raises(ValueError, match="does not fit"):
        memory.check_fits(CONFIG, TASK, total + 9, 10)


def test_sizes_are_for_people():
    said = {1: "1 MB", 3e6: "3 MB", 6e7: "0.1 GB", 1.24e9: "1.2 GB", 1.24e12: "1,240 GB"}
    assert {size: memory.gigabytes(size) for size in said} == said
