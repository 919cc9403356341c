"""One result computed in two ways: for machine code of one episode, and for XLA."""

from collections.abc import Callable
from typing import Any

from jax import lax

#: The `unroll` of scans over contacts. It asks `fused` to write few iterations out.
UNROLL = 2


def by_engine(one: Callable, many: Callable, *args: Any) -> Any:
    """Computes `many` in XLA; `fused`, which knows no platform, takes the default, `one`.

    Args:
        one: best where an episode takes its own branches.
        many: best where many episodes are computed at once; it returns the same.
        *args: arguments of both.
    """
    return lax.platform_dependent(*args, cpu=many, cuda=many, rocm=many, tpu=many, default=one)
