"""Run directories with policies that nobody trained, made without compiling anything."""

import json

import jax
import numpy as np

from experiments.kit.trainings import results
from mjx_reinforce.export.policy_files import _checksum, build_policy, save_policy
from mjx_reinforce.learning.normalize import Normalizer
from mjx_reinforce.learning.policy import Actor

SPACES = {
    "InvertedPendulum-v5": {
        "policy": "normal",
        "observation_size": 4,
        "action_low": [-3.0],
        "action_high": [3.0],
    },
    "CartPole-v1": {"policy": "categorical", "observation_size": 4, "num_actions": 2},
}


def make_run(directory, env="CartPole-v1", *, count=50.0, folder="policy", **settings):
    """Writes what three seeds of training leave, as far as using a policy needs it.

    count: how many observations the normalizer has counted
    folder: where the policies go
    settings: of the policy, over those of ``SPACES``
    """
    settings = {"env": env, "hidden_sizes": [8, 8], "initial_std": 0.5} | SPACES[env] | settings
    rng = np.random.default_rng(3)

    def draw(array):
        """A kernel is [I, J]: its units stay of the order of 1, as those of trained ones do."""
        scale = 0.2 * array.shape[0] ** -0.5 if array.ndim == 2 else 1.0
        return (scale * rng.standard_normal((3, *array.shape))).astype(np.float32)

    params = jax.tree.map(draw, jax.eval_shape(build_policy(settings).init, jax.random.key(0)))
    size = np.zeros(settings["observation_size"])
    counts = np.full(3, count, np.float32)
    m2 = count * np.exp(draw(size))
    normalizer = Normalizer(count=counts, mean=draw(size) * (count > 0), m2=m2)
    save_policy(directory / folder, Actor(params=params, normalizer=normalizer), settings)
    write(directory / "config.json", {"env": env, "horizon": 60})
    write(directory / "summary.json", {"status": "finished", "final_returns": [2.0, 7.0, 5.0]})
    return directory


def write(path, value):
    path.write_text(json.dumps(value))


def change(path, **entries):
    """Changes entries of a JSON file, or takes those out that are ...."""
    value = json.loads(path.read_text()) | entries
    write(path, {name: x for name, x in value.items() if x is not ...})


def change_env(run, env):
    """Changes the environment that the files of a run name."""
    for path in (run / "config.json", run / "policy" / "policy.json"):
        change(path, env=env)
    change_arrays(run)


def change_arrays(run, *, sign=True, **changes):
    """Changes arrays of a run's policies by functions; in names, __ is /.

    sign: with the checksum of what the files are now
    """
    path = run / "policy" / "actor.npz"
    with np.load(path) as archive:
        arrays = dict(archive)
    for name, change in changes.items():
        name = name.replace("__", "/")
        arrays[name] = change(arrays[name])
    if sign:
        del arrays["checksum"]
        settings = json.loads((run / "policy" / "policy.json").read_text())
        arrays["checksum"] = np.array(_checksum(settings, arrays))
    np.savez(path, **arrays)


def assert_same(one, other):
    """Two runs left the same numbers and policies, byte by byte."""
    one, other = results(one), results(other)
    for name in one:
        assert one[name] == other[name], name
