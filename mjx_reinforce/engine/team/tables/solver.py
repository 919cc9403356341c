"""Numbers of the constraint solver that are C's own."""

from typing import Any

import mujoco
import numpy as np

from mjx_reinforce.engine.physics.early_stop import stops_early
from mjx_reinforce.engine.team import flags
from mjx_reinforce.engine.team.tables.store import Tables

_C: Any = mujoco  # a C extension without stubs


def fill(tables: Tables) -> None:
    """Makes the numbers of the constraint solver that are C's own."""
    model = tables.model
    tables.constants["STOPS_EARLY"] = stops_early(model)
    tables.constants["STEPS"] = model.opt.iterations
    tables.constants["LENGTHS"] = model.opt.ls_iterations
    tables.constants["WARM"] = not flags.is_off(model, "warmstart")
    is_one = flags.is_off(model, "island")
    tables.constants["ONE_ISLAND"] = is_one
    tables.constants["NOSLIP"] = model.opt.noslip_iterations
    tables.real_constants["NOSLIP_TOLERANCE"] = float(model.opt.noslip_tolerance)
    # The degrees of freedom of each tree, where C solves the trees that rows join apart.
    trees = np.asarray(model.dof_treeid)
    masks = [sum(1 << int(dof) for dof in np.flatnonzero(trees == x)) for x in sorted({*trees})]
    is_approximate = stops_early(model) or model.opt.noslip_iterations > 0
    has_islands = is_approximate and not is_one and len(masks) > 1
    tables.constants["NTREES"] = len(masks) if has_islands else 1
    fixed_links = [0] * (1 + model.nmocap)
    links = [masks[trees[dof]] for dof in model.jnt_dofadr] + fixed_links
    tables.masks["tree_dofs"] = masks if has_islands else []
    tables.masks["link_tree"] = links if has_islands else []
    tables.real_constants["TOLERANCE"] = float(model.opt.tolerance)
    tables.real_constants["LENGTH_TOLERANCE"] = float(model.opt.ls_tolerance)
    tables.real_constants["MEAN_TRACE"] = float(model.stat.meaninertia * model.nv)


def is_elliptic(model: Any) -> bool:
    """Returns whether friction cones are elliptic."""
    return model.opt.cone == _C.mjtCone.mjCONE_ELLIPTIC


def smallest_gain(model: Any) -> str:
    """Returns C++ of the gain of a step, in cost, below which the search ends."""
    # In float32 a step that lowers the cost by less is rounding; in float64 the search goes on
    # until no row changes. The cost of an elliptic cone that slides is not quadratic, and no
    # step is the last by itself: in float32 one of a tenth of C's tolerance is, in float64 one
    # whose square is rounding, as Newton's method squares what is left.
    single, double = (2e-9, 1e-20) if is_elliptic(model) else (1e-10, 0.0)
    scale = float(model.stat.meaninertia * model.nv)
    return f"SINGLE ? real({single * scale!r}) : real({double * scale!r})"
