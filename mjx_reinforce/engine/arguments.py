"""Checks of numbers and keys that may be traced, and are then taken on trust."""

import math
from typing import Any

import jax
import jax.core
import jax.numpy as jnp

from mjx_reinforce.engine.checks import check_type


def known_number(value: Any) -> float | None:
    """Returns a number, NaN for what is none, and None for one that is traced."""
    if isinstance(value, jax.core.Tracer):
        return None
    try:
        return math.nan if isinstance(value, bool | str) else float(value)
    except (TypeError, ValueError):
        return math.nan


def check_number(name: str, value: object, *, positive: bool = False, finite: bool = True) -> None:
    """Raises ValueError for what is no number, or one that is negative."""
    number = known_number(value)
    if number is None:
        return
    allowed = number > 0 if positive else number >= 0
    if not allowed or (finite and math.isinf(number)):
        kind = "positive" if positive else "0 or more"
        raise ValueError(f"{name} must be {kind}{' and finite' * finite}, got {value!r}")


def check_count(name: str, value: int, least: int = 1) -> None:
    """Raises ValueError for what is no whole number, or one that is less than ``least``."""
    check_type(name, value, int)
    if value < least:
        raise ValueError(f"{name} must be at least {least}, got {value}")


def check_key(key: object) -> None:
    """Raises ValueError for what is no random key."""
    dtype = getattr(key, "dtype", None)
    typed = dtype is not None and jnp.issubdtype(dtype, jax.dtypes.prng_key)
    if not (typed or dtype == jnp.uint32):
        raise ValueError(f"the key must be a random key, such as jax.random.key(0), got {key!r}")
