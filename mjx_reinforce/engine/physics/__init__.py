"""Physics: MuJoCo's step in JAX, with the constraint solvers of C MuJoCo.

``silence_mjx`` is for importing MJX without the two lines that it prints where its optional Warp
backend is missing. This package asks for the JAX implementation by name, so they only worry people.
``sys.stdout`` is left as it is: other threads write to it meanwhile.
"""

import sys
from collections.abc import Sequence
from importlib.machinery import ModuleSpec, PathFinder, SourceFileLoader
from types import ModuleType

#: The module of MJX that looks for Warp.
_WARP = "mujoco.mjx.warp"


class _Loader(SourceFileLoader):
    """Runs a module whose ``print`` prints nothing."""

    def exec_module(self, module: ModuleType) -> None:
        vars(module)["print"] = lambda *_: None
        super().exec_module(module)
        del vars(module)["print"]


class _Finder(PathFinder):
    """Finds that module alone."""

    @classmethod
    def find_spec(
        cls, fullname: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Returns how to load that module, by ``_Loader``; None for any other."""
        if fullname != _WARP:
            return None
        spec = super().find_spec(fullname, path, target)
        if spec is not None and spec.origin is not None:
            spec.loader = _Loader(fullname, spec.origin)
        return spec


def silence_mjx() -> None:
    """Lets MJX be imported in silence from now on."""
    sys.meta_path.insert(0, _Finder)
