"""The device code of teams with one lane on a CPU beside C MuJoCo: physics steps per second.

    python -m experiments.speed.one_lane mujoco_menagerie --episodes 64

Each robot plays the same episodes from key frame 0 (or its initial state) under the same random
controls: by C MuJoCo's ``rollout`` and by its ``Batch``, and by the device code that a C++ compiler
has made machine code of, in float64 and in float32. All have the same number of threads, and take
turns. Seconds are those of the CPU, of all threads together, as other programs may run meanwhile;
what counts is the median over turns of a ratio within a turn. Behind it is the error: the largest
of qpos and qvel after 20 physics steps, relative above 1, in the median episode.
"""

import concurrent.futures
import ctypes
import dataclasses
import importlib
import statistics
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import tyro

from experiments.kit.device_code import COMPILER
from experiments.kit.markdown import table
from mjx_reinforce.engine.memory import num_cores
from mjx_reinforce.engine.team import tables

mujoco: Any = importlib.import_module("mujoco")  # pyright does not know what is in it
batch: Any = importlib.import_module("mujoco.batch")
rollout: Any = importlib.import_module("mujoco.rollout")

#: Scenes of Menagerie: a hand, two quadrupeds and a humanoid with hulls, cylinders or boxes.
ROBOTS = (
    "shadow_hand/scene_left.xml",
    "unitree_go2/scene.xml",
    "boston_dynamics_spot/scene.xml",
    "booster_t1/scene.xml",
)
_FEW_STEPS = 20
#: Of the velocities at the start (m/s, rad/s).
_SPREAD = 0.1

