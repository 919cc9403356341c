"""What a user would otherwise pick, as far as it is installed here, to be timed."""

import ctypes
import functools
import importlib.util
import math
import time
from typing import Any

import numpy as np

from experiments.kit.rows import threads
from experiments.speed.benchmark.robots import make
from experiments.speed.benchmark.rows import Candidate

#: MuJoCo Warp by itself, not the copy in MJX.
WARP_PACKAGES = "mujoco-warp==4.0.0 warp-lang==1.19.0"
#: Env steps that MuJoCo Warp's worlds have gone through before they are timed.
WARP_BEFORE = 50
#: What MuJoCo Warp may have too little room for: `OverflowType`, without the limits of iterations.
WARP_ROOM = ("NEFC", "NJMAX_NNZ", "BROADPHASE", "NARROWPHASE", "CCD", "EPA_HORIZON")


def peers(env_id: str) -> list[Candidate]:
    """C MuJoCo on all threads; Gymnasium's vector environment and EnvPool where they can run."""
    candidates = [c_mujoco(env_id)] if hasattr(make(env_id), "mj_model") else []
    if _in_gymnasium(env_id):
        candidates.append(gymnasium_vector(env_id))
    if _in_envpool(env_id):
        candidates.append(envpool_vector(env_id))
    return candidates


def c_mujoco(env_id: str, batch: int = 512, steps: int = 20) -> Candidate:
    """``mujoco.rollout`` under random actions, on all threads, in double precision.

    No policy; the states of all physics steps are recorded, which ``mujoco.rollout`` always does.
    """
    from mujoco import MjData, mj_getState, mj_stateSize, mjtState, rollout  # type: ignore

    env = make(env_id)
    model = env.mj_model
    full = mjtState.mjSTATE_FULLPHYSICS
    start = np.empty(mj_stateSize(model, full))
    mj_getState(model, _start(model), start, full)
    data = [MjData(model) for _ in range(threads())]
    control = np.repeat(_controls(env, batch, steps), env.frame_skip, axis=1)
    pool = rollout.Rollout(nthread=threads())

    def run():
        pool.rollout(model, data, np.tile(start, (batch, 1)), control)

    row = {"what": "rollout, no policy", "engine": "C MuJoCo", "task": env_id}
    row |= {"precision": "float64", "batch": batch, "steps": steps, "device": "cpu"}
    row["settings"] = f"{threads()} threads; {options(model)}"
    return Candidate(row, run, batch * steps)


def mujoco_warp(env_id: str, batch: int, steps: int = 20) -> Candidate:
    """MuJoCo Warp under constant random actions: no policy, no noise, nothing recorded.

    Each run begins where the worlds have gone through ``WARP_BEFORE`` steps, so that what falls has
    come to contacts. One CUDA graph plays an env step. There is room for what `warp_room` finds,
    doubled until those steps need no more.

    Raises:
      ImportError: it is not installed.
      RuntimeError: a world came to need more (when run).
    """
    for name in ("mujoco_warp", "warp"):
        if not importlib.util.find_spec(name):
            raise ImportError(f"there is no package {name}: pip install {WARP_PACKAGES}")
    import mujoco_warp  # pyright: ignore
    import warp  # pyright: ignore
    from mujoco import mj_forward  # type: ignore
    from mujoco_warp import OverflowType  # pyright: ignore

    warp.config.log_level = warp.LOG_WARNING
    env = make(env_id)
    model = env.mj_model
    data = _start(model)
    mj_forward(model, data)
    started = time.perf_counter()
    on_gpu = mujoco_warp.put_model(model)
    on_gpu.opt.warn_overflow = 0  # said once, below
    actions = _controls(env, batch, 1)[:, 0].astype(np.float32)
    too_small = sum(OverflowType[name] for name in WARP_ROOM)

    def begin(room):
        worlds = mujoco_warp.put_data(model, data, nworld=batch, **room)
        worlds.ctrl.assign(actions)

        def play():
            for _ in range(env.frame_skip):
                mujoco_warp.step(on_gpu, worlds)

        play()  # compiles
        with warp.ScopedCapture() as capture:
            play()
        return worlds, capture.graph  # the graph has the addresses of the worlds alone

    def go(worlds, graph, count):
        for _ in range(count):
            warp.capture_launch(graph)
        warp.synchronize()
        return OverflowType(int(np.bitwise_or.reduce(worlds.overflow.numpy())) & too_small)

    room = warp_room(env_id)
    kept = begin(room)
    while go(*kept, WARP_BEFORE):
        room = {name: 2 * size for name, size in room.items()}
        kept = begin(room)
    state = [getattr(kept[0], name) for name in ("qpos", "qvel", "qacc_warmstart")]
    start = [warp.clone(array) for array in state]

    def run():
        for array, old in zip(state, start, strict=True):
            warp.copy(array, old)
        if lacking := go(*kept, steps):
            raise RuntimeError(f"{env_id}: MuJoCo Warp had too little room: {lacking!r} in {room}")

    row: dict[str, Any] = {"what": "rollout, no policy", "engine": "MuJoCo Warp", "task": env_id}
    row |= {"precision": "float32", "batch": batch, "steps": steps}
    row["device"] = warp.get_device().name
    most = {"nconmax": kept[0].nacon.numpy()[0] / batch, "njmax": kept[0].nefc.numpy().max()}
    sizes = ", ".join(f"{name} {size} ({most[name]:.3g} in use)" for name, size in room.items())
    own = f"graph_conditional {on_gpu.opt.graph_conditional}, tolerance at least 1e-6"
    versions = f"mujoco-warp {mujoco_warp.__version__}, warp {warp.__version__}"
    row["settings"] = f"{sizes}, no world overflowed; {options(model)}; {own}; {versions}"
    row["compile_seconds"] = time.perf_counter() - started
    return Candidate(row, run, batch * steps)


