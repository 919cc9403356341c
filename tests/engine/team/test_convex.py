"""Contacts of the convex collider of the device code beside C MuJoCo's, in random poses."""

import ctypes
import functools
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from experiments.checks import contacts
from experiments.kit import device_code
from mjx_reinforce.engine.team import tables

_C: Any = mujoco
_PROGRAM = Path(__file__).parents[2] / "helpers" / "touch_convex.h"
_TWO = """
<mujoco>
  {meshes}
  <worldbody>
    <geom name="first" {first}/>
    <body><freejoint/><geom name="second" {second}/></body>
  </worldbody>
  <contact><pair geom1="first" geom2="second" margin="{margin}" gap="{gap}"/></contact>
</mujoco>"""
_MESHES = """
<asset>
  <mesh name="ball" builtin="sphere" params="2" scale=".1 .08 .12"/>
  <mesh name="cone" builtin="cone" params="12 .5" scale=".1 .1 .05"/>
  <mesh name="wedge" vertex="0 0 0 .2 0 0 .2 .1 0 0 .1 0 0 0 .1 .2 0 .1 .1 .05 .02"/>
</asset>"""
_GEOMS = {
    "sphere": 'type="sphere" size=".1"',
    "capsule": 'type="capsule" size=".06 .15"',
    "ellipsoid": 'type="ellipsoid" size=".1 .15 .07"',
    "cylinder": 'type="cylinder" size=".1 .08"',
    "box": 'type="box" size=".1 .15 .07"',
    **{name: f'type="mesh" mesh="{name}"' for name in ("ball", "cone", "wedge")},
}
_PAIRS = [
    *(("sphere", x) for x in ("ellipsoid", "cone")),
    *(("capsule", x) for x in ("ellipsoid", "cylinder", "cone")),
    *(("ellipsoid", x) for x in ("ellipsoid", "cylinder", "box", "ball")),
    *(("cylinder", x) for x in ("cylinder", "box", "cone")),
    *(("box", x) for x in ("cone", "wedge")),
    *(("ball", x) for x in ("cone", "wedge")),
]
#: How far the second geom is from the first, where 1 is where they begin to touch.
_DISTANCES = (0.1, 0.5, 0.9, 0.99, 0.999, 1.01)
_NUM_POSES = 240
#: MuJoCo's ccd_tolerance (m).
_TOLERANCE = 1e-6


class _Errors(NamedTuple):
    """How contacts of many poses differ, [poses]: numbers, distances (m), places and frames."""

    number: np.ndarray
    distance: np.ndarray
    pose: np.ndarray


def _library(model: Any, folder: Path, real: str) -> Any:
    """Returns the program of ``touch_convex.h`` for a model."""
    text = tables.physics_text(model).split("// The operations of")[0]
    source = folder / "touch.cpp"
    source.write_text(text + _PROGRAM.read_text("utf-8"), "utf-8")
    library = folder / f"touch_{real}.so"
    options = ["-O0", "-std=c++17", "-w", "-shared", "-fPIC", f"-DREAL={real}"]
    command = [str(device_code.COMPILER), *options, str(source), "-o", str(library)]
    subprocess.run(command, check=True)
    return ctypes.CDLL(str(library))


def _by_us(library: Any, qpos: np.ndarray) -> np.ndarray:
    """Returns contacts as ``contacts.TwoGeoms.by_c`` has them, [K, 13]."""
    rows = np.zeros((8, 13))
    places = (ctypes.c_void_p(x.ctypes.data) for x in (qpos, rows))
    return rows[: library.touch(*places)]


def _by_c(model: Any, data: Any) -> np.ndarray:
    """Returns C's contacts, [K, 13]."""
    _C.mj_kinematics(model, data)
    _C.mj_collision(model, data)
    contact = data.contact
    rows = np.hstack([contact.dist[:, None], contact.pos, contact.frame])
    return rows[contact.dist < model.pair_margin[0]]


def _poses(model: Any) -> Iterator[np.ndarray]:
    """Yields places and quaternions of the second geom, [7]."""
    rng = np.random.default_rng(0)
    data = _C.MjData(model)
    rights = Rotation.create_group("O")
    for count in range(_NUM_POSES):
        direction = rng.normal(size=3)
        direction /= np.linalg.norm(direction)
        quat = rng.normal(size=4)
        if count % 2:  # faces are nearly parallel
            turn = Rotation.from_rotvec(0.02 * rng.normal(size=3)) * rights[int(rng.integers(24))]
            quat = np.roll(turn.as_quat(), 1)
        low, high = 0.0, 1.0
        for _ in range(30):
            middle = (low + high) / 2
            data.qpos[:] = [*(middle * direction), *quat]
            low, high = (middle, high) if len(_by_c(model, data)) else (low, middle)
        distance = low * _DISTANCES[count // 2 % len(_DISTANCES)]
        yield np.array([*(distance * direction), *(quat / np.linalg.norm(quat))])


@functools.lru_cache(maxsize=2 * len(_PAIRS))
def _expected(kinds: tuple[str, str], margin: float) -> tuple[Any, list[Any]]:
    """Returns the model of two geoms, and pairs of poses of the second and C's contacts there."""
    first, second = (_GEOMS[x] for x in kinds)
    gap = margin / 2
    text = _TWO.format(first=first, second=second, margin=margin, gap=gap, meshes=_MESHES)
    model = _C.MjModel.from_xml_string(text)
    data = _C.MjData(model)
    pairs = []
    for qpos in _poses(model):
        data.qpos[:] = qpos
        pairs.append((qpos, _by_c(model, data)))
    return model, pairs


def _errors(kinds: tuple[str, str], margin: float, folder: Path, real: str = "double") -> _Errors:
    """Returns how contacts differ from C's."""
    model, pairs = _expected(kinds, margin)
    library = _library(model, folder, real)
    rows = []
    touches = 0
    for qpos, theirs in pairs:
        ours = _by_us(library, qpos)
        touches += len(theirs) > 0
        is_equal = len(ours) == len(theirs)
        depths = [x[:, 0].min(initial=0) for x in (ours, theirs)]
        pose_error = contacts.error(ours, theirs) if is_equal else np.inf
        rows.append((not is_equal, abs(depths[0] - depths[1]), pose_error))
    assert _NUM_POSES / 3 < touches < _NUM_POSES
    return _Errors(*np.array(rows, float).T)


@pytest.mark.slow
@pytest.mark.skipif(device_code.COMPILER is None, reason="there is no C++ compiler")
@pytest.mark.parametrize("margin", [0.0, 0.02])
@pytest.mark.parametrize("kinds", _PAIRS, ids="-".join)
def test_contacts_are_c_s(kinds, margin, tmp_path):
    errors = _errors(kinds, margin, tmp_path)
    # Of a few, rounding decides which of equal corners touch, or at which step C's search ends.
    assert errors.number.mean() < 0.01
    assert np.quantile(errors.distance, 0.95) < _TOLERANCE
    assert np.quantile(errors.pose, 0.8) < 1e-9


@pytest.mark.slow
@pytest.mark.skipif(device_code.COMPILER is None, reason="there is no C++ compiler")
@pytest.mark.parametrize("margin", [0.0, 0.02])
@pytest.mark.parametrize("kinds", _PAIRS, ids="-".join)
def test_contacts_in_float32(kinds, margin, tmp_path):
    errors = _errors(kinds, margin, tmp_path, "float")
    assert np.isfinite(errors.distance).all()
    assert errors.number.mean() < 0.01
    assert np.quantile(errors.distance, 0.9) < 5 * _TOLERANCE
    assert np.quantile(errors.pose, 0.9) < 1e-3
