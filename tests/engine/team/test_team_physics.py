"""The device code of the physics, compiled with one lane in float64, beside C MuJoCo.

``python tests/engine/team/test_team_physics.py humanoid 10000`` prints the largest error of an env
step from so many states of a task's random play.
"""

import sys
import tempfile
import tomllib
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import jax
import mujoco
import numpy as np
import pytest

from experiments.checks import contacts
from experiments.kit import device_code
from experiments.kit.device_code import compiled as _compiled
from mjx_reinforce.engine.scalar import UnsupportedPrimitive
from mjx_reinforce.engine.team import supported, tables
from mjx_reinforce.envs import models

_C: Any = mujoco
needs_compiler = pytest.mark.skipif(device_code.COMPILER is None, reason="there is no C++ compiler")

_OWN = str(Path(__file__).parents[3] / "experiments" / "examples" / "quadruped")
_MODELS = tomllib.loads((Path(__file__).parent / "models.toml").read_text("utf-8"))
_QUICK = ("limits", "condim 6 and 4", "elliptic cones, condim 1 and 3", "boxes on boxes", "3 steps")
_VECTORS = ("limits", "elliptic cones, condim 1 and 3")
#: Features that reach each function which one lane computes by vectors.
_MORE_VECTORS = {
    "features": [
        "a ball, implicitfast",
        "a tendon between two trees, implicitfast",
        "limits and friction loss of tendons",
        "lone free bodies, implicitfast",
        "elliptic cones, condim 6 and 4, impratio",
        "more than 32 degrees of freedom",
        "what is convex on a mesh, elliptic cones",
        "no slip, elliptic cones of bodies that meet, implicitfast",
    ],
    "early": [
        "4 steps, elliptic cones",
        "3 steps of trees that tendons, joints and contacts join, implicitfast",
    ],
}
_SHARED = [
    "spatial tendons",
    "limits and friction loss of tendons",
    "a tendon between two trees, implicitfast",
    "weld of two bodies",
    *(x for x in _MODELS["features"] if "mocap" in x),
]
#: Those that eight lanes share in a newcomer's `pytest` too.
_QUICKLY_SHARED = ("spatial tendons", "mocap bodies that touch", "weld to a mocap body")
_MANY = '<geom size=".1"/>'
_BOX = '<geom type="box" size=".1 .1 .1"/>'
_TWO = """
<mujoco>
  <option gravity="0 0 0"/>
  <worldbody>
    <geom {first}/>
    <body><freejoint/><geom {second}/></body>
  </worldbody>
</mujoco>"""
_PAIRS = [
    ("capsule", "box"),
    ("plane", "cylinder"),
    ("plane", "ellipsoid"),
    ("sphere", "cylinder"),
    ("box", "box"),
]
_REFUSED = {
    **_MODELS["refused"],
    "4096 geoms or more": {"rest": f"<worldbody>{_MANY * 4096}</worldbody>"},
    "more than 4096 pairs": {"bodies": [f'size=".1"/>{_MANY * 64}<geom size=".1"'] * 2},
    "more than 16384 possible contacts": {
        "bodies": [f'type="box" size=".1 .1 .1"/>{_BOX * 46}<geom size=".1"'] * 2
    },
}


def _model(
    bodies: Sequence[str] | None = None,
    world: str = "",
    height: float = 0.12,
    first: str = "",
    second: str = 'axis="0 1 0"',
    actuator: str = "",
    body: str = "",
    **parts: str,
) -> Any:
    """Returns the model of parts as models.toml has them."""
    geoms = 'contype="0"' if bodies is None else ""
    if bodies is None:
        world = _MODELS["arm"].format(first=first, second=second, body=body)
    for n, geom in enumerate(bodies or ()):
        at, turned = f"{0.17 * n} {0.03 * n} {height}", f"{20 * n} 25 {40 * n}"
        world += f'<body pos="{at}" euler="{turned}"><freejoint/><geom {geom}/></body>'
    rest = f"<actuator>{actuator}</actuator>" if actuator else ""
    given = {"option": "", "geoms": geoms, "rest": rest, **parts, "world": world}
    return _C.MjModel.from_xml_string(_MODELS["scene"].format_map(given))


def _marked(names: Iterable[str]) -> list[Any]:
    """Returns tests by their names, of which a newcomer runs a few: each compiles a program."""
    return [pytest.param(x, marks=[] if x in _QUICK else pytest.mark.slow) for x in names]


