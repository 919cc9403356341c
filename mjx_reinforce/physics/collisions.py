"""Which bodies of a model can meet, for those who want fewer contacts."""

from collections import Counter
from typing import TYPE_CHECKING

from mjx_reinforce.physics.mjx_internals import geom_pairs

if TYPE_CHECKING:
    from mujoco import mjx

_LISTED = 3


def advice(model: "mjx.Model") -> str:
    """Returns how to make a compiled model's contacts fewer; empty where no geoms can meet."""
    pairs = [pair[:2] for pair in geom_pairs(model)]
    if not pairs:
        return ""
    bodies = Counter(int(body) for pair in pairs for body in {*model.geom_bodyid[list(pair)]})
    named = [
        f"{model.body(body).name or f'number {body}'!r} ({count})"
        for body, count in bodies.most_common(_LISTED)
    ]
    return (
        f"its geoms can meet in {len(pairs):,} pairs, most of them at the bodies "
        f"{', '.join(named)}: let fewer collide, such as the feet alone, by "
        'contype="0" conaffinity="0" of the other geoms'
    )
