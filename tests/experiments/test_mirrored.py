"""The study of mirrored first actions: what it computes of returns."""

import numpy as np
import pytest

from experiments.studies import mirrored


def test_correlations_are_within_states():
    """Half of the variance is shared within a pair; what differs between states counts nothing."""
    rng = np.random.default_rng(0)
    shared = rng.normal(size=(400, 50, 1))
    own = rng.normal(size=(400, 50, 2))
    of_state = 100 * rng.normal(size=(400, 1, 1))
    value, error = mirrored.correlation(of_state + shared + own)
    assert value == pytest.approx(0.5, abs=0.05)
    assert error == pytest.approx(0.5 * 20000**-0.5 * 1.5, rel=0.4)
    mirror_images = np.concatenate([own[..., :1], -own[..., :1]], axis=-1)
    assert mirrored.correlation(of_state + mirror_images)[0] == pytest.approx(-1, abs=0.05)
