"""REINFORCE on MuJoCo, vectorized over episodes and seeds.

The public names are imported on first use, so that ``import mjx_reinforce``
and ``python -m mjx_reinforce.train --help`` stay quick: neither MJX nor brax
is loaded before an environment is made. ``__init__.pyi`` says where each is.
"""

import importlib
from typing import Any

from mjx_reinforce.engine.lazy import homes

#: Public name -> the module that has it.
_HOME = homes(__file__)
#: Folders and files that are attributes too, also imported on first use.
_MODULES = (
    "console",
    "engine",
    "envs",
    "export",
    "files",
    "learning",
    "playing",
    "published",
    "registry",
    "reports",
    "runs",
    "settings",
    "setup",
    "statistics",
    "training",
)
# Checkers read the list in the stub.
__all__ = sorted([*_HOME, "__version__"])  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> Any:
    """Imports a public name from its module, or a module, on first use (PEP 562)."""
    if name == "__version__":
        return _version()
    if name in _MODULES:
        return importlib.import_module(f"{__name__}.{name}")
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_HOME[name]), name)


def _version() -> str:
    """Returns the version of the installed package."""
    from importlib import metadata

    try:
        return metadata.version("mjx-reinforce")
    except metadata.PackageNotFoundError:
        return "0+not.installed"


def __dir__() -> list[str]:
    return sorted([*__all__, *_MODULES])
