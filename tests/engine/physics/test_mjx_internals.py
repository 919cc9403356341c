"""The one file that touches what MJX does not publish, and what a new MJX would change."""

import ast
import builtins
import hashlib
import importlib
import inspect
import re
import sys
import tomllib
from importlib import metadata

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjx
from mujoco.mjx._src import collision_driver, collision_primitive
from places import ROOT

from experiments.checks import matrix
from experiments.checks.mechanisms import MODELS, mechanisms
from mjx_reinforce.engine import physics
from mjx_reinforce.engine.physics import contacts, mjx_internals
from mjx_reinforce.envs import models, refusals
from mjx_reinforce.envs.base import MujocoEnv

TOUCHING = """
<mujoco>
  <default><geom margin="10"/></default>
  <worldbody>
    <geom type="plane" size="0 0 1"/>
    <body><freejoint/><geom type="capsule" size="0.07 0.5"/></body>
    <body><freejoint/><geom type="capsule" size="0.1 0.3"/></body>
  </worldbody>
</mujoco>
"""

#: MJX's functions that ours replace or whose source ours depend on: the start of the hash of their
#: source, and what of ours to compare with them.
SOURCES = {
    "forward.step": ("b25af3cda302bfb9", "step.step"),
    "forward.forward": ("0f86d3820f2ef626", "step.forward"),
    "forward.fwd_position": ("e9fde5828232a5eb", "contacts.fwd_position"),
    "forward.rungekutta4": ("8e32c117bbccf41f", "step.runge_kutta_4"),
    "forward.implicit": ("5dca724c13bb5edf", "inertia.implicitfast"),
    "derivative.deriv_smooth_vel": ("025065bdc7a99d3a", "inertia.implicitfast (what it is)"),
    "support.muscle_gain": ("e50a61e39d678227", "inertia.implicitfast (its derivative)"),
    "forward._advance": ("999ba748df645057", "mjx_internals.advance (step)"),
    "constraint._efc_limit_slide_hinge": ("0a9ef2da54b801f4", "limits"),
    "constraint.make_constraint": ("08ea07ad04cd2554", "step, rows (which rows)"),
    "constraint._kbi": ("16350ddae982313c", "impedance"),
    "solver.solve": ("e052e9cdd4255a97", "newton.solve_newton"),
    "smooth.solve_m": ("58a57c2a3ed4519f", "limits.solve_limits"),
    "collision_driver.collision": ("0b7104d7b1479df8", "mjx_internals.collision_with"),
    "collision_driver.make_condim": (
        "86d240a22d3c85f7",
        "mjx_internals.data_with, models.load_model (numerics)",
    ),
    "collision_driver._geom_groups": ("5804541131828c57", "mjx_internals (which pairs)"),
    "collision_driver._contact_groups": ("4babcfc65a122524", "mjx_internals (which pairs)"),
    "io._make_data_jax": ("afc76c1461124fe9", "mjx_internals.data_with"),
    "collision_primitive.collider": ("061f1d27d48505fb", "contacts (what they take)"),
    "constraint._efc_contact_pyramidal": ("4eb189a3cefeb465", "rows.make_constraint"),
    "constraint._efc_contact_frictionless": ("1aff58c6bce64b04", "rows.make_constraint"),
    "collision_primitive.plane_capsule": ("489e98d1216ea8b2", "contacts.plane_capsule"),
    "collision_primitive.sphere_capsule": ("47fc429aae7a2ac6", "contacts.sphere_capsule"),
    "collision_primitive.capsule_capsule": ("a09b10b02f182204", "contacts.capsule_capsule"),
    "sensor.sensor_acc": ("54ba32544e29725b", "sensors (what it leaves out)"),
    "smooth.kinematics": ("92beade60af6e6f9", "mjx_internals.kinematics"),
    "smooth.rne_postconstraint": ("bd9282d1448b35f4", "sensors (what it leaves out)"),
    "smooth.tendon": ("388e2cb427608f21", "tendons (which pieces), mjx_internals.wrap_points"),
    "smooth.tendon_dot": ("2fcfed9813567531", "tendons"),
    "support.wrap": ("3a9745b4f6649b84", "mjx_internals.wrap_points"),
    "constraint._efc_limit_tendon": ("1bd53cfe6ea74059", "tendons (the rows)"),
    "constraint._efc_equality_tendon": ("62aef7cae8326f4a", "tendons (the rows)"),
    "scan._nvmap": ("b9c9d6b469719fd1", "mjx_internals._fenced_level"),
    "scan.flat": ("fa97b409ce08638d", "mjx_internals.fenced"),
    "scan.body_tree": ("f43e16166ed9044e", "mjx_internals.fenced"),
}


