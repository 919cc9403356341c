"""The page about a task, of tasks small enough to know all of it."""

import dataclasses

import numpy as np
import pytest
from toys import Drifting, Survive

from mjx_reinforce import Box, Discrete
from mjx_reinforce.envs import __main__ as about_task
from mjx_reinforce.settings.config import Config


class Told(Survive):
    """Stay up.

    Second paragraph,
    of ``two`` lines.
    """

    reward_threshold = 1500.0
    max_episode_steps = 1200
    dt = 0.05

    @dataclasses.dataclass(frozen=True)
    class Settings:
        """Arguments."""

        sizes: tuple[int, ...] = (3, 4)
        weight: float = 0.5
        known: int = dataclasses.field(default=1, init=False)

    settings = Settings()


class Plain(Drifting):
    """It has neither limit nor threshold."""

    max_episode_steps = None
    reward_threshold = None


def page_of(register, task):
    register("Told-v0", task)
    return about_task.about_task("Told-v0")


def test_a_page_has_sizes_rules_settings_and_how_to_train(register):
    page = page_of(register, Told)
    id, sizes, first, second, settings, train, command, time, *_ = page.split("\n\n")
    assert id == "Told-v0"
    assert sizes.splitlines() == [
        "  observation  1 numbers",
        "  action       1 number in [-1, 1]",
        "  episode      at most 1,200 env steps, of 0.05 s each",
        "  solved       at a return of 1,500",
    ]
    assert (first, second) == ("Stay up.", "Second paragraph, of `two` lines.")
    assert settings.splitlines() == [
        "Its settings, which --env-set NAME=VALUE changes:",
        "  sizes=3,4",
        "  weight=0.5",
    ]
    config = Config()
    assert train == f"To train {config.num_seeds} seeds for {config.env_steps:,} env steps each:"
    assert command.endswith(" --env Told-v0")
    assert time.startswith("--minutes M sets a time in place of env steps. --help")


def test_what_a_task_does_not_say(register):
    page = page_of(register, Plain)
    assert "  episode      give --horizon a number\n" in page
    assert "  solved       the task names no return\n" in page
    assert "  observation  2 numbers\n" in page
    assert "--env-set" not in page


@pytest.mark.parametrize(
    ("space", "words"),
    [
        (Discrete(3), "one of 3"),
        (Box(-np.ones(2), np.ones(2)), "2 numbers in [-1, 1]"),
        (Box(np.array([-1.0, 0.0]), np.array([1.0, 2.5])), "2 numbers in [-1, 1] or [0, 2.5]"),
        (Box(np.array([-np.inf]), np.array([np.inf])), "1 number in [-inf, inf]"),
    ],
)
def test_actions_in_words(space, words):
    assert about_task._action_in_words(Drifting(space)) == words
