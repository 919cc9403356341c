"""A user's own model is simulated as by C MuJoCo, refused in words, or named in parity.md."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from experiments.checks import own_models
from experiments.checks.feature_models import MODELS
from mjx_reinforce.envs import models
from mjx_reinforce.envs.base import MujocoEnv

#: What is refused, and what the refusal says.
REFUSED = {
    "armature of an actuator": "would ignore the armature of an actuator",
    "damping of an actuator": "would ignore the damping of an actuator",
    "actearly": "would ignore actearly of an actuator",
    "polynomial spring": "would ignore the polynomial stiffness of a joint",
    "polynomial damping": "would ignore the polynomial damping of a joint",
    "polynomial spring of a tendon": "would ignore the polynomial stiffness of a tendon",
    "disabled actuators": "would ignore disabled groups of actuators",
    "disabled springs": 'would ignore parts of <flag spring="disable"/>',
    "disabled dampers": 'would ignore parts of <flag damper="disable"/>',
    "sleep": "would ignore sleeping bodies",
    "adhesion": "mjTRN_BODY",
    "slider-crank": "mjTRN_SLIDERCRANK",
    "delay": "would ignore delays",
    "plugin": "would ignore plugins",
    "springyield": "would ignore plastic springs",
    "implicit": 'set <option integrator="implicitfast"/>',
    "discrete": 'set <option integrator="implicitfast"/>',
    "PGS": 'set <option solver="Newton"/>',
    "adhesive geom": "would ignore adhesive geoms",
    "moving surface": "would ignore moving surfaces",
    "rangefinder": "a bug of MJX",
    "flex": "Flex",
}
#: Where MJX itself computes something else; docs/parity.md says how much.
DIFFERENT = {
    "tendon through a cylinder": 1e-6,
    "connect": 5,
    "weld": 1e-3,
    "weld to mocap": 1e-6,
    "CG": 1e-2,
    "noslip": 0.5,
    "ellipsoid fluid": 0.1,
    "mesh on a box": 1,
    "sphere on a heightfield": 0.5,
    "box on a box": 200,
}


def test_every_state_of_mujoco_is_accounted_for():
    """Each bit of mjtState is carried, given, constant, or refused."""
    bits = {name for name in dir(mujoco.mjtState) if name.startswith("mjSTATE_")}
    combined = {f"mjSTATE_{name}" for name in ("FULLPHYSICS", "INTEGRATION", "PHYSICS", "USER")}
    named = {"qacc_warmstart": "warmstart"}
    known = (*models.CARRIED, *models.GIVEN, *models.CONSTANT, *models.NOT_CARRIED)
    assert {f"mjSTATE_{named.get(name, name).upper()}" for name in known} == bits - combined


@pytest.mark.parametrize("name", MODELS)
def test_own_models(name):
    [(_, error, words)] = own_models.compare(name, ("alone",))
    if name in REFUSED:
        assert np.isnan(error)
        assert REFUSED[name] in words
    elif name in DIFFERENT:
        assert 1e-9 < error < DIFFERENT[name], words
    else:
        assert error < 1e-9, words


@pytest.mark.parametrize("name", ["muscle", "filter, RK4"])
@pytest.mark.parametrize("engine", own_models.ENGINES)
def test_engines_carry_activations(engine, name):
    [(_, error, words)] = own_models.compare(name, (engine,))
    assert error < 1e-9, words


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
