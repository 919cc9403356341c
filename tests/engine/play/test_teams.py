"""The model that an environment offers to an engine, and the programs that simulate it."""

import types

import jax

from mjx_reinforce import envs
from mjx_reinforce.engine import base, scalar
from mjx_reinforce.engine.play import teams
from mjx_reinforce.engine.scalar import jaxprs, scalarized


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


def test_an_environment_need_not_offer_a_model():
    env = envs.make("CartPole-v1")
    assert teams.physics_model(env) is None
    assert teams.why_not(env) == "it simulates no model of MuJoCo's"
