"""Estimators, distributions and algorithms of the user's own, by module:name."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from command_lines import run_command

from mjx_reinforce import load, sweep
from mjx_reinforce.engine import objects
from mjx_reinforce.envs import make
from mjx_reinforce.settings.config import Config, check
from mjx_reinforce.setup import ready
from mjx_reinforce.setup.build import build

SOURCE = """
import dataclasses
import jax.numpy as jnp
import mjx_reinforce as m


def weights(discount):
    return m.reward_to_go(discount)


def family(space, *, initial_std, rescale):
    return m.categorical(space, initial_std=initial_std, rescale=rescale)


def algorithm(env, config, **shared):
    learner = m.reinforce(env, num_episodes=config.num_episodes, **shared)

    def learn(state, played, key):
        after, metrics = learner.learn(state, played, key)
        return after, metrics | {"extra": jnp.float32(config.learning_rate)}

    return learner._replace(learn=learn)


def forgetful(env, config, **shared):
    learner = m.reinforce(env, num_episodes=config.num_episodes, **shared)
    return learner._replace(learn=lambda state, played, key: (state, {"env_steps": jnp.int32(3)}))


def shapeless(env, config, **shared):
    learner = m.reinforce(env, num_episodes=config.num_episodes, **shared)

    def learn(state, played, key):
        after, metrics = learner.learn(state, played, key)
        return dataclasses.replace(after, progress=jnp.zeros(2)), metrics

    return learner._replace(learn=learn)


def nothing(*arguments, **more):
    return None


def broken(*arguments, **more):
    raise RuntimeError("no luck")


one = 1
"""
QUICK = {
    "env": "CartPole-v1",
    "engine": "vmap",
    "hidden_sizes": (4,),
    "num_seeds": 2,
    "horizon": 9,
    "num_episodes": 2,
    "eval_episodes": 2,
    "env_steps": None,
    "max_updates": 2,
}


@pytest.fixture(autouse=True)
def mine(tmp_path, monkeypatch):
    (tmp_path / "mine.py").write_text(SOURCE)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "mine", raising=False)


@pytest.mark.parametrize(
    ("own", "said"),
    [
        ({"estimator": "mine:nothing"}, "what mine:nothing returns must be of type Estimator"),
        ({"algorithm": "mine:nothing"}, "what mine:nothing returns must be of type Learner"),
        ({"estimator": "mine:broken"}, r"estimator 'mine:broken': RuntimeError: no luck .mine.py,"),
        ({"algorithm": "mine:forgetful"}, "must also return the metrics episodes, episode_return"),
        ({"algorithm": "mine:shapeless"}, "must return a state of the structure, shapes and"),
        ({"estimator": "mine:absent"}, "cannot import the estimator 'mine:absent'"),
        ({"policy": "mine:one"}, "'mine:one' is not a class or function, but of type int"),
        ({"algorithm": "nowhere:one"}, "cannot import the algorithm 'nowhere:one'.*this folder"),
    ],
)
def test_what_does_not_do_what_it_must_is_refused(own, said):
    with pytest.raises(ValueError, match=said):
        build(make("CartPole-v1"), Config(**(QUICK | own)))


def test_what_is_no_name_is_refused_before_anything_is_imported():
    for name in ("estimator", "policy", "algorithm"):
        said = f"the {name} 'mine:a b' is not of the form module:name"
        with pytest.raises(ValueError, match=said):
            check(Config(**{name: "mine:a b"}))


def test_programs_of_the_user_s_code_are_not_kept(monkeypatch, tmp_path):
    monkeypatch.setattr(objects, "folder", lambda: tmp_path)
    assert ready.key_of(Config()) is not None
    for name in ("estimator", "policy", "algorithm"):
        assert ready.key_of(Config(**{name: "mine:weights"})) is None


def flags(**settings):
    words = []
    for name, value in settings.items():
        values = value if isinstance(value, tuple) else (value,)
        words += [f"--{name.replace('_', '-')}", *map(str, values)]
    return words


def final_returns(directory):
    return json.loads((Path(directory) / "summary.json").read_text())["final_returns"]


@pytest.mark.slow
def test_a_run_with_them_is_that_with_ours_and_goes_on():
    ours = {"estimator": "reward-to-go", "policy": "categorical"}
    own = {"estimator": "mine:weights", "policy": "mine:family", "algorithm": "mine:algorithm"}
    for name, parts in (("ours", ours), ("own", own)):
        assert run_command(*flags(**(QUICK | parts)), "--output", name) == 0
    assert final_returns("ours") == final_returns("own")
    assert run_command("--resume", "own", "--max-updates", 4) == 2
    assert run_command("--resume", "own", "--max-updates", 4, *flags(**own)) == 0
    player = load("own", 0, policy="mine:family")
    assert player.act(np.zeros(4)) in (0, 1)


@pytest.mark.slow
def test_numbers_of_an_own_algorithm_are_swept_as_programs_of_their_own():
    base = Config(**QUICK, algorithm="mine:algorithm")
    found = sweep(base, {"learning_rate": [0.1, 0.2]}, report=False, quiet=True)
    assert np.isfinite(found.eval_return).all()
