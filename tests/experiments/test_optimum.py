"""The searches for the optimum: what the optimizer finds, and what the table says of it."""

import numpy as np
import pytest

from experiments.studies import optimum
from experiments.studies.results import tables


def test_a_search_finds_the_top_of_a_narrow_ridge():
    """One direction is 10,000 times as steep as another, and the ridge is along no axis."""
    rng = np.random.default_rng(0)
    axes = np.linalg.qr(rng.normal(size=(6, 6)))[0]
    top = 0.3 * rng.normal(size=6)
    steepness = np.geomspace(1, 1e4, 6)

    def score(x):
        assert x.shape == (16, 3, 2)
        return 5 - (((x.reshape(16, 6) - top) @ axes) ** 2 * steepness).sum(axis=1)

    bests = optimum.search(score, np.zeros((3, 2)), 200, 16)
    assert (np.diff(bests) >= 0).all()
    assert 5 - 1e-12 < bests[-1] <= 5


def test_a_search_scores_where_it_begins():
    seen = []
    center = np.full((2, 1), 0.5)

    def score(x):
        seen.append(x)
        return np.zeros(len(x))

    optimum.search(score, center, 1, 4)
    np.testing.assert_array_equal(seen[0][0], center)
    assert np.ptp(seen[0]) > 0


def test_the_table_says_on_which_side_the_optimum_is():
    kinds = {"second_half": "0"}
    searched = {"task": "A-v5", "method": "search", "second_half": "0.25"}
    lines = [
        searched | {"policy": "-4", "best": "-3"},
        searched | {"policy": "-5", "best": "-2"},
        kinds | {"task": "B-v5", "method": "bound", "policy": "8", "best": "9"},
    ]
    a, b = (line.split(" | ") for line in tables.distances(lines).splitlines()[2:])
    assert a[:3] == ["| A-v5", "2", "-4.50"]
    assert a[3] == "at least -2.50"
    assert a[4].startswith("at least 2.00 (")
    assert a[5:] == ["2.00", "3.00", "0.25, 0.25 |"]
    assert (b[3], b[7]) == ("at most 9.00", "a bound, no search |")


@pytest.mark.slow
def test_a_pendulum_at_rest_earns_the_most():
    """0.8 m of the tip's 2 m are lacking upright: 10 - 0.8^2 each step."""
    assert optimum.upright_return("InvertedPendulum-v5") == 1000
    assert optimum.upright_return("InvertedDoublePendulum-v5") == pytest.approx(9360, rel=1e-5)
