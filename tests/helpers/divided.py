"""Trains runs on several devices of one process, and compares them with one device's.

``python divided.py '{"num_episodes": 8}' '{"episodes": 8}' ...`` takes the settings, and then how
a run is divided, as often as is to be tried. Prints nothing; raises where something differs.
"""

import dataclasses
import json
import sys

import jax
import numpy as np

from mjx_reinforce import envs
from mjx_reinforce.engine.base import plain
from mjx_reinforce.settings.config import Config
from mjx_reinforce.store import build, ready
from mjx_reinforce.training.division import ALONE, Division
from mjx_reinforce.training.programs import compile_run
from mjx_reinforce.training.state import budget_of

SMALL = {"num_seeds": 3, "num_episodes": 8, "hidden_sizes": (4,), "eval_episodes": 2}
SMALL |= {"env_steps": None, "max_updates": 2, "test_episodes": 4}


def close(one, other):
    """Equal up to rounding, and what no rounding changes to the bit."""
    one, other = plain(one), plain(other)
    assert jax.tree.structure(one) == jax.tree.structure(other)
    named, others = jax.tree.leaves_with_path(one), jax.tree.leaves(other)
    for (path, x), y in zip(named, others, strict=True):
        assert (x.shape, x.dtype) == (y.shape, y.dtype), jax.tree_util.keystr(path)
        if np.issubdtype(x.dtype, np.floating):
            np.testing.assert_allclose(x, y, rtol=1e-3, atol=1e-4)
        else:
            np.testing.assert_array_equal(x, y)


def trained(config, division):
    """Returns all that a run comes to, on the host; how much was simulated is each device's own."""
    prepared = ready.made(envs.make(config.env), config, division=division)
    first, programs = compile_run(prepared.programs, config)
    before = jax.device_get(plain(first))
    state, metrics, looked = programs.advance(first, True, budget_of(config))
    assert all(len(x) == config.num_seeds for x in jax.tree.leaves(plain(state)))
    found = jax.device_get(plain(state)), metrics, programs.test(state.train_states.actor)
    for measured in (metrics, looked.measured, found[2]):
        del measured["simulated_steps"]
    return before, looked, *found, programs.evaluate(state).measured["eval_return"]


def played(config, division):
    """Returns the episodes of an update of all seeds."""
    devices = division.devices() if division.episodes > 1 else None
    learner = build.build(envs.make(config.env), config, devices=devices)[0]
    keys = jax.random.split(jax.random.key(1), config.num_seeds)

    def play(key):
        return learner.play(learner.init(key), key, True)

    return learner, jax.device_get(jax.jit(jax.vmap(play))(keys))


def main():
    settings = SMALL | {"env": "CartPole-v1"} | json.loads(sys.argv[1])
    config = Config(**{k: tuple(x) if isinstance(x, list) else x for k, x in settings.items()})
    divisions = [Division(**json.loads(each)) for each in sys.argv[2:]]
    expected, (learner, episodes) = trained(config, ALONE), played(config, ALONE)
    for division in divisions:
        close(expected, trained(config, division))
        if division.episodes > 1:
            again = played(config, division)[1]
            alike = np.testing.assert_array_equal if learner.engine.name == "native" else close
            for field in dataclasses.fields(again):
                if field.name not in ("simulated", "played"):
                    alike(getattr(episodes, field.name), getattr(again, field.name))


if __name__ == "__main__":
    main()
