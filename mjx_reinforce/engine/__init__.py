"""Episodes of MuJoCo played fast, for any algorithm; docs/engine.md is its page.

The names below are all that others need of it. They are imported on first use, so that
``import mjx_reinforce.engine`` waits for nothing. The engine imports nothing of this package but
itself: an environment, a policy and a distribution are what ``Environment`` and ``Acts`` say.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mjx_reinforce.engine.base import Act as Act
    from mjx_reinforce.engine.base import Acts as Acts
    from mjx_reinforce.engine.base import Box as Box
    from mjx_reinforce.engine.base import Discrete as Discrete
    from mjx_reinforce.engine.base import Environment as Environment
    from mjx_reinforce.engine.base import Trajectory as Trajectory
    from mjx_reinforce.engine.cache import Cache as Cache
    from mjx_reinforce.engine.devices import Devices as Devices
    from mjx_reinforce.engine.play.any_policy import rollout as rollout
    from mjx_reinforce.engine.play.choice import Engine as Engine
    from mjx_reinforce.engine.play.choice import choose as choose
    from mjx_reinforce.engine.play.episode import while_any as while_any
    from mjx_reinforce.engine.scalar import any_lane as any_lane
    from mjx_reinforce.engine.scalar import scalarize as scalarize
    from mjx_reinforce.engine.scalar import vmap as vmap
    from mjx_reinforce.engine.vector.environment import VectorEnv as VectorEnv
    from mjx_reinforce.engine.vector.environment import make_vec as make_vec
    from mjx_reinforce.engine.vector.segments import Segment as Segment
    from mjx_reinforce.engine.vector.segments import unroll as unroll

#: Module -> its public names.
_NAMES = {
    "base": ("Act", "Acts", "Box", "Discrete", "Environment", "Trajectory"),
    "cache": ("Cache",),
    "devices": ("Devices",),
    "play.any_policy": ("rollout",),
    "play.choice": ("Engine", "choose"),
    "play.episode": ("while_any",),
    "scalar": ("any_lane", "scalarize", "vmap"),
    "vector.environment": ("VectorEnv", "make_vec"),
    "vector.segments": ("Segment", "unroll"),
}
_HOME = {name: module for module, names in _NAMES.items() for name in names}
__all__ = sorted(_HOME)  # pyright: ignore[reportUnsupportedDunderAll] (they read the imports above)


def __getattr__(name: str) -> Any:
    """Imports a public name from its module on first use (PEP 562)."""
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return __all__