@functools.cache
def warp_room(env_id: str, worlds: int = 64, steps: int = 130) -> dict[str, int]:
    """Returns how many contacts (nconmax) and rows (njmax) a world of MuJoCo Warp needs.

    Half as many again as C MuJoCo has at most, in as many worlds under constant random actions, and
    the next multiple of eight.
    """
    from mujoco import mj_step  # type: ignore

    env = make(env_id)
    model = env.mj_model
    contacts = rows = 0
    for control in _controls(env, worlds, 1)[:, 0]:
        data = _start(model)
        data.ctrl[:] = control
        for _ in range(steps * env.frame_skip):
            mj_step(model, data)
            contacts, rows = max(contacts, data.ncon), max(rows, data.nefc)
    return {"nconmax": _above(1.5 * contacts), "njmax": _above(1.5 * rows)}


def _above(x: float) -> int:
    return max(8, 8 * math.ceil(x / 8))


def options(model) -> str:
    """Returns a model's solver settings in words."""
    from mujoco import mjtCone, mjtIntegrator, mjtJacobian, mjtSolver  # type: ignore

    opt = model.opt
    kinds = (mjtSolver(opt.solver), mjtIntegrator(opt.integrator), mjtCone(opt.cone))
    names = [kind.name.partition("_")[2] for kind in (*kinds, mjtJacobian(opt.jacobian))]
    solver, integrator, cone, jacobian = names
    return (
        f"{solver}, {opt.iterations} iterations of {opt.ls_iterations} line-search steps, "
        f"tolerance {opt.tolerance:g}, {integrator}, {cone} cones, {jacobian} Jacobian"
    )


def gymnasium_vector(env_id: str, batch: int = 8, steps: int = 50) -> Candidate:
    """Gymnasium's synchronous vector environment under random actions; no policy."""
    import gymnasium

    env = gymnasium.make_vec(env_id, num_envs=batch, vectorization_mode="sync")
    env.reset(seed=0)
    actions = [env.action_space.sample() for _ in range(steps)]

    def run():
        for action in actions:
            env.step(action)

    row = {"what": "rollout, no policy", "engine": "Gymnasium", "task": env_id}
    row |= {"precision": "float64", "batch": batch, "steps": steps, "device": "cpu"}
    row["settings"] = f"gymnasium {gymnasium.__version__}, vectorization_mode sync"
    return Candidate(row, run, batch * steps)


def envpool_vector(env_id: str, batch: int = 64, steps: int = 40) -> Candidate:
    """EnvPool's environment of this name under random actions, on all threads; no policy.

    It waits for all of the batch in each step, and starts episodes that are over again.
    """
    import envpool  # pyright: ignore
    from envpool.mujoco import mujoco_gym_envpool  # pyright: ignore

    env = envpool.make_gymnasium(env_id, num_envs=batch, num_threads=threads(), seed=0)
    env.reset()
    low, high = env.action_space.low, env.action_space.high
    actions = np.random.default_rng(0).uniform(low, high, (steps, batch, *low.shape))
    actions = actions.astype(env.action_space.dtype)

    def run():
        for action in actions:
            env.step(action)

    library = ctypes.CDLL(mujoco_gym_envpool.__file__)
    library.mj_versionString.restype = ctypes.c_char_p
    row = {"what": "rollout, no policy", "engine": "EnvPool", "task": env_id}
    row |= {"precision": "float64", "batch": batch, "steps": steps, "device": "cpu"}
    inner = library.mj_versionString().decode()
    row["settings"] = f"{threads()} threads; envpool {envpool.__version__}, MuJoCo {inner} in it"
    return Candidate(row, run, batch * steps)


def _start(model: Any) -> Any:
    """Returns a simulation at the model's first key frame, or at its pose."""
    from mujoco import MjData, mj_resetDataKeyframe  # type: ignore

    data = MjData(model)
    if model.nkey:
        mj_resetDataKeyframe(model, data, 0)
    return data


def _controls(env: Any, batch: int, steps: int) -> np.ndarray:
    """Draws actions evenly between their bounds; returns their controls [batch, steps, U]."""
    low, high = env.action_space
    actions = np.random.default_rng(0).uniform(low, high, (batch, steps, env.action_size))
    return np.asarray(env.control(actions))


def _in_gymnasium(env_id: str) -> bool:
    if not importlib.util.find_spec("gymnasium"):
        return False
    import gymnasium

    return env_id in gymnasium.registry


def _in_envpool(env_id: str) -> bool:
    if not importlib.util.find_spec("envpool"):
        return False
    import envpool  # pyright: ignore

    return env_id in envpool.list_all_envs()
