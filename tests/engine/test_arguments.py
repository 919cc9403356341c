"""Checks of numbers and keys: what is no number is refused, what is traced is taken on trust."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_reinforce.engine.checks import check_count, check_key, check_number, known_number


@pytest.mark.parametrize("value", [2, 2.0, np.float32(2), jnp.float32(2), np.int64(2)])
def test_a_number_is_known(value):
    assert known_number(value) == 2.0


@pytest.mark.parametrize("value", [True, "2", None, [1, 2], math.nan, np.ones(2)])
def test_what_is_no_number_is_nan(value):
    assert math.isnan(known_number(value))
    with pytest.raises(ValueError, match="step must be 0 or more and finite"):
        check_number("step", value)


def test_what_is_traced_is_taken_on_trust():
    def traced(x):
        assert known_number(x) is None
        check_number("step", x, positive=True)
        return x

    jax.jit(traced)(-1.0)


def test_the_range_of_a_number():
    check_number("step", 0)
    check_number("step", math.inf, finite=False)
    with pytest.raises(ValueError, match=r"step must be positive and finite, got 0"):
        check_number("step", 0, positive=True)
    with pytest.raises(ValueError, match=r"step must be 0 or more, got -1"):
        check_number("step", -1, finite=False)
    with pytest.raises(ValueError, match="finite, got inf"):
        check_number("step", math.inf)


def test_counts():
    check_count("N", 1)
    check_count("N", 0, least=0)
    for value in (1.0, True, "1"):
        with pytest.raises(ValueError, match="N"):
            check_count("N", value)
    with pytest.raises(ValueError, match="N must be at least 2, got 1"):
        check_count("N", 1, least=2)


def test_keys():
    check_key(jax.random.key(0))
    check_key(jax.random.PRNGKey(0))
    for value in (0, jnp.zeros(2), None):
        with pytest.raises(ValueError, match="must be a random key"):
            check_key(value)
