"""Who sees a run go on: when its files are written, what a full disk does, and who may end it."""

import errno
from types import SimpleNamespace

import numpy as np
import pytest

from mjx_reinforce.runs import saving
from mjx_reinforce.runs.display import Display
from mjx_reinforce.runs.results import Callbacks
from mjx_reinforce.runs.saving import RunFiles
from mjx_reinforce.settings.config import Config
from mjx_reinforce.training.resume import Checkpoint


class Run:
    """A driver of a run that has made so many updates."""

    def __init__(self):
        self.config = Config(num_seeds=2, checkpoint_every=4)
        self.made, self.finished, self.ended = 0, False, False
        self.last_actors = lambda: "last"
        self.best_actors = lambda: "best"
        self.record = SimpleNamespace(
            finished=lambda: self.finished,
            played_steps=lambda: np.zeros(2, int),
            training=dict,
            history=dict,
            threshold=None,
        )

    def updates(self):
        return self.made

    def checkpoint(self):
        record = {"updates": np.full(2, self.made)}
        return Checkpoint("", None, None, record, self.made, 0, None, None)


@pytest.fixture
def watched(tmp_path, monkeypatch):
    """The files of a run that has begun, what is written, what cannot be, what it said, the run."""
    written, full, said, run = [], set(), [], Run()
    group_plan = SimpleNamespace(
        ready=SimpleNamespace(policy={"policy": "normal"}, engine="vmap", terms=())
    )
    plan = SimpleNamespace(saved_record={}, checkpoint=None, group_plans=[group_plan])
    files = RunFiles(tmp_path, plan, said.append)
    files.began(run)
    assert {path.name for path in tmp_path.iterdir()} == {"config.json", "metrics.csv"}

    def write(name):
        if name in full:
            raise OSError(errno.ENOSPC, "No space left on device")
        written.append(name)

    for owner, name, what in (
        (saving, "write_json", lambda path, _: path.name),
        (saving, "save_policy", lambda folder, actor, settings: f"{actor} policies"),
        (saving.files, "append", lambda path, _: path.name),
        (saving.resume, "save", lambda _, x, is_even: f"checkpoint of {x.seconds}"),
    ):
        monkeypatch.setattr(owner, name, lambda *x, what=what, **more: write(what(*x, **more)))
    monkeypatch.setattr(saving.curves, "picture", lambda *given: b"png")
    return files, written, full, said, run


def saved(updates):
    policies = ["last policies", "best policies"]
    return ["metrics.csv", f"checkpoint of {updates}", *policies, "summary.json"]


def go_on(files, run, updates):
    run.made = updates
    files.updated(run, {})


def test_a_checkpoint_is_written_once_there_were_enough_updates(watched):
    files, written, _, _, run = watched
    for updates in (2, 3):
        go_on(files, run, updates)
    assert written == []
    for updates in (4, 7):
        go_on(files, run, updates)
    assert written == saved(4)


def test_a_checkpoint_is_due_after_a_minute(watched, monkeypatch):
    files, written, _, _, run = watched
    run.config, now = Config(num_seeds=2, checkpoint_every=None), [files._saved_at]
    monkeypatch.setattr(saving.time, "perf_counter", lambda: now[0])
    for passed, expected in ((59.0, []), (1.0, saved(10**9)), (59.0, saved(10**9))):
        now[0] += passed
        go_on(files, run, 10**9)
        assert written == expected


def test_the_last_state_is_saved_once_and_with_its_evaluation(watched):
    files, written, _, _, run = watched
    run.finished = True
    go_on(files, run, 9)
    assert written == []
    files.ended(run)
    files.ended(run)
    assert written == saved(9)


def test_a_full_disk_is_a_warning_once_and_is_tried_again(watched):
    files, written, full, said, run = watched
    full |= {"checkpoint of 4", "checkpoint of 8", "summary.json"}
    for updates in (4, 8):
        go_on(files, run, updates)
    assert written == ["metrics.csv", "last policies", "best policies"] * 2
    assert said == [
        f"warning: cannot write {what} (No space left on device); training goes on and tries again"
        for what in ("a checkpoint", "summary.json")
    ]
    full.clear()
    go_on(files, run, 12)
    assert "checkpoint of 12" in written
    full.add("checkpoint of 16")
    go_on(files, run, 16)
    assert len(said) == 3
    files.ended(run)  # after which nobody tries again
    assert said[3] == "warning: cannot write a checkpoint (No space left on device)"


def test_rows_go_to_the_table_and_to_each_sink(watched):
    files, written, full, said, run = watched
    sunk = []
    files._sinks = [SimpleNamespace(name="tensorboard/", write=sunk.append, close=lambda: None)]
    full.add("metrics.csv")
    rows = {"seed": np.array([0])}
    files.evaluated(run, None, rows)
    assert sunk == [rows]
    assert said == [
        "warning: cannot write metrics.csv (No space left on device); training goes on and tries "
        "again"
    ]
    full.clear()
    files.evaluated(run, None, rows)
    assert written == ["metrics.csv"]


def test_the_summary_is_last_and_the_end_closes_the_sinks(watched):
    files, written, _, _, run = watched
    files._sinks = [SimpleNamespace(name="a sink", close=lambda: written.append("a sink"))]
    files.finished(run, {})
    policies = ["last policies", "best policies"]
    assert written == [*policies, "metrics.csv", "summary.json", "a sink"]


def test_a_function_that_returns_true_ends_the_run():
    run, seen = SimpleNamespace(ended=False), []
    callbacks = Callbacks([seen.append, lambda evaluation: evaluation == "solved", seen.append])
    callbacks.updated(run, {})
    callbacks.evaluated(run, "poor", {})
    assert not run.ended
    callbacks.evaluated(run, "solved", {})
    assert run.ended
    assert seen == ["poor", "poor", "solved", "solved"]


def test_the_screen_shows_progress_and_what_is_not_finite(monkeypatch):
    display, shown = Display(), []
    monkeypatch.setattr(display, "show_progress", shown.append)
    monkeypatch.setattr(display, "say", lambda text, style: shown.append(text))
    run = SimpleNamespace(
        config=Config(num_seeds=3),
        record=SimpleNamespace(progress=lambda: "half"),
        updates=lambda: 1,
    )
    display.evaluated(run, None, {})
    display.updated(run, np.zeros(3, int))
    for _ in range(2):  # the second time it is only counted
        display.updated(run, np.array([0, 1, 0]))
    assert shown[0] == "half"
    assert [text.partition(" seeds")[0] for text in shown[1:]] == ["up to update 1, 1 of 3"]
