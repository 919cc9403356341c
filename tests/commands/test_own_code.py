"""Code that only the files of a run name is not run: the command line names it too, or it stays."""

import json
import sys

import numpy as np
import pytest
from fake_sweeps import make_sweep
from saved_runs import change, change_arrays, make_run, write

from mjx_reinforce import load, report, watch
from mjx_reinforce import train as train_module
from mjx_reinforce.export import __main__ as export
from mjx_reinforce.runs import command_line
from mjx_reinforce.runs.design import Design, as_record
from mjx_reinforce.settings.config import Config
from mjx_reinforce.training.resume import recordable

ENV = "evil_module:Task"
MAINS = {
    "train": train_module.main,
    "sweep": command_line.sweep,
    "watch": watch.main,
    "report": report.main,
    "export": export.main,
}


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A run and a sweep that name a module, which leaves a file if it is imported."""
    (tmp_path / "evil_module.py").write_text("open('ran', 'w').close()\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.chdir(tmp_path)
    monkeypatch.delitem(sys.modules, "evil_module", raising=False)
    make_run(tmp_path / "run")
    write(tmp_path / "run" / "config.json", recordable(Config(env=ENV, horizon=60)))
    change(tmp_path / "run" / "summary.json", status="interrupted")
    change(tmp_path / "run" / "policy" / "policy.json", env=ENV)
    change_arrays(tmp_path / "run")
    rates = {"learning_rate": [1e-3, 3e-3]}
    make_sweep(tmp_path / "rates", num_seeds=2, over=rates, env=ENV)
    record = json.loads(json.dumps(as_record(Design(base=Config(env=ENV), over=rates))))
    change(tmp_path / "rates" / "sweep.json", **record, status="interrupted")
    return tmp_path


@pytest.fixture
def said(monkeypatch, capsys):
    """Runs a command line and returns what it said on standard error, and its exit status."""

    def run(command):
        monkeypatch.setattr(sys, "argv", command.split())
        monkeypatch.setattr(watch, "check_drawing", lambda: None)
        status = 0
        try:
            MAINS[command.split()[0]]()
        except SystemExit as stop:
            status = stop.code
        return capsys.readouterr().err, status

    return run


GOING_ON = ("train --resume run --max-updates 9", "sweep --resume rates", "watch run")


@pytest.mark.parametrize("command", GOING_ON)
def test_code_that_only_a_file_names_is_not_run(folder, said, command):
    error, status = said(command)
    assert status == 2
    assert not (folder / "ran").exists()
    assert error.endswith(f"if you trust it, add --env {ENV} to the command\n")
    assert error.count("\n") == 1


@pytest.mark.parametrize("command", GOING_ON)
def test_code_that_is_named_again_is_run(folder, said, command):
    error, _ = said(f"{command} --env {ENV}")
    assert (folder / "ran").exists()
    assert f"cannot import the environment '{ENV}'" in error


def test_another_environment_than_the_runs_is_refused(folder, said):
    for env, command in (("os:abort", "train --resume run"), ("CartPole-v1", "watch run")):
        error, status = said(f"{command} --env {env}")
        assert status == 2
        assert ENV in error
    assert not (folder / "ran").exists()


@pytest.mark.parametrize(
    ("command", "name"),
    [(GOING_ON[0], "algorithm"), (GOING_ON[0], "policy"), (GOING_ON[1], "estimator")],
)
def test_other_code_that_only_a_file_names_is_not_run(folder, said, command, name):
    own = {"env": "CartPole-v1", name: "evil_module:make"}
    write(folder / "run" / "config.json", recordable(Config(horizon=60, **own)))
    rates = {"learning_rate": [1e-3, 3e-3]}
    record = json.loads(json.dumps(as_record(Design(base=Config(**own), over=rates))))
    change(folder / "rates" / "sweep.json", **record)
    error, status = said(command)
    assert status == 2
    assert not (folder / "ran").exists()
    assert error.endswith(f"if you trust it, add --{name} evil_module:make to the command\n")


def test_a_distribution_that_only_a_file_names_is_not_run(folder, said):
    change(folder / "run" / "config.json", env="CartPole-v1")
    change(folder / "run" / "policy" / "policy.json", env="CartPole-v1", policy="evil_module:make")
    change_arrays(folder / "run")
    error, status = said("watch run --seed 0")
    assert status == 2
    assert "add --policy evil_module:make to watch" in error
    with pytest.raises(ValueError, match="names the distribution evil_module:make"):
        load("run", 0)
    assert not (folder / "ran").exists()
    error, _ = said("watch run --seed 0 --policy evil_module:make")
    assert (folder / "ran").exists()
    assert "cannot import the policy 'evil_module:make'" in error


def test_what_is_no_name_is_not_proposed(folder, said):
    change(folder / "run" / "config.json", env="x:y; touch ran; echo ")
    for command in ("train --resume run", "watch run"):
        assert "is not of the form module:Class" in said(command)[0]


@pytest.mark.parametrize(
    "command", [pytest.param("report rates", marks=pytest.mark.slow), "export run"]
)
def test_reports_and_exports_run_no_code(folder, said, command):
    assert said(command)[1] == 0
    assert not (folder / "ran").exists()


def test_to_load_a_policy_runs_no_code(folder):
    assert load(folder / "run").act(np.zeros(4, np.float32)) in (0, 1)
    assert not (folder / "ran").exists()
