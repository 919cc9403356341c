"""What the fused evaluator raises."""


class UnsupportedPrimitive(NotImplementedError):  # noqa: N818 (reads as what it is)
    """A JAX primitive that the fused evaluator has no rule for."""

    def __init__(self, name: str, source: str, detail: str = ""):
        """Names the primitive and the line of user code it came from."""
        reason = f" ({detail})" if detail else ""
        super().__init__(
            f"fused.vmap has no rule for the primitive '{name}'{reason}, used at {source}. "
            "Use jax.vmap for this function, or add a rule in mjx_reinforce/fused/rules."
        )
