"""A directory that is moved or removed while a run or a sweep goes on ends it in one line."""

import json
import shutil
from pathlib import Path

import pytest

from mjx_reinforce import train
from mjx_reinforce.report import WrittenReport
from mjx_reinforce.runs import command_line, perform, plan, saving
from mjx_reinforce.runs.saving import Files, RunFiles
from mjx_reinforce.runs.sweep_saving import SweepFiles
from mjx_reinforce.training import driver

RUN = ["--env", "ContinuousCartPole-v0", "--env-steps", "None", "--num-seeds", "3"]
RUN += ["--eval-episodes", "2", "--hidden-sizes", "4", "--num-episodes", "4", "--eval-every", "1"]
RUN += ["--decay-steps", "9000", "--max-updates", "12", "--output", "out"]
SWEEP = [*RUN, "--over", "learning-rate", "1e-2", "3e-2", "--chunk-runs", "3"]
COMMANDS = {"train": (train.main, RUN), "sweep": (command_line.sweep, SWEEP)}


def move():
    Path("out").rename("away")


def remove():
    shutil.rmtree("out")


def replace():
    """As another run would, which began there meanwhile."""
    Path("out").rename("away")
    Path("out").mkdir()
    Path("out/config.json").write_text("{}")


LOSSES = {"moved": move, "removed": remove, "replaced": replace}


def lose(monkeypatch, owner, name, when, how):
    """Loses the directory before the ``when``-th call of a method."""
    method, calls = getattr(owner, name), []

    def losing(*arguments, **options):
        calls.append(None)
        if len(calls) == when:
            how()
        return method(*arguments, **options)

    monkeypatch.setattr(owner, name, losing)
    monkeypatch.setattr(driver, "_CALL_SECONDS", 0.0)  # the host looks at every block


def check_lost(status, loss, capsys):
    """One line, status 1, and nothing in the place where the directory was."""
    said = capsys.readouterr().err.strip()
    assert status == 1
    assert said.startswith("error: out was moved or removed before all of its files were written")
    assert "\n" not in said
    left = [path.name for path in Path("out").rglob("*")] if Path("out").exists() else None
    assert left == (["config.json"] if loss == "replaced" else None)


@pytest.mark.slow
@pytest.mark.parametrize("loss", LOSSES)
@pytest.mark.parametrize("command", COMMANDS)
def test_it_ends_while_it_trains(run, monkeypatch, capsys, command, loss):
    main, arguments = COMMANDS[command]
    lose(monkeypatch, Files, "updated", 3, LOSSES[loss])
    check_lost(run(*arguments, command=main), loss, capsys)


@pytest.mark.slow
@pytest.mark.parametrize("command", COMMANDS)
def test_it_ends_before_it_trains(run, monkeypatch, capsys, command):
    """Where another run began in its place while this one wrote its simulation out."""
    main, arguments = COMMANDS[command]
    lose(monkeypatch, plan, "make_plan", 1, replace)
    check_lost(run(*arguments, command=main), "replaced", capsys)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("command", "owner", "name"),
    [
        ("train", Files, "open"),
        ("train", saving.files, "append"),
        ("train", RunFiles, "_save_policies"),
        ("train", RunFiles, "finished"),
        ("sweep", SweepFiles, "open"),
        ("sweep", SweepFiles, "_write_part"),
        ("sweep", SweepFiles, "finished"),
    ],
)
def test_it_ends_while_it_writes(run, monkeypatch, capsys, command, owner, name):
    """Also where the directory is lost just before a file of it is written."""
    main, arguments = COMMANDS[command]
    lose(monkeypatch, owner, name, 1, move)
    check_lost(run(*arguments, command=main), "moved", capsys)


@pytest.mark.slow
def test_what_was_moved_goes_on_where_it_is(run, monkeypatch, capsys):
    """With all of its rows, as a run that nobody moved."""
    with monkeypatch.context() as patch:
        lose(patch, Files, "updated", 5, move)
        assert run(*RUN, "--checkpoint-every", 2) == 1
    assert run("--resume", "away") == 0
    assert run(*RUN) == 0
    assert Path("away/metrics.csv").read_text().count("\n") == 1 + 3 * 13
    returns = [json.loads(Path(x, "summary.json").read_text()) for x in ("away", "out")]
    assert returns[0]["final_returns"] == returns[1]["final_returns"]


@pytest.mark.slow
def test_a_report_that_is_being_written(run, monkeypatch, capsys):
    def report(directory):
        move()
        (directory / "report.html").write_text("page")
        return WrittenReport(0.0, [], 0)

    monkeypatch.setattr(perform, "_report", report)
    check_lost(run(*SWEEP, command=command_line.sweep), "moved", capsys)
