"""Who sees a run go on: when its files are written, what a full disk does, and who may end it."""

import errno
from types import SimpleNamespace

import numpy as np
import pytest

from mjx_reinforce.runs.observers import Callbacks, RunFiles, Screen
from mjx_reinforce.settings.config import Config


class Log:
    """Notes what is written; what is in ``full`` cannot be."""

    def __init__(self, directory):
        self.directory, self.written, self.full = directory, [], set()

    def __getattr__(self, name):
        def write(*arguments, **keywords):
            if name in self.full:
                raise OSError(errno.ENOSPC, "No space left on device")
            self.written.append(name)

        return write

    def metrics_bytes(self):
        return 7

    def save_checkpoint(self, content, *, even):
        if "save_checkpoint" in self.full:
            raise OSError(errno.ENOSPC, "No space left on device")
        self.written.append(f"checkpoint of {content.record['updates'][0]}")


class Run:
    """A driver of a run that has made so many updates."""

    def __init__(self, folder, **settings):
        self.config = Config(num_seeds=2, output=folder, checkpoint_every=4, **settings)
        self.made, self.finished, self.ended = 0, False, False
        self.state = SimpleNamespace(train_states=SimpleNamespace(actor="last"))
        self.best = SimpleNamespace(actor="best")
        self.record = SimpleNamespace(
            finished=lambda: self.finished,
            env_steps=np.array([self.made, self.made]),
            arrays=lambda: {"updates": np.array([self.made, self.made])},
        )

    def updates(self):
        return self.made

    def seconds(self):
        return 1.0


@pytest.fixture
def watched(tmp_path):
    """The files of a run that has begun, its log, what it said, and the run."""
    said, log, run = [], Log(tmp_path), Run(tmp_path)
    files = RunFiles(log, {"policy": "normal"}, said.append)
    files.begin(run, None)
    assert log.written == ["begin"]
    log.written.clear()
    return files, log, said, run


def go_on(files, run, updates):
    run.made = updates
    files.updated(run, {})


def test_a_checkpoint_is_written_once_there_were_enough_updates(watched):
    files, log, _, run = watched
    for updates in (2, 3):
        go_on(files, run, updates)
    assert log.written == []
    go_on(files, run, 4)
    assert log.written == ["checkpoint of 4", "save_policies", "say_running"]
    go_on(files, run, 7)
    assert len(log.written) == 3


def test_the_last_state_is_saved_once_and_with_its_evaluation(watched):
    files, log, _, run = watched
    run.finished = True
    go_on(files, run, 9)
    assert log.written == []
    files.end(run)
    files.end(run)
    assert log.written == ["checkpoint of 9", "save_policies", "say_running"]


def test_a_full_disk_is_a_warning_once_and_is_tried_again(watched):
    files, log, said, run = watched
    log.full = {"save_checkpoint", "say_running"}
    for updates in (4, 8):
        go_on(files, run, updates)
    assert log.written == ["save_policies"] * 2
    assert said == [
        f"warning: cannot write {what} (No space left on device); training goes on and tries again"
        for what in ("a checkpoint", "summary.json")
    ]
    log.full = set()
    files.end(run)
    assert "checkpoint of 8" in log.written


def test_rows_go_to_the_table_and_to_each_sink(watched):
    files, log, said, run = watched
    sunk = []
    files._sinks = [SimpleNamespace(name="tensorboard/", write=sunk.append, close=lambda: None)]
    log.full = {"add_rows"}
    files.evaluated(run, None, {"seed": ["0"]})
    assert sunk == [{"seed": ["0"]}]
    assert said == [
        "warning: cannot write metrics.csv (No space left on device); training goes on and tries "
        "again"
    ]


def test_the_end_closes_the_sinks(watched):
    files, log, _, run = watched
    closed = []
    files._sinks = [SimpleNamespace(name="tensorboard/", close=lambda: closed.append(True))]
    run.record.training = dict
    files.finish(run, b"png", {})
    assert log.written == ["save_policies", "finish"]
    assert closed == [True]


def test_a_function_that_returns_true_ends_the_run():
    run, seen = SimpleNamespace(ended=False), []
    callbacks = Callbacks([seen.append, lambda evaluation: evaluation == "solved", seen.append])
    callbacks.updated(run, {})
    callbacks.evaluated(run, "poor", {})
    assert not run.ended
    callbacks.evaluated(run, "solved", {})
    assert run.ended
    assert seen == ["poor", "poor", "solved", "solved"]


def test_the_screen_shows_progress_and_what_is_not_finite():
    shown = []
    display = SimpleNamespace(
        show_progress=shown.append,
        show_nonfinite=lambda met, num_seeds: shown.append((met, num_seeds)),
    )
    screen = Screen(display)
    run = SimpleNamespace(
        config=Config(num_seeds=3), record=SimpleNamespace(progress=lambda: "half")
    )
    screen.evaluated(run, None, {})
    screen.updated(run, {"seed": []})
    assert shown == ["half", ({"seed": []}, 3)]
