"""Counts in two words, against Python's whole numbers."""

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mjx_reinforce.engine import counts

COUNT = st.one_of(st.integers(0, 2**53), st.sampled_from([2**31, 2**32 - 1, 2**32, 2**53]))


@settings(deadline=None)
@given(COUNT)
def test_a_count_is_a_whole_number(number):
    count = counts.from_int(number)
    assert counts.to_int(count) == number
    assert float(counts.as_float(count)) == pytest.approx(number, rel=2**-22)


@settings(deadline=None)
@given(st.integers(0, 2**53 - 2**32), st.integers(0, 2**32 - 1))
def test_a_sum_carries(number, more):
    after = jax.jit(counts.plus)(counts.from_int(number), np.uint32(more))
    assert counts.to_int(after) == number + more


@settings(deadline=None)
@given(COUNT, COUNT)
def test_a_limit_is_reached(number, limit):
    pair = counts.from_int(number), counts.from_int(limit)
    assert bool(counts.reached(*pair)) == (number >= limit)
