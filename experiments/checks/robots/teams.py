"""Which models the device code of teams covers, and how it plays them beside C MuJoCo.

One lane plays in float64, compiled for this CPU. C plays the file as it is, with its own iterations
and tolerance.
"""

import copy
import functools
import importlib
import re
import tempfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from experiments.checks.robots import judging, models
from experiments.kit import device_code, rows
from experiments.kit.markdown import table
from mjx_reinforce.engine.team import supported

mujoco: Any = importlib.import_module("mujoco")  # pyright does not know what is in it

#: Columns of the rows. The verdict is "accepted", "refused", "no model", "crashed" or "too long".
#: error20 is the largest error of qpos and qvel after 20 physics steps, relative above 1; ratio200
#: is that after 200 steps, divided by how far C gets from itself after starts that are 1e-12 apart.
#: error20_exact and ratio200_exact are the same beside C with tolerance 0.
COLUMNS = ("package", "model", "nv", "nu", "verdict", "cause", "error20", "ratio200")
COLUMNS += ("error20_exact", "ratio200_exact")
#: What the errors and ratios are to be at most.
MAX_ERROR = 1e-9
MAX_RATIO = 100.0
_FEW_STEPS = 20
_MANY_STEPS = 200
#: A control is held for so many physics steps.
_HOLD = 10
_NUDGE = 1e-12
_NUM_NUDGES = 3
_MAX_GIGABYTES = 32.0

#: The state after each physics step: qpos, then qvel.
States = list[np.ndarray]


def judge(path: Path, sender: Any) -> None:
    """Judges one model and sends the parts of its row.

    Args:
      path: of the model.
      sender: the end of a pipe.
    """
    judging.isolate(_MAX_GIGABYTES)
    try:
        model, _ = models.load(path)
    except ValueError as error:
        sender.send({"verdict": "no model", "cause": judging.words(error, path)})
        return
    reason = supported.why(model)
    sizes = {"nv": model.nv, "nu": model.nu}
    if reason:
        sender.send({"verdict": "refused", "cause": judging.words(reason, path), **sizes})
        return
    sender.send({"verdict": "accepted", **sizes})
    try:
        sender.send(parity(model))
    except Exception as error:  # whatever it is, the next model is judged
        sentence = judging.words(f"{type(error).__name__}: {error}", path)
        sender.send({"verdict": "crashed", "cause": sentence})