#: (qpos [episodes, nq], qvel [episodes, nv], ctrl [episodes, env steps, nu]) -> those of the end.
Player = Callable[[np.ndarray, np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]


@dataclasses.dataclass(frozen=True)
class Settings:
    """Time the device code of teams with one lane beside C MuJoCo."""

    folder: tyro.conf.Positional[Path]
    """Of Menagerie."""
    robots: tuple[str, ...] = ROBOTS
    """Scenes in it."""
    episodes: int = 64
    """Of each timed run."""
    env_steps: int = 40
    """Of an episode."""
    skip: int = 5
    """Physics steps of an env step, which hold a control."""
    repeats: int = 5
    """Turns."""
    threads: int = 2
    """Of each candidate."""
    options: tuple[str, ...] = ("-O3", "-march=native")
    """Of the compiler."""


def load(path: Path) -> Any:
    """Returns a model; what is seen and touches nothing is left out, as its files may be absent."""
    spec = mujoco.MjSpec.from_file(str(path))
    for geom in spec.geoms:
        if not geom.contype and not geom.conaffinity:
            spec.delete(geom)
    used = {geom.meshname for geom in spec.geoms}
    for mesh in spec.meshes:
        if (mesh.name or Path(mesh.file).stem) not in used:
            spec.delete(mesh)
    return spec.compile()


def by_rollout(model: Any, settings: Settings) -> Player:
    """Returns what plays by ``mujoco.rollout``."""
    data = [mujoco.MjData(model) for _ in range(settings.threads)]
    pool = rollout.Rollout(nthread=settings.threads)

    def play(qpos: np.ndarray, qvel: np.ndarray, ctrl: np.ndarray) -> tuple[Any, Any]:
        start = np.zeros((len(qpos), 1 + model.nq + model.nv + model.na))
        start[:, 1 : 1 + model.nq] = qpos
        start[:, 1 + model.nq : 1 + model.nq + model.nv] = qvel
        control = np.repeat(ctrl, settings.skip, axis=1)
        state, _ = pool.rollout(model, data, start, control)
        qpos, qvel, _ = np.split(state[:, -1, 1:], [model.nq, model.nq + model.nv], axis=1)
        return qpos, qvel

    return play


def by_batch(model: Any, settings: Settings) -> Player:
    """Returns what plays by ``Batch``, as the engine ``mujoco`` does."""
    simulations = batch.Batch(model, settings.episodes, nthread=settings.threads)

    def play(qpos: np.ndarray, qvel: np.ndarray, ctrl: np.ndarray) -> tuple[Any, Any]:
        simulations.reset()
        simulations.bind("qpos")[:] = qpos
        simulations.bind("qvel")[:] = qvel
        for control in np.swapaxes(ctrl, 0, 1):
            simulations.bind("ctrl")[:] = control
            simulations.step(nstep=settings.skip)
        return simulations.bind("qpos").copy(), simulations.bind("qvel").copy()

    return play


def by_device_code(model: Any, settings: Settings, real: str, folder: Path) -> Player:
    """Returns what plays by the device code.

    Args:
      model: the model.
      settings: of the run.
      real: the C++ type of its numbers.
      folder: for the text and the library.
    """
    text = tables.physics_text(model).split("// The operations of")[0]
    source = folder / f"{real}.cpp"
    library = folder / f"{real}.so"
    program = Path(__file__).with_name("one_lane.h").read_text("utf-8")
    source.write_text(
        f"#define REAL {real}\n#define REPORTS 0\n#define VECTORS 1\n{text}{program}", "utf-8"
    )
    options = [*settings.options, "-std=c++17", "-w", "-shared", "-fPIC"]
    start_time = time.perf_counter()
    subprocess.run([str(COMPILER), *options, str(source), "-o", str(library)], check=True)
    code = ctypes.CDLL(str(library))
    compile_seconds = time.perf_counter() - start_time
    print(f"{real}: {compile_seconds:.0f} s to compile, {code.memory_size():,} bytes an episode")
    memories = [np.zeros(code.memory_size() // 8 + 8) for _ in range(settings.threads)]
    pool = concurrent.futures.ThreadPoolExecutor(settings.threads)

    def share(memory: np.ndarray, qpos: np.ndarray, qvel: np.ndarray, ctrl: np.ndarray) -> None:
        aligned = -(-memory.ctypes.data // 64) * 64
        numbers = [ctypes.c_void_p(x.ctypes.data) for x in (qpos, qvel, ctrl)]
        code.play_episodes(ctypes.c_void_p(aligned), *ctrl.shape[:2], settings.skip, *numbers)

    def play(qpos: np.ndarray, qvel: np.ndarray, ctrl: np.ndarray) -> tuple[Any, Any]:
        qpos, qvel = qpos.copy(), qvel.copy()
        shares = [np.array_split(x, settings.threads) for x in (qpos, qvel, ctrl)]
        list(pool.map(share, memories, *shares))
        return qpos, qvel

    return play


def error(shown: tuple[Any, Any], expected: tuple[Any, Any]) -> float:
    """Returns the median over episodes of the largest difference, relative above 1."""
    x, y = np.hstack(shown), np.hstack(expected)
    return float(np.median((np.abs(x - y) / np.maximum(1, np.abs(y))).max(1)))


class Measured(NamedTuple):
    """What was measured of a robot.

    rate: physics steps per second of the CPU by ``rollout``
    ratios: of the others' rates to it: ``Batch``, float64, float32
    errors: of the same
    """

    rate: float
    ratios: list[float]
    errors: list[float]


def measure(path: Path, settings: Settings, folder: Path) -> Measured:
    """Measures a robot.

    Args:
      path: of its scene.
      settings: of the run.
      folder: for texts and libraries.
    """
    model = load(path)
    data = mujoco.MjData(model)
    if model.nkey:
        mujoco.mj_resetDataKeyframe(model, data, 0)
    random = np.random.default_rng(0)
    count = settings.episodes
    qpos = np.tile(data.qpos, (count, 1))
    qvel = _SPREAD * random.standard_normal((count, model.nv))
    is_limited = model.actuator_ctrllimited.astype(bool)[:, None]
    low, high = np.where(is_limited, model.actuator_ctrlrange, (-1.0, 1.0)).T
    ctrl = random.uniform(low, high, (count, settings.env_steps, model.nu))
    players = [by_rollout(model, settings), by_batch(model, settings)]
    players += [by_device_code(model, settings, real, folder) for real in ("double", "float")]
    # Of one length of memory: the device code reads it as it lies.
    few = ctrl[:, : -(-_FEW_STEPS // settings.skip)].copy()
    ends = [play(qpos, qvel, few) for play in players]
    seconds = []
    for _ in range(settings.repeats):
        turn = []
        for play in players:
            start_time = time.process_time()
            play(qpos, qvel, ctrl)
            turn.append(time.process_time() - start_time)
        seconds.append(turn)
    num_steps = count * settings.env_steps * settings.skip
    return Measured(
        num_steps / statistics.median(turn[0] for turn in seconds),
        [statistics.median(turn[0] / turn[n] for turn in seconds) for n in (1, 2, 3)],
        [error(end, ends[0]) for end in ends[1:]],
    )


def main() -> None:
    """Prints the table."""
    settings = tyro.cli(Settings, description=__doc__)
    rows = []
    with tempfile.TemporaryDirectory() as temporary:
        for robot in settings.robots:
            # Each has a folder: a library's file may not change while it is loaded.
            folder = Path(tempfile.mkdtemp(dir=temporary))
            measured = measure(settings.folder / robot, settings, folder)
            pairs = zip(measured.ratios, measured.errors, strict=True)
            rows.append([robot, f"{measured.rate:.3g}", *(f"{x:.2f} ({e:.0e})" for x, e in pairs)])
    print(f"{settings.threads} threads of {num_cores()} cores, {' '.join(settings.options)}")
    print(table(("scene", "rollout (steps/s)", "Batch", "float64", "float32"), rows))


if __name__ == "__main__":
    main()