def _exact(m: Any) -> Any:
    """Lets C MuJoCo's solver run to its optimum."""
    m.opt.tolerance, m.opt.iterations, m.opt.ls_tolerance, m.opt.ls_iterations = 0, 100, 1e-14, 100
    return m


def _error(m: Any, play: Any, data: Any, skip: int) -> float:
    """Plays an env step here and in C; returns the largest error, relative where above 1."""
    is_touch = m.sensor_type == _C.mjtSensor.mjSENS_TOUCH
    mine = {name: getattr(data, name).copy() for name in device_code.STATE}
    mine |= play(mine, data.ctrl, skip, _numbers(m, data))
    theirs = {}
    for _ in range(skip):
        theirs |= {f"pass_{name}": getattr(data, name).copy() for name in ("qpos", "qvel")}
        _C.mj_step(m, data)
    _C.mj_rnePostConstraint(m, data)
    theirs |= {"pass_qacc": data.qacc, "touch": data.sensordata[m.sensor_adr[is_touch]]}
    if m.opt.integrator == _C.mjtIntegrator.mjINT_RK4:  # of its last stage C keeps the poses
        last = _C.MjData(m)
        last.qpos[:] = mine["pass_qpos"]
        last.mocap_pos[:] = data.mocap_pos
        last.mocap_quat[:] = data.mocap_quat
        _C.mj_kinematics(m, last)
        mine = {name: x for name, x in mine.items() if name not in theirs}
        mine |= {"xquat": last.xquat.ravel(), "site_xpos": last.site_xpos.ravel()}
    errors = []
    for name, x in mine.items():
        want = np.asarray(theirs[name] if name in theirs else getattr(data, name)).ravel()
        errors.append(np.abs(x - want).max(initial=0) / max(1, np.abs(want).max(initial=0)))
    return max(errors)


def _numbers(m: Any, data: Any) -> np.ndarray:
    """Returns what the device code reads of the poses of mocap bodies."""
    with jax.enable_x64(True):
        poses = {name: getattr(data, name) for name in ("mocap_pos", "mocap_quat")}
        return np.array(tables.drawn_numbers(m, (), poses))


def _largest_error(
    m: Any, folder: Any, skip: int, starts: int, near=tables.NUM_NEAR, lanes=1, *, vectors=False
):
    """Returns the largest error of steps along short episodes of random play."""
    play = _compiled(m, folder, near, lanes, vectors=vectors)
    rng, errors = np.random.default_rng(0), []
    for _ in range(starts):
        data = _C.MjData(m)
        data.qvel[:] = 0.3 * rng.normal(size=m.nv)
        data.mocap_pos += 0.02 * rng.normal(size=(m.nmocap, 3))
        data.mocap_quat += 0.2 * rng.normal(size=(m.nmocap, 4))  # not of length 1
        for _ in range(10):
            data.ctrl[:] = rng.uniform(-1, 1, m.nu)
            errors.append(_error(m, play, data, skip))
            for _ in range(skip * 2):
                _C.mj_step(m, data)
    return max(errors)


@needs_compiler
@pytest.mark.slow
@pytest.mark.parametrize("task", ["half_cheetah", "ant", "humanoid", "humanoid_standup", _OWN])
def test_tasks(task, tmp_path):
    m = models.load_model(f"{task}.xml")
    assert _largest_error(_exact(m), tmp_path, skip=5, starts=2) < 1e-9


@needs_compiler
@pytest.mark.slow
@pytest.mark.parametrize("lanes", [1, 8])
def test_contacts_that_do_not_fit_are_kept(lanes, tmp_path):
    m = models.load_model("humanoid_standup.xml")
    assert _largest_error(_exact(m), tmp_path, skip=2, starts=1, near=1, lanes=lanes) < 1e-9


@needs_compiler
@pytest.mark.slow
@pytest.mark.parametrize(("task", "lanes"), [("half_cheetah", 16), ("ant", 16), ("humanoid", 32)])
def test_lanes_in_any_order_play_alike(task, lanes, tmp_path):
    m = models.load_model(f"{task}.xml")
    assert _largest_error(_exact(m), tmp_path, skip=2, starts=1, lanes=lanes) < 1e-9


