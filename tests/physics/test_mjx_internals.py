"""The one file that touches what MJX does not publish, and what a new MJX would change."""

import ast
import hashlib
import importlib
import inspect
import os
import re
import tomllib
import types
from importlib import metadata
from pathlib import Path

import gymnasium
import jax
import mujoco
import pytest
from mujoco import mjx
from mujoco.mjx._src import collision_driver, collision_primitive
from places import ROOT

from mjx_reinforce.physics import contacts, mjx_internals

PUSHER = Path(os.path.dirname(gymnasium.__file__), "envs", "mujoco", "assets", "pusher_v5.xml")

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

#: MJX's functions that ours replace or whose source ours depend on: the hash of their source, and
#: what of ours to compare with them.
SOURCES = {
    "forward.step": (
        "b25af3cda302bfb9569f0c60baf11474130769540646ec864516cd2aa73bf954",
        "step.step",
    ),
    "forward.forward": (
        "0f86d3820f2ef626298dfcaec3536e4b756e8529b54d316f012cbfdba81a7ba5",
        "step.forward",
    ),
    "forward.fwd_position": (
        "e9fde5828232a5eb9804fa46d86181b8ca364585e1d89f0b8c6962f41de33306",
        "contacts.fwd_position",
    ),
    "forward.rungekutta4": (
        "8e32c117bbccf41f1c309d0a677dcf0b568575bf2d8fb0dc95a5a461f429d62c",
        "runge_kutta.runge_kutta_4",
    ),
    "forward.implicit": (
        "5dca724c13bb5edf35ac28d093b80635e5f35eae9b5c6363983ea3bbd5b568e8",
        "inertia.implicitfast",
    ),
    "derivative.deriv_smooth_vel": (
        "025065bdc7a99d3a56526cfb71b644516e4a257b611481be35042cb88a2526d8",
        "inertia.implicitfast (which velocities the forces depend on)",
    ),
    "support.muscle_gain": (
        "e50a61e39d67822707247bd7f436e684ffcd3698f7c5ba01b618919680eb586a",
        "inertia.implicitfast (its derivative)",
    ),
    "forward._advance": (
        "999ba748df645057050516c216bcfb3ea341d33207d413a9b570fe493f9d29ea",
        "mjx_internals.advance (runge_kutta)",
    ),
    "constraint._efc_limit_slide_hinge": (
        "0a9ef2da54b801f4a42dd504667eba6109e05df62f8465dd97454fdbc3f00fbc",
        "limits.past_limit and limits.solve_limits",
    ),
    "constraint.make_constraint": (
        "08ea07ad04cd25549b866f5e954ca8da70f648bd4fc32b0168a0e72200b9ede1",
        "constraints.solve, rows.make_constraint (which rows there are, in which order)",
    ),
    "solver.solve": (
        "e052e9cdd4255a970360662c1cef4723f85f5483a175e7f10082a608c6909403",
        "newton.solve_newton",
    ),
    "smooth.solve_m": (
        "58a57c2a3ed4519fce2da85eb5d88563e29f5d005dc8c988afcdd0381c7f4b14",
        "limits.solve_limits",
    ),
    "collision_driver.collision": (
        "0b7104d7b1479df84bf061b005006d7018c86b54f9c012f46b2e08960a40ed36",
        "mjx_internals.collision_with",
    ),
    "collision_primitive.collider": (
        "061f1d27d48505fb051f1228921d4f09f9dcb1cf69527e26a3e7b55a2b590f07",
        "contacts (what a collision function takes and returns)",
    ),
    "constraint._efc_contact_pyramidal": (
        "4eb189a3cefeb465ef34d16c7cad72dd82ec5f4e83ed3951465c05da8dad0caf",
        "rows.make_constraint",
    ),
    "constraint._efc_contact_frictionless": (
        "1aff58c6bce64b04d36433e9aa7b07d6414aa5484d5a4785956866f0bd4a8600",
        "rows.make_constraint",
    ),
    "collision_primitive.plane_capsule": (
        "489e98d1216ea8b29461f68157bd7ce6993a9414c2db8df639329eb5af83711e",
        "contacts.plane_capsule",
    ),
    "collision_primitive.sphere_capsule": (
        "47fc429aae7a2ac602ffe4a8a929bc911d25d3b76b9914386062a2ae4fe1d37d",
        "contacts.sphere_capsule",
    ),
    "collision_primitive.capsule_capsule": (
        "a09b10b02f182204a1375e510d25694c808dff68f3b233a6a47f2139f9712f88",
        "contacts.capsule_capsule",
    ),
    "scan._nvmap": (
        "b9c9d6b469719fd11bc3b06d61bd4674d4dda3341aab4332add1416072af941a",
        "mjx_internals._fenced_level",
    ),
    "scan.flat": (
        "fa97b409ce08638dc62198845d2815331c265074231044c4cdcc7869f924a8b5",
        "mjx_internals.fenced",
    ),
    "scan.body_tree": (
        "f43e16166ed9044ea671cef11622b22fd15ab85d57cd301160ef0f3d5b42f4ec",
        "mjx_internals.fenced",
    ),
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
        actual = text and hashlib.sha256(text.encode()).hexdigest()
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
    assert found == {"mjx_reinforce/physics/mjx_internals.py"}


# ------------------------------------------------------------------------------- names replaced


def fake(code):
    """Returns a module with this code, as another version of MJX might have it."""
    module = types.ModuleType("mujoco.mjx._src.fake")
    exec(code, vars(module))
    return module


@pytest.mark.parametrize(
    "code",
    [
        "def solve(x): return helper(x)",
        "def solve(x):\n  def inner(): return helper(x)\n  return inner()",
        "def solve(x): return [helper(y) for y in x]",
    ],
)
def test_a_name_that_is_looked_up_passes(code):
    mjx_internals.check_lookup(fake(code), "solve", "helper")


@pytest.mark.parametrize(
    "code",
    [
        "def solve(x): return helper_2(x)",
        "def solve(x): return x.helper",
        "def solve(helper): return helper(1)",
        "helper = None",
        "from math import sin as solve",
        "from json import dumps as solve",
    ],
)
def test_a_name_that_is_not_looked_up_raises(code):
    with pytest.raises(RuntimeError) as error:
        mjx_internals.check_lookup(fake(code), "solve", "helper")
    installed = f"mujoco-mjx {metadata.version('mujoco-mjx')} (tested: 3.17.*)"
    for part in ("mujoco.mjx._src.fake.solve", " helper,", installed):
        assert part in str(error.value)


def test_a_function_that_another_module_has_raises():
    """A name given another meaning in one module is not seen by a function of another."""
    module = fake("helper = None")
    vars(module)["solve"] = fake("def solve(x): return helper(x)").solve
    with pytest.raises(RuntimeError, match="solve does not look up helper"):
        mjx_internals.check_lookup(module, "solve", "helper")


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
