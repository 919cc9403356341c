"""What must hold of a saved policy before anything is built from it."""

import math
import reprlib
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from mjx_reinforce.files import Header

#: No layer, observation or action of a policy has more entries.
_MOST_ENTRIES = 2**20


def check_policy_settings(settings: Mapping[str, Any]) -> None:
    """Checks the entries of ``policy.json`` one by one.

    Raises:
      ValueError: an entry is missing, or is not what it should be.
    """
    space = ("num_actions",) if "num_actions" in settings else ("action_low", "action_high")
    for name in ("policy", "hidden_sizes", "initial_std", "observation_size", *space):
        if name not in settings:
            raise ValueError(f"{name} is missing")
    for name, (holds, rule) in _FIELD_RULES.items():
        if name in settings and not holds(settings[name]):
            raise ValueError(f"{name} must be {rule}, got {reprlib.repr(settings[name])}")
    if "num_actions" not in settings:
        low, high = len(settings["action_low"]), len(settings["action_high"])
        if low != high:
            raise ValueError(f"action_low has {low} entries, action_high has {high}")


def check_arrays(
    arrays: Mapping[str, Header | np.ndarray], expected: Mapping[str, tuple[int, ...]]
) -> int:
    """Checks the names and shapes of ``actor.npz``.

    Args:
      arrays: what the archive holds, or says that it does.
      expected: names and shapes of what the policy needs, without the seed axis.

    Returns:
      S, the number of seeds.

    Raises:
      ValueError: an array is missing, is not of the policy, or has another shape or type.
    """
    for name in sorted(expected.keys() - arrays.keys()):
        raise ValueError(f"{name} is missing")
    for name in sorted(arrays.keys() - expected.keys()):
        raise ValueError(f"{name!a} is not an array of the policy in policy.json")
    counts = arrays["normalizer/count"].shape
    if len(counts) != 1 or not counts[0]:
        raise ValueError(
            f"normalizer/count must have one entry for each seed, its shape is {counts}"
        )
    for name in sorted(expected):
        shape, kind = (*counts, *expected[name]), arrays[name].dtype
        if arrays[name].shape != shape:
            raise ValueError(
                f"{name} has shape {arrays[name].shape}, "
                f"by policy.json and the {counts[0]} seeds it should be {shape}"
            )
        if kind.kind != "f":
            raise ValueError(f"{name} must hold floating-point numbers, it holds {kind}")
    return counts[0]


def check_finite(arrays: Mapping[str, np.ndarray], seed: int | None) -> None:
    """Raises ValueError for numbers that are not finite, of one seed or, if None, of any.

    Args:
      arrays: [S, ...] each.
      seed: which seed's.
    """
    for name in sorted(arrays):
        finite = np.isfinite(arrays[name]).reshape(len(arrays[name]), -1).all(axis=1)
        bad = [s for s in np.flatnonzero(~finite) if seed in (None, s)]
        if bad:
            raise ValueError(f"{name} of seed {bad[0]} has numbers that are not finite")


def _is_size(value: object) -> bool:
    return type(value) is int and 1 <= value <= _MOST_ENTRIES


def is_number(value: Any) -> bool:
    """Returns whether it is a finite number that float can hold."""
    return type(value) in (int, float) and abs(value) < 1e300 and math.isfinite(value)


def _is_bounds_list(value: object) -> bool:
    return isinstance(value, list) and bool(value) and all(x is None or is_number(x) for x in value)


_SIZE_RULE = f"a whole number from 1 to {_MOST_ENTRIES}"
#: What must hold of an entry, and how to say it.
_FIELD_RULES: dict[str, tuple[Callable[[Any], bool], str]] = {
    "policy": (lambda x: isinstance(x, str), "the name of a distribution"),
    "hidden_sizes": (
        lambda x: isinstance(x, list) and all(map(_is_size, x)),
        f"a list, each entry {_SIZE_RULE}",
    ),
    "initial_std": (is_number, "a number"),
    "observation_size": (_is_size, _SIZE_RULE),
    "num_actions": (_is_size, _SIZE_RULE),
    "action_low": (_is_bounds_list, "a list of numbers, null where unbounded"),
    "action_high": (_is_bounds_list, "a list of numbers, null where unbounded"),
    "shared_trunk": (lambda x: isinstance(x, bool), "true or false"),
    "initializer": (lambda x: isinstance(x, str), "the name of an initialiser"),
    "rescale": (lambda x: isinstance(x, bool), "true or false"),
}
