"""The device code of a model's physics, in float64 on a CPU, to be played beside C MuJoCo."""

import ctypes
import importlib
import re
import shutil
import subprocess
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any

import jax
import numpy as np

from mjx_reinforce.engine.team import tables

mujoco: Any = importlib.import_module("mujoco")  # pyright does not know what is in it

#: A C++ compiler; None where there is none.
COMPILER = shutil.which("c++") or shutil.which("g++") or shutil.which("clang++")
#: What a simulation carries from step to step.
STATE = ("qpos", "qvel", "qacc_warmstart")

#: (state by the names of ``STATE``, which changes in place; controls [nu]; number of steps; the
#: numbers of ``tables.drawn_numbers``, by default those of the model itself) -> what the last step
#: reports, by the names of ``report_sizes``.
Steps = Callable[..., dict[str, np.ndarray]]


def report_sizes(model: Any) -> dict[str, int]:
    """Returns how many numbers ``play_steps.h`` writes of each field of mjData, in its order."""
    of_a_body = {"xpos": 3, "xipos": 3, "cinert": 10, "cvel": 6, "cfrc_ext": 6}
    sizes = {name: size * model.nbody for name, size in of_a_body.items()}
    num_touches = int(np.sum(model.sensor_type == mujoco.mjtSensor.mjSENS_TOUCH))
    sizes |= {"qfrc_actuator": model.nv, "pass_qpos": model.nq, "pass_qvel": model.nv}
    return sizes | {"pass_qacc": model.nv, "touch": num_touches}


def compiled(
    model: Any,
    folder: Path,
    num_near: int = tables.NUM_NEAR,
    lanes: int = 1,
    random: Collection[str] = (),
    *,
    vectors: bool = False,
) -> Steps:
    """Returns what plays a model's physics steps.

    Args:
      model: an ``MjModel`` that teams play.
      folder: for the text and the library, of its own for each call.
      num_near: contacts that the state of a team has room for.
      lanes: of the team; several take turns, see ``turns.h``.
      random: the names of fields of the model that differ from episode to episode.
      vectors: whether the only lane computes by whole rows, see ``vectors.h``.

    Raises:
      UnsupportedPrimitive: the device code lacks something that the model has.
    """
    kit = Path(__file__).parent
    text = tables.physics_text(model, num_near, random).split("// The operations of")[0]
    run = "play()"
    if lanes > 1:
        turns = (kit / "turns.h").read_text("utf-8")
        run = "turns.run(play)"
        team = r"struct Team {\n  int lane = 0;.*?\n};\n"
        text, num_teams = re.subn(team, lambda _: turns, text, flags=re.DOTALL)
        assert num_teams == 1
    program = (kit / "play_steps.h").read_text("utf-8")
    source = folder / "play.cpp"
    library = folder / "play.so"
    macros = f"#define W {lanes}\n#define VECTORS {int(vectors)}\n#define RUN {run}\n"
    source.write_text(f"{macros}{text}{program}", "utf-8")
    options = ["-O0", "-std=c++17", "-w", "-shared", "-fPIC"]
    subprocess.run([str(COMPILER), *options, str(source), "-o", str(library)], check=True)
    play_steps = ctypes.CDLL(str(library)).play_steps
    sizes = report_sizes(model)
    ends = np.cumsum([*sizes.values()])
    with jax.enable_x64(True):
        own_numbers = np.array(tables.drawn_numbers(model, random, {}))

    def play(
        state: dict[str, np.ndarray],
        control: np.ndarray,
        num_steps: int,
        drawn: np.ndarray | None = None,
    ) -> dict[str, np.ndarray]:
        """Makes so many physics steps; see ``Steps``."""
        ctrl = np.resize(control, max(model.nu, 1)).astype(float)
        report = np.zeros(ends[-1])
        numbers = [state[name] for name in STATE]
        drawn = own_numbers if drawn is None else drawn
        start = [_pointer(x) for x in (*numbers, ctrl, drawn)]
        play_steps(*start, num_steps, _pointer(report))
        return dict(zip(sizes, np.split(report, ends[:-1]), strict=True))

    return play


def _pointer(numbers: np.ndarray) -> ctypes.c_void_p:
    """Returns where an array of float64 is."""
    assert numbers.dtype == float
    assert numbers.flags.c_contiguous
    return ctypes.c_void_p(numbers.ctypes.data)
