"""What a task on a user's own model carries from step to step."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from experiments.checks import matrix
from experiments.checks.mechanisms import MODELS, mechanisms
from mjx_reinforce.envs import models
from mjx_reinforce.envs.base import MujocoEnv


def test_every_state_of_mujoco_is_accounted_for():
    """Each bit of mjtState is carried, given, constant, or refused."""
    bits = {name for name in dir(mujoco.mjtState) if name.startswith("mjSTATE_")}
    combined = {f"mjSTATE_{name}" for name in ("FULLPHYSICS", "INTEGRATION", "PHYSICS", "USER")}
    named = {"qacc_warmstart": "warmstart"}
    known = (*models.CARRIED, "ctrl", *models.CONSTANT, *models.NOT_CARRIED)
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