def source(path):
    """Returns the source text of a function of MJX, decorators included, or None."""
    module, name = path.split(".")
    text = inspect.getsource(importlib.import_module(f"mujoco.mjx._src.{module}"))
    for node in ast.parse(text).body:
        if isinstance(node, ast.FunctionDef) and node.name == name:
            first = min([node.lineno, *(decorator.lineno for decorator in node.decorator_list)])
            return "\n".join(text.splitlines()[first - 1 : node.end_lineno])
    return None


def test_mjx_is_the_one_that_was_read():
    """A new MJX fails here first; the numbers of the other tests then say whether it matters."""
    changed = []
    for path, (expected, ours) in SOURCES.items():
        text = source(path)
        actual = text and hashlib.sha256(text.encode()).hexdigest()[:16]
        if actual != expected:
            changed.append(f"{path}: compare with {ours}; its hash is now {actual}")
    assert not changed, (
        f"mujoco-mjx {metadata.version('mujoco-mjx')} differs from "
        f"{mjx_internals.TESTED_VERSIONS['mujoco-mjx']} in functions that mjx_reinforce replaces "
        "or depends on. Read each change, adapt ours, then put the new hash into SOURCES:\n"
        + "\n".join(changed)
    )


def test_the_installed_versions_are_tested_and_bounded():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    for package, tested in mjx_internals.TESTED_VERSIONS.items():
        assert metadata.version(package).startswith(f"{tested}.")
        major, minor = tested.split(".")
        assert f"{package}>={tested},<{major}.{int(minor) + 1}" in project["dependencies"]


def test_one_file_touches_what_mjx_does_not_publish():
    private = re.compile(r"mjx\._src|mjx import _src|(?<!dtype\.)\b_impl\b")
    files = [*(ROOT / "mjx_reinforce").rglob("*.py"), *(ROOT / "envs").rglob("*.py")]
    found = {
        str(path.relative_to(ROOT)) for path in files if private.search(path.read_text("utf-8"))
    }
    assert found == {"mjx_reinforce/engine/physics/mjx_internals.py"}


def test_a_name_that_is_not_looked_up_raises():
    with pytest.raises(RuntimeError, match=r"collision does not look up other.*mujoco-mjx==3\.17"):
        mjx_internals.check_lookup(mjx.collision, "other")


def test_mjx_is_left_as_it_is():
    model = mujoco.MjModel.from_xml_string(TOUCHING)  # pyright: ignore
    mx, start = mjx.put_model(model, impl="jax"), mjx.make_data(model, impl="jax")

    def program(position):
        def frames(data):
            return mjx_internals.jax_fields(position(mx, data)).contact.frame

        return str(jax.make_jaxpr(frames)(start))

    table = dict(collision_driver._COLLISION_FUNC)
    before = program(mjx.fwd_position)
    assert program(contacts.fwd_position) != before
    assert program(mjx.fwd_position) == before
    assert table == collision_driver._COLLISION_FUNC
    capsules = mjx.GeomType.CAPSULE, mjx.GeomType.CAPSULE
    assert table[capsules] is collision_primitive.capsule_capsule


SOURCE = "print('no warp'); import sys; NUMBER = 3; sys.stdout.write('heard ')\n"


