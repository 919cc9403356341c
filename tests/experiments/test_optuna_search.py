"""The search by Optuna asks, prunes and tells; Optuna itself is replaced."""

import importlib
import sys
import types

import numpy as np
import pytest

from mjx_reinforce.settings.config import Config

MODULE = "experiments.examples.optuna_search"


class Trial:
    """Suggests the lower ends; is hopeless from its second moment on, if it is the second."""

    def __init__(self, number):
        self.number, self.params, self.reported = number, {}, {}

    def suggest_float(self, name, low, high, *, log):
        self.params[name] = low
        return low

    def report(self, value, moment):
        self.reported[moment] = value

    def should_prune(self):
        return self.number == 1 and len(self.reported) == 2


class Study:
    """Remembers what it is told."""

    def __init__(self):
        self.trials, self.told = [], []

    def ask(self):
        self.trials.append(Trial(len(self.trials)))
        return self.trials[-1]

    def tell(self, trial, value, state):
        self.told.append((trial.number, value, state))


@pytest.fixture
def module(monkeypatch):
    fake = types.SimpleNamespace(
        Trial=Trial,
        Study=Study,
        samplers=types.SimpleNamespace(TPESampler=lambda seed: None),
        pruners=types.SimpleNamespace(MedianPruner=lambda n_warmup_steps: None),
        create_study=lambda direction, sampler, pruner: Study(),
        trial=types.SimpleNamespace(TrialState=types.SimpleNamespace(PRUNED="pruned")),
    )
    monkeypatch.setitem(sys.modules, "optuna", fake)
    monkeypatch.delitem(sys.modules, MODULE, raising=False)
    yield importlib.import_module(MODULE)
    sys.modules.pop(MODULE, None)


def test_a_hopeless_trial_is_ended_and_told_as_such(module, monkeypatch):
    """Evaluations of one moment, and after the end of the budget, are not reported twice."""
    trained = []

    def run(config, *, observers, quiet):
        trained.append(config)
        for steps in (10, 12, 50, 90, 100, 100):
            env_steps = np.full(2, steps)
            measured = {"eval_return": np.array([steps, steps + 2.0])}
            one = types.SimpleNamespace(env_steps=env_steps, measured=measured)
            if any(observer(one) for observer in observers):
                break
        return types.SimpleNamespace(env_steps=env_steps[None], test_returns=np.array([3.0, 5.0]))

    monkeypatch.setattr(module, "run", run)
    study = module.search(Config(env_steps=100), 3)
    assert study.told == [(0, 4.0, None), (1, None, "pruned"), (2, 4.0, None)]
    assert study.trials[0].reported == {2: 11.0, 10: 51.0, 18: 91.0}
    assert study.trials[1].reported == {2: 11.0, 10: 51.0}
    assert (trained[0].learning_rate, trained[0].discount) == (1e-3, 0.999)


def test_without_optuna_the_remedy_is_said(monkeypatch):
    monkeypatch.setitem(sys.modules, "optuna", None)
    monkeypatch.delitem(sys.modules, MODULE, raising=False)
    with pytest.raises(SystemExit, match="pip install optuna"):
        importlib.import_module(MODULE)
