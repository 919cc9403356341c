"""The model that an environment offers to an engine, and the programs that simulate it."""

import types

import jax
import mujoco
import pytest

from mjx_reinforce import envs
from mjx_reinforce.engine import base, scalar
from mjx_reinforce.engine.play import teams
from mjx_reinforce.engine.scalar import jaxprs, scalarized
from mjx_reinforce.engine.team import contact_kinds
from mjx_reinforce.envs.tasks.ant import Ant


def traced_step(env):
    """Returns the program of an env step whose physics is one operation."""
    state = base.shapes(env.reset, jax.random.key(0))
    with base.keeping_whole():
        return scalarized.trace(env.step, state, base.null_action(env))[0]


def test_a_model_has_one_name_whatever_object_has_it():
    """So a program is the same in every process, and a kernel on disk is found again."""
    env, twin = envs.make("InvertedPendulum-v5"), envs.make("InvertedPendulum-v5")
    wrapped = types.SimpleNamespace(env=types.SimpleNamespace(env=env))
    offered = teams.physics_model(wrapped)
    assert (offered.mj_model, offered.frame_skip) == (env.mj_model, 2)
    assert offered.digest == twin.physics_model().digest
    program = traced_step(env)
    assert [*scalar.simulated_models(program)] == [offered.digest]
    assert jaxprs.fingerprint(program) == jaxprs.fingerprint(traced_step(twin))


def test_another_model_or_duration_has_another_name():
    pendulum = envs.make("InvertedPendulum-v5")
    slower = envs.make("InvertedPendulum-v5", frame_skip=4)
    double = envs.make("InvertedDoublePendulum-v5")
    assert len({env.physics_model().digest for env in (pendulum, slower, double)}) == 3


class RandomAnt(Ant):
    """Its torso's mass, and what else its class says, differ from episode to episode."""

    fields = ("body_mass",)

    def randomize(self, rng):
        factor = jax.random.uniform(rng, minval=0.5, maxval=2)
        return {name: factor * getattr(self.mj_model, name) for name in self.fields}


class GearedAnt(RandomAnt):
    fields = ("body_mass", "actuator_gear")


def test_random_fields_are_part_of_a_model():
    ant, random, geared = envs.make("Ant-v5"), RandomAnt(), GearedAnt()
    assert ant.physics_model().random == ()
    assert geared.physics_model().random == GearedAnt.fields
    assert len({env.physics_model().digest for env in (ant, random, geared)}) == 3
    assert [*scalar.simulated_models(traced_step(random))] == [random.physics_model().digest]
    geared.mj_model.actuator_damping[0] = 1
    reason = "the model has random gears of actuators with armature or damping, which teams of"
    assert str(teams.why_not(geared)).startswith(reason)


def chain(num_dofs, capsules, iterations):
    """An environment of joints, the last body of which may touch the floor with capsules."""
    parts = '<geom type="capsule" fromto="0 0 0 1 0 0" size=".1" contype="0"/>' * capsules
    for _ in range(num_dofs):
        inertial = '<inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>'
        parts = f'<body><joint axis="0 1 0"/>{inertial}{parts}</body>'
    option = f'<option iterations="{iterations}"/>'
    floor = '<geom type="plane" size="1 1 1"/>'
    xml = f"<mujoco>{option}<worldbody>{floor}{parts}</worldbody></mujoco>"
    model = mujoco.MjModel.from_xml_string(xml)  # pyright: ignore[reportAttributeAccessIssue]
    return types.SimpleNamespace(physics_model=lambda: base.PhysicsModel(model, 1, "chain"))


#: What is said of models whose episodes a thread plays where there are many, and of small ones.
FEW = ", or a thread where there are many"
FEW_DOFS = "a thread plays a model of fewer than 14 degrees of freedom faster"


@pytest.mark.parametrize(
    ("num_dofs", "capsules", "iterations", "player"),
    [
        (7, 9, 4, "8 lanes an episode"),
        (7, 9, 1, "8 lanes an episode"),
        (7, 8, 4, f"16 lanes an episode{FEW}"),
        (7, 9, 100, f"16 lanes an episode{FEW}"),
        (9, 5, 4, f"16 lanes an episode{FEW}"),
        (9, 4, 4, f"a thread an episode ({FEW_DOFS})"),
        (9, 9, 1, f"a thread an episode ({FEW_DOFS})"),
        (14, 1, 100, "16 lanes an episode"),
        (16, 1, 4, "32 lanes an episode"),
    ],
)
def test_what_plays_a_model(num_dofs, capsules, iterations, player):
    """Eight lanes, where few iterations are allowed and many contacts are possible."""
    env = chain(num_dofs, capsules, iterations)
    assert teams.played_by(env) == player
    assert teams.play_few(env) == player.endswith(FEW)


def test_a_pair_of_the_convex_collider_has_all_its_contacts():
    """A cylinder may meet a box in four places."""
    xml = """
    <mujoco><worldbody><geom type="box" size="1 1 .1"/>
      <body pos="0 0 1">
        <joint type="slide" axis="0 0 1"/><geom type="cylinder" size=".1 .1"/>
      </body>
    </worldbody></mujoco>"""
    model = mujoco.MjModel.from_xml_string(xml)  # pyright: ignore[reportAttributeAccessIssue]
    assert contact_kinds.num_frictional(model) == 4


def test_contacts_without_friction_do_not_slow_a_thread():
    env = chain(9, 9, 4)
    env.physics_model().mj_model.geom_condim[:] = 1
    assert not teams.play_few(env)


def test_an_environment_need_not_offer_a_model():
    env = envs.make("CartPole-v1")
    assert teams.physics_model(env) is None
    assert teams.why_not(env) == "it simulates no model of MuJoCo's"