@pytest.fixture
def package(monkeypatch, tmp_path):
    """A package with two modules that print, of which one is MJX's."""
    folder = tmp_path / "printing"
    folder.mkdir()
    for name in ("__init__", "warp", "other"):
        (folder / f"{name}.py").write_text("" if name == "__init__" else SOURCE)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(sys, "meta_path", [*sys.meta_path])
    monkeypatch.setattr(physics, "_WARP", "printing.warp")
    physics.silence_mjx()
    yield "printing"
    for name in [name for name in sys.modules if name.startswith("printing")]:
        del sys.modules[name]


def test_only_that_module_prints_nothing(package, capsys):
    module = importlib.import_module(f"{package}.warp")
    assert capsys.readouterr().out == "heard "
    assert module.NUMBER == 3
    assert "print" not in vars(module)
    importlib.import_module(f"{package}.other")
    assert capsys.readouterr().out == "no warp\nheard "
    assert print is builtins.print


def test_a_module_that_is_not_there_is_missing(package, monkeypatch):
    monkeypatch.setattr(physics, "_WARP", f"{package}.gone")
    with pytest.raises(ModuleNotFoundError, match="gone"):
        importlib.import_module(f"{package}.gone")


# -------------------------------------------------------------------------------------------------
# What a task on a user's own model carries from step to step.


def test_every_state_of_mujoco_is_accounted_for():
    """Each bit of mjtState is carried, given, constant, or refused."""
    bits = {name for name in dir(mujoco.mjtState) if name.startswith("mjSTATE_")}
    combined = {f"mjSTATE_{name}" for name in ("FULLPHYSICS", "INTEGRATION", "PHYSICS", "USER")}
    named = {"qacc_warmstart": "warmstart"}
    known = (*models.CARRIED, "ctrl", *models.CONSTANT, *refusals.NOT_CARRIED)
    assert {f"mjSTATE_{named.get(name, name).upper()}" for name in known} == bits - combined


@pytest.mark.slow
def test_machine_code_carries_activations():
    [mechanism] = [x for x in mechanisms() if (x.name, x.axis) == ("filter, RK4", "features")]
    with jax.enable_x64(True):
        [cell] = matrix.compare([mechanism], native=True)
    assert cell.verdict == "equal", cell


class Watched(MujocoEnv):
    """The arm with a filter; it shows what ``before`` and ``data`` have."""

    carried = ("ctrl", "xpos")

    def __init__(self, path):
        super().__init__(xml_file=path, frame_skip=2, max_episode_steps=9, reward_threshold=None)

    def initial(self, rng):
        return jnp.zeros(2), jnp.ones(2)

    def outcome(self, before, data, action):
        terms = {
            "passed": data.time - before.time,
            "force": before.ctrl[0],
            "moved": jnp.abs(data.xpos - before.xpos).max(),
            "rose": (data.act - before.act)[0],
        }
        return data.time, False, terms


@pytest.fixture
def path(tmp_path):
    path = tmp_path / "arm.xml"
    path.write_text(MODELS["filter"], encoding="utf-8")
    return str(path)


@pytest.mark.slow
def test_before_is_what_was(path):
    env = Watched(path)
    step, state = jax.jit(env.step), env.reset(jax.random.key(0))
    last, time = 0.0, 0.0
    for force in (0.5, -1.0, 0.25):
        state = step(state, jnp.full(1, force))
        time += env.dt
        assert state.reward == pytest.approx(time)
        assert state.metrics["passed"] == pytest.approx(env.dt)
        assert state.metrics["force"] == last
        assert state.metrics["moved"] > 0
        assert np.sign(state.metrics["rose"]) == np.sign(force)
        last = force


def test_what_was_not_kept_is_not_read(path):
    class Forgetful(Watched):
        carried = ()

    with pytest.raises(AttributeError, match=r"before.ctrl is not known.*carried = \('ctrl',\)"):
        Forgetful(path).reset(jax.random.key(0))
