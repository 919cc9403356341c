"""Environment variables of ours: a value that means nothing is an error, whatever would play."""

import pytest
from players import actor_and_act
from toys import Drifting

import mjx_reinforce as mr
from mjx_reinforce.engine import objects
from mjx_reinforce.engine.cpu import machine
from mjx_reinforce.engine.play import available, choice, cxx

if reason := available.unavailable():
    pytest.skip(reason, allow_module_level=True)


def _choose(engine):
    env = Drifting()
    actor, act, distribution = actor_and_act(env, (2,))
    return choice.choose(engine, env, choice.ActingPolicy(act, actor, distribution), 5)


@pytest.mark.parametrize(
    ("variable", "value", "message"),
    [
        (machine.VARIABLE, "bogus", "unknown MJX_REINFORCE_CPU 'bogus'.*Known: .*x86-64-v3"),
        (machine.VARIABLE, "X86-64", "Did you mean 'x86-64'"),
        (objects.DEBUG, "yes", "unknown MJX_REINFORCE_DEBUG 'yes'.*Known: 0, 1"),
    ],
)
@pytest.mark.parametrize("engine", choice.ENGINES)
def test_an_unknown_value(variable, value, message, engine, monkeypatch):
    monkeypatch.setenv(variable, value)
    with pytest.raises(ValueError, match=message):
        _choose(engine)
    if engine != "mujoco":  # this task has nothing that it could play
        with pytest.raises(ValueError, match=message):
            mr.make_vec(Drifting(), 2, autoreset="disabled", engine=engine)


def test_a_level_that_this_cpu_is_not(monkeypatch):
    """No other engine plays instead."""
    monkeypatch.setattr("llvmlite.binding.get_host_cpu_features", dict)
    monkeypatch.setenv(machine.VARIABLE, "x86-64-v4")
    with pytest.raises(ValueError, match="'x86-64-v4', which this CPU is not"):
        _choose("auto")


@pytest.mark.skipif(cxx.compiler() is None, reason="there is no C++ compiler")
def test_the_compiler_is_not_taken_for_none(monkeypatch):
    """It refuses the option that the value becomes; C MuJoCo would play in silence."""
    monkeypatch.setenv(machine.VARIABLE, "bogus")
    with pytest.raises(ValueError, match="unknown MJX_REINFORCE_CPU 'bogus'"):
        cxx.compiler.__wrapped__()
    monkeypatch.setenv(machine.VARIABLE, machine.HOST)
    assert cxx.compiler.__wrapped__() == cxx.compiler()


def test_what_is_not_set_is_no_fault(monkeypatch):
    monkeypatch.setenv(machine.VARIABLE, "")
    monkeypatch.setenv(objects.DEBUG, "")
    assert _choose("auto").name == "native"
