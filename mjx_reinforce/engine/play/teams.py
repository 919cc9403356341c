"""Which environments teams of lanes play, all or only few episodes of them, and their physics."""

import ctypes
from typing import Any

from mjx_reinforce.engine.base import MjModel, PhysicsModel
from mjx_reinforce.engine.gpu.team_kernel import FEW_WARPS, MANY_WARPS, Physics
from mjx_reinforce.engine.play import available, c_mujoco

#: Models of fewer degrees of freedom play faster by a thread an episode, if one can play them.
_LEAST_DOFS = 14
#: Models of so many degrees of freedom, or more, are played by 32 lanes.
_WIDE_DOFS = 16
#: Models of so many, or fewer, may be played by 8 lanes.
_NARROW_DOFS = 8
#: With more possible contacts, eight lanes play a narrow model faster where its file allows few
#: iterations: where too many touch for a thread, it searches with the rows of all.
_CONTACTS_OF_THREAD = 16
#: With so many possible contacts with friction, or more, sixteen lanes play few episodes of a model
#: faster than threads do (docs/engine.md).
_FRICTIONAL_CONTACTS = 10
#: CUDA's number of the attribute of a GPU: bytes of shared memory that a block may have.
_SHARED_OF_BLOCK = 97


def why_not(env: Any) -> str | None:
    """Returns in one line why teams do not play an environment alone; None if they do."""
    model = physics_model(env)
    if model is None:
        return "it simulates no model of MuJoCo's"
    from mjx_reinforce.engine.team import tables  # imports MuJoCo

    can_be_threads = c_mujoco.why_best(env) is None
    if can_be_threads and not _is_for_teams(model.mj_model):
        return f"a thread plays a model of fewer than {_LEAST_DOFS} degrees of freedom faster"
    return tables.why(model.mj_model, model.random)


def play_few(env: Any) -> bool:
    """Returns whether teams play few episodes of an environment of which threads play many.

    So many are few that each team has one at most; see ``gpu.team_kernel.for_items``.
    """
    model = physics_model(env)
    if model is None or c_mujoco.why_best(env) is not None or _is_for_teams(model.mj_model):
        return False
    from mjx_reinforce.engine.team import contact_kinds, tables

    # A thread searches alone through the rows of all contacts, which lanes share, and few threads
    # leave most of a GPU idle. With one iteration, there is no search.
    searches = model.mj_model.opt.iterations > 1
    is_slow = searches and contact_kinds.num_frictional(model.mj_model) >= _FRICTIONAL_CONTACTS
    return is_slow and tables.why(model.mj_model, model.random) is None


def _is_for_teams(model: MjModel) -> bool:
    """Returns whether teams play a model faster than threads."""
    return model.nv >= _LEAST_DOFS or _is_narrow(model)


def _is_narrow(model: MjModel) -> bool:
    """Returns whether eight lanes play a model faster than a thread or sixteen."""
    from mjx_reinforce.engine.physics.early_stop import stops_early
    from mjx_reinforce.engine.team import supported

    is_small = model.nv <= _NARROW_DOFS
    return is_small and stops_early(model) and supported.num_parts(model) > _CONTACTS_OF_THREAD


def played_by(env: Any) -> str:
    """Returns what plays an episode of an environment on a GPU, for people."""
    model = physics_model(env)
    reason = why_not(env)
    if model is not None and play_few(env):
        return f"{_lanes(model)} lanes an episode, or a thread where there are many"
    if model is None or reason:
        return f"a thread an episode ({reason})"
    return f"{_lanes(model)} lanes an episode"


def physics_model(env: Any) -> PhysicsModel | None:
    """Returns what an environment simulates, within wrappers too; None if it does not offer it."""
    get_model = getattr(c_mujoco.innermost(env), "physics_model", None)
    if get_model is None:
        return None
    return get_model()


def team_physics(model: PhysicsModel) -> Physics:
    """Returns the physics of a model that teams play."""
    from mjx_reinforce.engine.team import tables

    physics = Physics(
        text=tables.physics_text(model.mj_model, random=model.random),
        far=tables.far_words(model.mj_model, random=model.random),
        skip=model.frame_skip,
        lanes=1,
        shared=0,
    )
    if available.platform() == "cpu":
        return physics
    lanes = _lanes(model)
    # Where a lane has two rows of the Newton step's matrix it needs more registers than the threads
    # of many warps have, and as many states do not fit into shared memory.
    has_room = model.mj_model.nv < lanes
    warps = MANY_WARPS if has_room else FEW_WARPS
    return physics._replace(lanes=lanes, shared=_shared_memory(), warps=warps)


def _lanes(model: PhysicsModel) -> int:
    """Returns how many lanes play an episode."""
    if _is_narrow(model.mj_model):
        return 8
    return 32 if model.mj_model.nv >= _WIDE_DOFS else 16


def _shared_memory() -> int:
    """Returns how many bytes of shared memory a block may have."""
    driver = ctypes.CDLL("libcuda.so.1")
    num_bytes = ctypes.c_int()
    driver.cuDeviceGetAttribute(ctypes.byref(num_bytes), _SHARED_OF_BLOCK, 0)
    return num_bytes.value