@pytest.mark.slow
@needs_compiler
@pytest.mark.parametrize("option", ["", 'iterations="2" ls_iterations="4"'])
@pytest.mark.parametrize(("nv", "lanes"), [(31, 32), (35, 32), (36, 4)])
def test_more_rows_than_lanes(nv, lanes, option, tmp_path):
    """A chain on the floor, whose H and right side are dealt to the lanes more than once."""
    geom = '<geom type="capsule" fromto="0 0 0 .1 0 0" size=".03" contype="0"/>'
    chain = ""
    for n in range(nv - 6):
        joint = f'<joint axis="0 {n % 2} {1 - n % 2}" damping=".02" range="-40 40"/>'
        chain = f'<body pos=".1 0 0">{joint}{geom}{chain}</body>'
    world = f'<body pos="0 0 .04"><freejoint/>{geom}{chain}</body>'
    m = _model(bodies=[], world=world, option=option)
    assert m.nv == nv
    m = m if option else _exact(m)
    assert _largest_error(m, tmp_path, skip=2, starts=1, lanes=lanes) < 1e-9


@needs_compiler
@pytest.mark.parametrize("feature", _marked(_MODELS["features"]))
def test_features(feature, tmp_path):
    m = _model(**_MODELS["features"][feature])
    assert _largest_error(_exact(m), tmp_path, skip=3, starts=3) < 1e-9


@needs_compiler
@pytest.mark.parametrize("limits", _marked(_MODELS["early"]))
def test_a_search_that_stops_early_ends_where_c_ends(limits, tmp_path):
    m = _model(**_MODELS["early"][limits])
    assert _largest_error(m, tmp_path, skip=3, starts=3) < 1e-9


@needs_compiler
@pytest.mark.parametrize(
    ("part", "feature"),
    [
        *(("features", x) for x in _VECTORS),
        *(
            pytest.param(part, x, marks=pytest.mark.slow)
            for part, names in _MORE_VECTORS.items()
            for x in names
        ),
    ],
)
def test_one_lane_computes_in_vectors(part, feature, tmp_path):
    m = _model(**_MODELS[part][feature])
    m = _exact(m) if part == "features" else m
    assert _largest_error(m, tmp_path, skip=3, starts=2, vectors=True) < 1e-9


@needs_compiler
@pytest.mark.slow
@pytest.mark.parametrize("task", ["humanoid", "humanoid_standup", _OWN])
def test_tasks_in_vectors(task, tmp_path):
    m = models.load_model(f"{task}.xml")
    assert _largest_error(_exact(m), tmp_path, skip=5, starts=2, near=1, vectors=True) < 1e-9


@needs_compiler
@pytest.mark.parametrize(
    ("feature", "lanes"),
    [
        pytest.param(
            *(x, lanes), marks=[] if lanes == 8 and x in _QUICKLY_SHARED else pytest.mark.slow
        )
        for x in _SHARED
        for lanes in (2, 8)
    ],
)
def test_lanes_share_cables_and_mocap_bodies(feature, lanes, tmp_path):
    m = _model(**_MODELS["features"][feature])
    assert _largest_error(_exact(m), tmp_path, skip=3, starts=1, lanes=lanes) < 1e-9


@needs_compiler
@pytest.mark.slow
@pytest.mark.parametrize("feature", [x for x in _MODELS["features"] if x.startswith("no slip")])
def test_lanes_share_friction_without_slip(feature, tmp_path):
    m = _model(**_MODELS["features"][feature])
    assert _largest_error(_exact(m), tmp_path, skip=3, starts=1, lanes=8) < 1e-9


@needs_compiler
@pytest.mark.slow
@pytest.mark.parametrize("limits", [x for x in _MODELS["early"] if "that" in x])
def test_lanes_share_islands(limits, tmp_path):
    m = _model(**_MODELS["early"][limits])
    assert _largest_error(m, tmp_path, skip=3, starts=1, lanes=8) < 1e-9


@needs_compiler
@pytest.mark.slow
@pytest.mark.parametrize("lanes", [1, 8])
@pytest.mark.parametrize(
    "feature", ["boxes on boxes", "no slip, elliptic cones of bodies that meet"]
)
def test_pairs_whose_parts_are_many_are_whole(feature, lanes, tmp_path, monkeypatch):
    (name,) = [x for x in _MODELS["features"] if x.startswith(feature)]
    m = _model(**_MODELS["features"][name])
    monkeypatch.setattr(supported, "MAX_ITEMS", 30)
    assert "WHOLE_PAIRS = 1" in tables.physics_text(m)
    assert _largest_error(_exact(m), tmp_path, skip=3, starts=1, lanes=lanes) < 1e-9


