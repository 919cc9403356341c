"""Policies of all kinds that nobody trained, and how they are exported."""

import importlib.util
import sys

import numpy as np
from saved_runs import make_run

from mjx_reinforce.export import __main__ as export

#: Far from the mean too: scaled observations are clipped, tanh units saturate.
OBSERVATIONS = np.random.default_rng(0).normal(size=(1000, 4))
OBSERVATIONS *= np.geomspace(0.1, 50, len(OBSERVATIONS))[:, None]
BOX = {"action_low": [-3.0, -1.0, 0.5], "action_high": [3.0, -0.5, 2.0]}
#: The network's kernel in the archive of a linear policy, for ``change_arrays``.
KERNEL = "params__network__params__Dense_0__kernel"

#: Settings of the policy besides its family and actions, and how many observations are counted.
CASES = {
    "mlp": ({}, 50.0),
    "linear": ({"hidden_sizes": []}, 50.0),
    "one layer, not normalized": ({"hidden_sizes": [8]}, 0.0),
    "four layers": ({"hidden_sizes": [16, 5, 1, 9]}, 50.0),
    "not rescaled": ({"rescale": False}, 50.0),
}


def make(tmp_path, family, case):
    """Writes a run with policies of a family."""
    settings, count = CASES[case]
    if family == "categorical":
        return make_run(tmp_path, "CartPole-v1", count=count, **settings)
    return make_run(tmp_path, "InvertedPendulum-v5", policy=family, count=count, **BOX, **settings)


def run_export(monkeypatch, *arguments):
    """Runs the command line."""
    monkeypatch.setattr(sys, "argv", ["export", *map(str, arguments)])
    export.main()


def import_file(path):
    """Imports an exported module by its path."""
    spec = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
