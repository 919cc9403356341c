"""The engine's public names and their homes: what type checkers read, and ``__init__.py`` too."""

from mjx_reinforce.engine.base import Act, Acts, Box, Discrete, Environment, Trajectory
from mjx_reinforce.engine.cache import Cache
from mjx_reinforce.engine.devices import Devices
from mjx_reinforce.engine.episode import while_any
from mjx_reinforce.engine.play.choice import Engine, choose, rollout
from mjx_reinforce.engine.scalar import any_lane, scalarize, vmap
from mjx_reinforce.engine.vector.environment import VectorEnv, make_vec
from mjx_reinforce.engine.vector.segments import Segment, unroll

__all__ = [
    "Act",
    "Acts",
    "Box",
    "Cache",
    "Devices",
    "Discrete",
    "Engine",
    "Environment",
    "Segment",
    "Trajectory",
    "VectorEnv",
    "any_lane",
    "choose",
    "make_vec",
    "rollout",
    "scalarize",
    "unroll",
    "vmap",
    "while_any",
]