def parity(model: Any) -> dict[str, str]:
    """Returns how far the device code is from C MuJoCo under random controls."""
    start = mujoco.MjData(model)
    if model.nkey:
        mujoco.mj_resetDataKeyframe(model, start, 0)
    random = np.random.default_rng(0)
    is_limited = model.actuator_ctrllimited.astype(bool)[:, None]
    low, high = np.where(is_limited, model.actuator_ctrlrange, (-1.0, 1.0)).T
    draws = random.uniform(low, high, (_MANY_STEPS // _HOLD, model.nu))
    controls = np.repeat(draws, _HOLD, axis=0)

    shown = states_by_device_code(model, controls, start)
    exact = copy.copy(model)
    exact.opt.tolerance = 0
    nudges = _NUDGE * random.standard_normal((_NUM_NUDGES, 2, model.nv))
    row = {}
    for suffix, reference in (("", model), ("_exact", exact)):
        by_c = functools.partial(states_by_c, reference, controls, start)
        expected = by_c()
        if len(expected) >= _FEW_STEPS:
            row[f"error20{suffix}"] = (
                f"{error(shown[_FEW_STEPS - 1], expected[_FEW_STEPS - 1]):.1e}"
            )
        if len(expected) < _MANY_STEPS:
            row["cause"] = f"C begins again in step {len(expected) + 1}"
            continue
        moved = [by_c(nudge) for nudge in nudges]
        apart = max(error(states[-1], expected[-1]) for states in moved)
        # Where C forgets its start, a difference is one of rounding.
        ratio = error(shown[-1], expected[-1]) / max(apart, np.finfo(float).eps)
        row[f"ratio200{suffix}"] = f"{ratio:.2g}"
    return row


def states_by_c(
    model: Any, controls: np.ndarray, start: Any, nudge: np.ndarray | None = None
) -> States:
    """Returns the states after steps of C MuJoCo, up to the one before it begins again.

    Args:
      model: the model.
      controls: [T, nu] of the steps.
      start: the simulation at their start.
      nudge: [2, nv] by how much qpos and qvel are moved first.
    """
    data = copy.copy(start)
    if nudge is not None:
        mujoco.mj_integratePos(model, data.qpos, nudge[0], 1)
        data.qvel[:] += nudge[1]
    states = []
    breaking = [
        int(getattr(mujoco.mjtWarning, f"mjWARN_{name}"))
        for name in ("BADQPOS", "BADQVEL", "BADQACC", "BADCTRL", "CONTACTFULL", "CNSTRFULL")
    ]
    for control in controls:
        data.ctrl[:] = control
        mujoco.mj_step(model, data)
        if any(data.warning[kind].number for kind in breaking):
            break
        states.append(np.concatenate([data.qpos, data.qvel]))
    return states


def states_by_device_code(model: Any, controls: np.ndarray, start: Any) -> States:
    """Returns the states after steps of the device code; see ``states_by_c``."""
    with tempfile.TemporaryDirectory() as folder:
        play = device_code.compiled(model, Path(folder))
    state = {name: getattr(start, name).copy() for name in device_code.STATE}
    states = []
    for control in controls:
        play(state, control, 1)
        states.append(np.concatenate([state["qpos"], state["qvel"]]))
    return states


def error(shown: np.ndarray, expected: np.ndarray) -> float:
    """Returns the largest difference of two states, relative above 1; infinity for NaN."""
    differences = np.abs(shown - expected) / np.maximum(1, np.abs(expected))
    return float(np.nan_to_num(differences, nan=np.inf).max(initial=0))


def measure(output: Path, folder: Path, seconds: float) -> None:
    """Judges every model that has no row yet, appends its row, and prints the counts of all.

    Args:
      output: the rows.
      folder: a folder for each package.
      seconds: a model may take so long.
    """
    known = rows.read(output) if output.exists() else []
    finished = {(row["package"], row["model"]) for row in known}
    folder = folder.resolve()
    paths = models.files(folder)
    for count, path in enumerate(paths, start=1):
        package, *parts = path.relative_to(folder).parts
        key = {"package": package, "model": "/".join(parts)}
        if tuple(key.values()) in finished:
            continue
        row = dict.fromkeys(COLUMNS, "") | key | judging.answers(judge, path, seconds=seconds)
        rows.append(output, [row], COLUMNS)
        print(f"{count} of {len(paths)}:", *row.values(), flush=True)
    print(summary(rows.read(output)))


def summary(raw_rows: Sequence[Mapping[str, str]]) -> str:
    """Returns a table of counts for each set of models: files, and those that teams cover.

    Files without actuators are no robots for a policy, and do not count.
    """

    def at_most(limit: float, texts: Iterable[str]) -> str:
        """Returns how many numbers there are that are no larger."""
        return str(sum(float(text) <= limit for text in texts if text))

    table_rows = []
    for name, select in SETS.items():
        files = [row for row in select(raw_rows) if row["nu"] not in ("", "0")]
        # What crashes or takes too long after it was accepted counts as covered.
        covered = [row for row in files if row["verdict"] != "refused"]
        cells = [name, str(len(files)), str(len(covered))]
        for suffix in ("", "_exact"):
            cells.append(at_most(MAX_ERROR, (row[f"error20{suffix}"] for row in covered)))
            cells.append(at_most(MAX_RATIO, (row[f"ratio200{suffix}"] for row in covered)))
        table_rows.append(cells)
    beside = (f"20 steps: {MAX_ERROR:g}", f"200 steps: ratio {MAX_RATIO:g}")
    exact = [f"{column}, tolerance 0" for column in beside]
    return table(("set", "files", "covered", *beside, *exact), table_rows)


def _files_for_mjx(raw_rows: Iterable[Mapping[str, str]]) -> list[Mapping[str, str]]:
    """Returns Menagerie's files for MJX."""
    return [
        row
        for row in raw_rows
        if row["package"] == "mujoco_menagerie" and "mjx" in Path(row["model"]).stem
    ]


def _robots(raw_rows: Iterable[Mapping[str, str]]) -> list[Mapping[str, str]]:
    """Returns the first scene of each robot of Menagerie that is not one for MJX."""
    scenes: dict[str, Mapping[str, str]] = {}
    for row in raw_rows:
        robot, _, name = row["model"].partition("/")
        is_scene = name.startswith("scene") and "mjx" not in name
        if row["package"] == "mujoco_menagerie" and is_scene:
            first = scenes.get(robot, row)
            scenes[robot] = min(first, row, key=lambda scene: scene["model"])
    return [*scenes.values()]


def _playground(raw_rows: Iterable[Mapping[str, str]]) -> list[Mapping[str, str]]:
    """Returns Playground's scenes of robots."""
    scene = r"/(locomotion/.*/scene|manipulation/.*/(mjx_)?(scene|single|cabinet|hand_over))[^/]*$"
    return [
        row for row in raw_rows if row["package"] == "playground" and re.search(scene, row["model"])
    ]


#: Sets of models by name, and which of the rows are of them.
SETS: dict[str, Callable[..., Sequence[Mapping[str, str]]]] = {
    "Menagerie's files for MJX": _files_for_mjx,
    "Menagerie's robots": _robots,
    "Playground's robot scenes": _playground,
    "all": list,
}
