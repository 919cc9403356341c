"""Episodes of MuJoCo played fast, for any algorithm; docs/engine.md is its page.

The names in the stub ``__init__.pyi`` are all that others need of it, imported on first use:
``import mjx_reinforce.engine`` waits for nothing. The engine imports nothing of this package but
itself: an environment, a policy and a distribution are what ``Environment`` and ``Acts`` say.
"""

import importlib
from typing import Any

from mjx_reinforce.engine.lazy import homes

_HOME = homes(__file__)
__all__ = sorted(_HOME)  # pyright: ignore[reportUnsupportedDunderAll] (they read the stub)


def __getattr__(name: str) -> Any:
    """Imports a public name from its module on first use (PEP 562)."""
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_HOME[name]), name)


def __dir__() -> list[str]:
    return __all__
