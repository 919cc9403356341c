"""What must hold of a saved policy before anything is built from it: what is wrong is named."""

import numpy as np
import pytest

from mjx_reinforce.export.policy_checks import (
    check_arrays,
    check_finite,
    check_policy_settings,
    is_number,
)

SETTINGS = {
    "policy": "normal",
    "hidden_sizes": [8, 8],
    "initial_std": 0.5,
    "observation_size": 4,
    "action_low": [-1.0, None],
    "action_high": [1.0, None],
}
EXPECTED = {"normalizer/count": (), "params/kernel": (4, 2)}


def arrays(**changes):
    """Those of three seeds."""
    whole = {
        "normalizer/count": np.ones(3, np.float32),
        "params/kernel": np.zeros((3, 4, 2), np.float32),
    }
    whole |= {name.replace("__", "/"): value for name, value in changes.items()}
    return {name: value for name, value in whole.items() if value is not ...}


def test_what_is_right_passes():
    check_policy_settings(SETTINGS)
    check_policy_settings({**SETTINGS, "num_actions": 3, "rescale": True, "initializer": "torch"})
    assert check_arrays(arrays(), EXPECTED) == 3


def test_a_missing_setting_is_named():
    for name in SETTINGS:
        rest = {key: value for key, value in SETTINGS.items() if key != name}
        with pytest.raises(ValueError, match=f"{name} is missing"):
            check_policy_settings(rest)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("policy", 3),
        ("hidden_sizes", 8),
        ("hidden_sizes", [0]),
        ("hidden_sizes", [True]),
        ("hidden_sizes", [2**20 + 1]),
        ("initial_std", "wide"),
        ("initial_std", float("nan")),
        ("observation_size", 0),
        ("observation_size", 4.0),
        ("num_actions", -1),
        ("action_low", []),
        ("action_low", ["low"]),
        ("shared_trunk", 1),
        ("rescale", None),
        ("initializer", 0),
    ],
)
def test_a_setting_of_another_kind_is_named(name, value):
    with pytest.raises(ValueError, match=f"{name} must be"):
        check_policy_settings(SETTINGS | {name: value})


def test_two_bounds_are_of_one_length():
    with pytest.raises(ValueError, match="action_low has 2 entries, action_high has 1"):
        check_policy_settings(SETTINGS | {"action_high": [1.0]})


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"params__kernel": ...}, "params/kernel is missing"),
        ({"extra": np.ones(3)}, "'extra' is not an array of the policy"),
        ({"normalizer__count": np.ones((3, 1))}, "one entry for each seed"),
        ({"normalizer__count": np.ones(0)}, "one entry for each seed"),
        ({"params__kernel": np.zeros((2, 4, 2))}, r"by policy.json and the 3 seeds .*\(3, 4, 2\)"),
        ({"params__kernel": np.zeros((3, 4, 2), int)}, "must hold floating-point numbers"),
    ],
)
def test_a_wrong_array_is_named(changes, message):
    with pytest.raises(ValueError, match=message):
        check_arrays(arrays(**changes), EXPECTED)


def test_numbers_that_are_not_finite_are_those_of_a_seed():
    kernel = np.zeros((3, 4, 2), np.float32)
    kernel[1, 2, 0] = np.inf
    broken = arrays(params__kernel=kernel)
    check_finite(arrays(), None)
    check_finite(broken, 0)
    for seed in (1, None):
        with pytest.raises(ValueError, match="params/kernel of seed 1"):
            check_finite(broken, seed)


@pytest.mark.parametrize("value", [1e300, -1e300, True, None, "1", float("inf"), 10**400])
def test_what_is_no_number(value):
    assert not is_number(value)
