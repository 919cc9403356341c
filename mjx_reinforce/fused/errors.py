"""What the fused evaluator raises, and what is said of it."""

from mjx_reinforce.checks import explain


class UnsupportedPrimitive(NotImplementedError):  # noqa: N818 (reads as what it is)
    """A JAX primitive that cannot be written out, or not for a backend."""


class TooLarge(NotImplementedError):  # noqa: N818 (reads as what it is)
    """A function that is too large to be written out."""


def no_keys() -> UnsupportedPrimitive:
    """Returns the error for typed PRNG keys."""
    return UnsupportedPrimitive(
        "typed PRNG keys (jax.random.key) cannot be written out; draw the random numbers outside "
        "and pass them, or use jax.vmap for this function"
    )


def no_rule(name: str, source: str) -> UnsupportedPrimitive:
    """Returns the error for a primitive without a rule.

    Args:
      name: the primitive's.
      source: the line of the user's code that it came from.
    """
    return UnsupportedPrimitive(
        f"there is no rule for the primitive {name!r}, used at {source}; use jax.vmap for this "
        "function, or add a rule in mjx_reinforce/fused/rules"
    )


def refusal(error: Exception) -> str:
    """Returns in one line why a function cannot be written out, from what was raised."""
    if isinstance(error, (TooLarge, UnsupportedPrimitive)):
        return " ".join(str(error).split())
    return f"it cannot be written out ({explain(error)})"
