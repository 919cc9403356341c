"""Trains on several devices of one process, and compares what comes out with one device's.

``python divided.py '[["run", {"num_episodes": 8}, [{"episodes": 8}]]]'`` takes what is compared, a
whole ``run``, a ``step`` of its learner, or a ``step in groups`` of samples as on a GPU, then the
settings, and the ways of dividing them. Prints a line for each way; raises where something differs.
"""

import json
import sys
from unittest import mock

import jax
import numpy as np
from one_slot import compile_run

from mjx_reinforce import envs
from mjx_reinforce.engine.base import plain
from mjx_reinforce.engine.episode import largest_divisor
from mjx_reinforce.learning import samples
from mjx_reinforce.settings.config import Config
from mjx_reinforce.setup import build, ready
from mjx_reinforce.training.division import ALONE, Division

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
    prepared = ready.build_ready(envs.make(config.env), config, division=division)
    slots = compile_run(prepared.programs(), config)
    before, [(_, metrics, eval_metrics)], state = slots.states(), slots.advance(), slots.states()
    assert all(len(x) == config.num_seeds for x in jax.tree.leaves(plain(state)))
    tested = slots.test(state.train_states.actor)
    for measured in (metrics, eval_metrics, tested):
        del measured["simulated_steps"]
    again = slots.evaluate().eval_metrics["eval_return"]
    return jax.device_get(plain((before, state))), metrics, eval_metrics, tested, again


def stepped(config, division):
    """Returns the episodes of an update of all seeds, and what each has learned from its own."""
    devices = division.devices() if division.episodes > 1 else None
    learner = build.build(envs.make(config.env), config, devices=devices).learner

    @jax.jit
    @jax.vmap
    def step(key):
        state = learner.init(key)
        played, (after, metrics) = learner.play(state, key, True), learner.step(state)
        del metrics["simulated_steps"]
        episodes = [played.observation, played.action, played.reward, played.mask]
        return episodes, plain(after), metrics

    return learner, jax.device_get(step(jax.random.split(jax.random.key(1), config.num_seeds)))


def compare(kind, settings, divisions):
    """Compares what each way of dividing comes to with what one device does, computed once."""
    settings = SMALL | {"env": "CartPole-v1"} | settings
    config = Config(**{k: tuple(x) if isinstance(x, list) else x for k, x in settings.items()})
    if kind == "run":
        alone = trained(config, ALONE)
        for division in divisions:
            close(alone, trained(config, Division(**division)))
            print("equal", kind, settings, division)
        return
    learner, (episodes, *learned) = stepped(config, ALONE)
    alike = np.testing.assert_array_equal if learner.engine.name == "native" else close
    for division in divisions:
        again, *other = stepped(config, Division(**division))[1]
        close(learned, other)
        jax.tree.map(alike, episodes, again)
        print("equal", kind, settings, division)


def main():
    for kind, *variant in json.loads(sys.argv[1]):
        most = 4 if kind == "step in groups" else 1
        with mock.patch.object(
            samples, "_num_groups", lambda shape, most=most: largest_divisor(shape[0], most)
        ):
            compare(kind, *variant)


if __name__ == "__main__":
    main()