@needs_compiler
@pytest.mark.slow
@pytest.mark.parametrize("near", [3, tables.NUM_NEAR])
def test_lanes_find_all_contacts_of_convex_pairs(near, tmp_path):
    m = _model(**_MODELS["features"]["what is convex on a mesh, elliptic cones"])
    assert _largest_error(_exact(m), tmp_path, skip=3, starts=1, near=near, lanes=8) < 1e-9


@needs_compiler
@pytest.mark.slow
@pytest.mark.parametrize("cone", ["pyramidal", "elliptic"])
def test_a_quadruped_that_takes_few_steps(cone, tmp_path):
    spec = _C.MjSpec.from_file(f"{_OWN}.xml")
    spec.option.cone = getattr(_C.mjtCone, f"mjCONE_{cone.upper()}")
    spec.option.iterations, spec.option.ls_iterations = 2, 5
    assert _largest_error(spec.compile(), tmp_path, skip=2, starts=2, lanes=8) < 1e-9


@needs_compiler
@pytest.mark.slow
@pytest.mark.parametrize("sizes", ["longer", "flatter"])
@pytest.mark.parametrize("kinds", _PAIRS, ids="-".join)
def test_two_geoms_meet_in_every_pose(kinds, sizes, tmp_path):
    """Of the families of ``experiments.checks.contacts``."""
    geoms, rng = contacts.TwoGeoms(*kinds), np.random.default_rng(0)
    turns = ("any", "nearly aligned")  # where rounding decides nothing
    families = [x for x in contacts.FAMILIES if x[0] == sizes and x[1] in turns for _ in range(12)]
    size = contacts.draw(geoms, families[0], rng).size
    first, second = (
        f'type="{kind}" size="{" ".join(map(str, x))}"' for kind, x in zip(kinds, size, strict=True)
    )
    m = _exact(_C.MjModel.from_xml_string(_TWO.format(first=first, second=second)))
    play, errors = _compiled(m, tmp_path, tables.NUM_NEAR, 1), []
    for family in families:
        pose, data = contacts.draw(geoms, family, rng, size), _C.MjData(m)
        back, exact = pose.mat[0].T, geoms.by_c(pose)
        data.qpos[:3] = back @ (pose.pos[1] - pose.pos[0])
        _C.mju_mat2Quat(data.qpos[3:], (back @ pose.mat[1]).ravel())
        moved = [geoms.by_c(x) for _ in range(3) for x in contacts.moved(pose, rng)]
        if all(contacts.error(x, exact) < contacts.EQUAL for x in moved):
            errors.append(_error(m, play, data, 1))
    assert len(errors) > 120
    assert max(errors) < 1e-9


@pytest.mark.parametrize("reason", _REFUSED)
def test_what_is_not_covered_is_named(reason):
    m = _model(**_REFUSED[reason])
    assert str(tables.why(m)).startswith(f"the model has {reason}")


@pytest.mark.parametrize("reason", _MODELS["randomized"])
def test_a_random_field_that_is_not_covered_is_named(reason):
    parts = dict(_MODELS["randomized"][reason])
    random = parts.pop("random")
    m = _model(**parts)
    assert tables.why(m) is None
    assert str(tables.why(m, random)).startswith(f"the model has {reason}")


def test_actuators_of_several_controls_are_named():
    m = _model(actuator='<motor joint="a"/>')
    m.actuator_ctrlnum[0] = 2  # no element of MuJoCo's XML makes one
    assert "actuators of several controls" in str(tables.why(m))


def test_a_model_that_is_not_covered_has_no_device_code():
    m = _model(**_REFUSED["a capsule that meets a hfield"])
    with pytest.raises(UnsupportedPrimitive, match="a capsule that meets a hfield"):
        tables.physics_text(m)


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as made:
        task = models.load_model(f"{sys.argv[1]}.xml")
        print(_largest_error(_exact(task), Path(made), skip=5, starts=int(sys.argv[2]) // 10))
