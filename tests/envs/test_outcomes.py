"""Checks of what a task's methods return: a wrong shape is named in one line."""

import jax.numpy as jnp
import numpy as np
import pytest

from mjx_reinforce.engine.checks import BadEnvironmentError
from mjx_reinforce.engine.contract import check_shape
from mjx_reinforce.envs.outcomes import check_outcome, check_start

SIZES = (3, 2)


def test_a_start_of_the_model_s_sizes_passes():
    qpos, qvel = check_start("Task", (np.arange(3), jnp.zeros(2)), SIZES)
    assert jnp.issubdtype(qpos.dtype, jnp.floating)
    assert (qpos.tolist(), qvel.tolist()) == ([0, 1, 2], [0, 0])


@pytest.mark.parametrize(
    ("start", "message"),
    [
        (np.zeros(3), r"must return qpos and qvel, got the shape \[3\]"),
        ((np.zeros(3),), "got a tuple of 1"),
        ((np.zeros(2), np.zeros(2)), r"must return qpos \[3\], .* got the shape \[2\]"),
        ([np.zeros(3), np.zeros((2, 1))], r"must return qvel \[2\]"),
        ((np.zeros(3), "fast"), "got 'fast'"),
        (None, "got None"),
    ],
)
def test_a_start_of_other_sizes_is_named(start, message):
    with pytest.raises(BadEnvironmentError, match=f"Task.initial .*{message}"):
        check_start("Task", start, SIZES)


def test_an_outcome_of_scalars_passes():
    outcome = (jnp.float32(1), False, {"forward": 2, "cost": np.zeros(())})
    assert check_outcome("Task", outcome) == outcome


@pytest.mark.parametrize(
    ("outcome", "message"),
    [
        ((1.0, False), "must return three values, .* got a tuple of 2"),
        ((1.0, False, 3), "third value of Task.outcome must be a dict of the reward's terms, got"),
        ((np.zeros(1), False, {}), r"the reward of .* must be a scalar \[\], got the shape \[1\]"),
        ((1.0, np.zeros(2, bool), {}), "the termination of"),
        ((1.0, False, {"cost": np.zeros(4)}), "the term 'cost' of .* sum it, or take an entry"),
        ((None, False, {}), "the reward of .* got None"),
    ],
)
def test_another_outcome_is_named(outcome, message):
    with pytest.raises(BadEnvironmentError, match=message):
        check_outcome("Task", outcome)


def test_a_shape():
    check_shape("qpos", np.zeros((2, 3)), (2, 3))
    with pytest.raises(ValueError, match=r"qpos must be \[2\], got the shape \[3\]"):
        check_shape("qpos", np.zeros(3), (2,))
