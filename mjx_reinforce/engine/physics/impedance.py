"""MJX's constraint rows, whose impedance is that of C MuJoCo where a solimp falls or has no width.

The impedance of a row goes from the first number of ``solimp`` to its second as the row's distance
goes from 0 to the width (MuJoCo's documentation, "Computation", "Parameters"). MJX 3.17 clips it
between the two, which leaves the second alone where the first is larger. C interpolates there too,
and takes the mean of the two where the width is zero (``getimpedance``).
"""

from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx

from mjx_reinforce.engine.physics import mjx_internals

#: MuJoCo's own names; it is a C extension without stubs.
_C: Any = mujoco
#: Fields of a model that say how soft its constraints are.
_SOLIMPS = (
    "dof_solimp",
    "eq_solimp",
    "geom_solimp",
    "jnt_solimp",
    "pair_solimp",
    "tendon_solimp_lim",
    "tendon_solimp_fri",
)


def make_constraint(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Makes the constraint rows: where every solimp rises, those of ``mjx.make_constraint``."""
    if _rises(model):
        return mjx.make_constraint(model, data)
    return _rows_with_falls(model, data)


def _rises(model: mjx.Model) -> bool:
    """Returns whether no solimp of a model falls or has no width."""
    solimps = np.concatenate([np.asarray(getattr(model, name)) for name in _SOLIMPS])
    low, high, width = solimps[:, :3].T
    return bool(np.all((low == high) | ((low < high) & (width > _C.mjMINVAL))))


def _impedance(model: mjx.Model, solref: jax.Array, solimp: jax.Array, pos: jax.Array) -> tuple:
    """Returns stiffness [], damping [] and impedance [] of a row, as C MuJoCo.

    Args:
      model: of which the flags count.
      solref: [2]
      solimp: [5]
      pos: [] the distance.
    """
    stiffness, damping, rise = mjx_internals.kbi(model, solref, solimp, pos)
    # C clips dmin and dmax (``getsolparam``); MJX also clips what is between them.
    low, high = jnp.clip(solimp[:2], _C.mjMINIMP, _C.mjMAXIMP)
    # A fall is the mirror image of the rise between the same two numbers.
    mirror_solimp = solimp.at[:2].set(solimp[1::-1])
    fall = low + high - mjx_internals.kbi(model, solref, mirror_solimp, pos)[2]
    impedance = jnp.where(low > high, fall, rise)
    is_flat = solimp[2] <= _C.mjMINVAL
    return stiffness, damping, jnp.where(is_flat, (low + high) / 2, impedance)


_rows_with_falls = mjx_internals.rows_with(_impedance)
