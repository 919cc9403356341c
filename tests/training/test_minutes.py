"""A budget in time: the env steps that a machine trains in it, from the speed at the start."""

import itertools
import time
from types import SimpleNamespace

import numpy as np
import pytest

from mjx_reinforce.learners import counts
from mjx_reinforce.runs.run import env_steps_in
from mjx_reinforce.settings.config import MAX_COUNT


def state_of(env_steps):
    each = np.stack([np.asarray(counts.from_int(env_steps))] * 2)
    return SimpleNamespace(train_states=SimpleNamespace(env_steps=each))


@pytest.fixture
def machine(monkeypatch):
    """Programs that play so many env steps in each second; the clock goes a second a question."""
    clock = itertools.count()
    monkeypatch.setattr(time, "perf_counter", lambda: float(next(clock)))
    monkeypatch.setattr("jax.tree.map", lambda function, tree: tree)

    def made(played, blocks=10**6):
        steps = itertools.accumulate(itertools.islice(played, blocks))
        left = itertools.count(blocks - 1, -1)

        def advance(state, look, budget):
            assert look  # as training does, so that evaluations are in the time
            going = np.array([[next(left) > 0, False]])
            return state_of(next(steps)), {"active": going}, None

        return SimpleNamespace(advance=advance)

    return made


def test_what_is_trained_in_a_time_at_an_even_speed(machine):
    # Ten blocks are 3 % of the time; the steps of the trial are trained again.
    programs = machine(itertools.repeat(50))
    assert env_steps_in(300.0, programs, state_of(0), None) == 50 * (300 - 10 + 1)


def test_the_second_half_of_the_trial_counts(machine):
    programs = machine(itertools.chain([1000] * 4, itertools.repeat(10)))
    found = env_steps_in(300.0, programs, state_of(0), None)
    assert found == 10 * 291


def test_a_run_that_ends_by_itself_is_tried_no_longer(machine):
    programs = machine(itertools.repeat(7), blocks=3)
    assert env_steps_in(1e6, programs, state_of(0), 3) == 7 * (10**6 - 3)


def test_a_budget_is_a_count(machine):
    assert (
        env_steps_in(1e12, machine(itertools.repeat(10**9), blocks=4), state_of(0), None)
        == MAX_COUNT
    )
