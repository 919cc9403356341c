"""The range of a continuous action space: its checks, its bounds, its middle and half range."""

import jax.numpy as jnp
import numpy as np
import pytest

from mjx_reinforce import Box, Discrete
from mjx_reinforce.policies.distributions.action_range import (
    bounds,
    check_space,
    continuous_box,
    finite_box,
    middle_and_half_range,
)

HALF = Box(np.array([-2.0, -np.inf, 1.0]), np.array([4.0, 5.0, np.inf]))


def test_the_middle_of_what_is_not_bounded_on_both_sides_is_0_and_half_of_it_1():
    middle, half = middle_and_half_range(HALF)
    assert (middle.tolist(), half.tolist()) == ([1, 0, 0], [3, 1, 1])
    assert middle.dtype == half.dtype == np.float32


def test_bounds_are_of_the_dtype_that_is_asked_for():
    low, high = bounds(Box(np.array([-1.0]), np.array([2.0])), jnp.zeros((), jnp.float16))
    assert (low.dtype, high.dtype) == (jnp.float16, jnp.float16)
    assert (low.tolist(), high.tolist()) == ([-1], [2])


def test_a_space_of_the_family_passes():
    whole = Box(np.array([-1.0]), np.array([2.0]))
    assert continuous_box("normal", HALF) is HALF
    assert finite_box("tanh-normal", whole) is whole
    check_space("categorical", Discrete(2))


def test_another_space_is_refused_with_the_family_s_name():
    with pytest.raises(ValueError, match=r"normal needs a continuous action space, .* categorical"):
        continuous_box("normal", Discrete(2))
    with pytest.raises(ValueError, match="tanh-normal needs finite action bounds"):
        finite_box("tanh-normal", HALF)
    with pytest.raises(ValueError, match=r"normal needs an action space, .* got a tuple"):
        continuous_box("normal", (-1, 1))
