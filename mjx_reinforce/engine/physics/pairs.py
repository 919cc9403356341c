"""Pairs of geoms one after the other, and only where their bounding spheres meet, as in C.

MJX collides all pairs of one kind at once, which is best where XLA computes many episodes. Machine
code for one episode (``fused``) is a loop over the pairs: short, and quick where geoms are apart.
"""

import types
from collections import Counter
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from mujoco import mjx

from mjx_reinforce.engine.physics.mjx_internals import geom_pairs
from mjx_reinforce.engine.scalar import by_engine

#: A collision function of MJX: (model, data, key, geoms [P, 2]) -> dist, pos, frame of contacts.
Collide = Callable[..., Any]
#: How many bodies ``advice`` names.
_LISTED = 3


def one_by_one(collide: Collide) -> Collide:
    """Returns a collision function that gives the same contacts, wherever geoms touch.

    Of contacts between geoms that are apart only the sign of the distance is right.

    Args:
      collide: made by MJX's ``collider``, for geoms with a bounding sphere.
    """

    def together(model: mjx.Model, data: mjx.Data, key: Any, geoms: Any) -> Any:
        if model.npair:  # pairs have margins of their own
            return collide(model, data, key, geoms)
        first, second = geoms.T
        each = data.geom_xpos, data.geom_xmat, model.geom_size
        spheres = model.geom_rbound[first] + model.geom_rbound[second]
        margins = model.geom_margin[first] + model.geom_margin[second]
        rows = [jnp.stack([x[first], x[second]], 1) for x in each]

        def all_at_once(*rows: jax.Array) -> Any:
            return collide(model, data, key, geoms)

        def in_turn(*rows: jax.Array) -> Any:
            contacts = lax.scan(lambda _, row: (None, pair(*row)), None, rows)[1]
            return jax.tree.map(jnp.concatenate, contacts)

        def pair(
            pos: jax.Array, mat: jax.Array, size: jax.Array, spheres: Any, margin: jax.Array
        ) -> Any:
            place = types.SimpleNamespace(geom_xpos=pos, geom_xmat=mat)
            shape = types.SimpleNamespace(geom_size=size)

            def near() -> Any:
                return collide(shape, place, key, np.array([[0, 1]]))

            dist, *others = jax.eval_shape(near)
            gap = jnp.linalg.norm(pos[1] - pos[0]) - spheres
            return lax.cond(
                gap > margin,
                lambda: (jnp.full(dist.shape, gap), *(jnp.zeros(x.shape, x.dtype) for x in others)),
                near,
            )

        return by_engine(in_turn, all_at_once, *rows, spheres, margins, may_unroll=True)

    together.ncon = collide.ncon  # pyright: ignore
    return together


def advice(model: Any) -> str:
    """Returns how to make contacts of a MuJoCo model fewer; empty where no geoms can meet."""
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
