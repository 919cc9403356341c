"""Ctrl-C, SIGTERM and SIGKILL, sent to real processes while they import, compile, train, write."""

import csv
import json
import os
import signal
import subprocess
import sys
import time
import tomllib

import numpy as np
import pytest
from places import ROOT
from saved_runs import assert_same

from mjx_reinforce import load_policy

#: One of our tasks, whose programs are kept on disk after the first start.
TASK = ["--env", "ContinuousCartPole-v0"]
FOREVER = [*TASK, "--env-steps", "1000000000", "--eval-every", "500", "--output", "out"]
#: It takes seconds to compile.
HEAVY = ["--env", "InvertedPendulum-v5", "--engine", "vmap", "--output", "out"]
#: What it does before it ends takes longer than the screen is waited for.
SLOW_EXIT = """
import pathlib, time
from mjx_reinforce.console.interrupt import Interrupt
with Interrupt() as interrupt:
    interrupt.on_exit(lambda: (time.sleep(2), pathlib.Path("cleaned").touch()))
    interrupt.restore_screen(lambda: time.sleep(60))
    print("listening", flush=True)
    time.sleep(60)
"""

QUICK_EXIT = """
import time
from mjx_reinforce.console.interrupt import Interrupt
with Interrupt():
    print("listening", flush=True)
    time.sleep(60)
"""
#: The runs of a test.
STARTED: list[subprocess.Popen[str]] = []
UNBEGUN = "stopped before training began; nothing was written\n"


@pytest.fixture(autouse=True)
def ctrl_c_is_heard():
    """What a script's shell starts in the background ignores Ctrl-C, and so would its child."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture(autouse=True)
def no_run_goes_on():
    """A test that fails leaves no run behind, which would train for days beside other tests."""
    yield
    while STARTED:
        STARTED.pop().kill()


def start(directory, *arguments, cache=None):
    environment = os.environ | {"PYTHONWARNINGS": "ignore:JAX 0.10.2 computes some products"}
    # GLFW, which MuJoCo imports to draw, starts a Python of its own for a moment. Where a signal
    # meets that one, it shows a traceback of glfw/library.py (glfw 2.11).
    environment |= {"MUJOCO_GL": "disable"}
    environment |= {"JAX_COMPILATION_CACHE_DIR": str(cache)} if cache else {}
    process = subprocess.Popen(
        [sys.executable, "-m", "mjx_reinforce.train", *map(str, arguments)],
        cwd=directory,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    STARTED.append(process)
    return process


def wait_for(condition, process, seconds=200):
    deadline = time.monotonic() + seconds
    while not condition():
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.02)


def rows(directory):
    path = directory / "out" / "metrics.csv"
    return path.read_text().count("\n") if path.exists() else 0


def finish(process, seconds=60):
    """The status; the process must have said nothing of a traceback."""
    output, errors = process.communicate(timeout=seconds)
    assert "Traceback" not in output + errors
    assert "Segmentation" not in errors
    return process.returncode


@pytest.mark.slow
def test_signals_and_kills_cost_no_byte(tmp_path):
    """Ctrl-C ends the run after the block; SIGKILL ends it as it trains and writes."""
    budget = [*TASK, "--env-steps", "None", "--max-updates", 400]
    process = start(tmp_path, *budget, "--output", "out")
    wait_for(lambda: rows(tmp_path) > 20, process)
    process.send_signal(signal.SIGINT)
    assert finish(process) == 130
    with (tmp_path / "out" / "metrics.csv").open(newline="") as file:
        last = list(csv.DictReader(file))[-4:]
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["status"] == "interrupted"
    assert summary["final_returns"] == [float(row["eval_return"]) for row in last]
    assert len(list((tmp_path / "out" / "checkpoint").iterdir())) == 1
    for folder in ("policy", "policy/best"):
        _, actor = load_policy(tmp_path / "out" / folder)
        assert np.all(np.isfinite(actor.normalizer.mean))
    before, rng = rows(tmp_path), np.random.default_rng(0)
    process = start(tmp_path, "--resume", "out", "--checkpoint-every", 5)
    wait_for(lambda: rows(tmp_path) > before + 40, process)
    time.sleep(rng.uniform(0, 0.3))
    process.kill()
    process.communicate()
    assert finish(start(tmp_path, "--resume", "out", "--checkpoint-every", 500)) == 0
    assert finish(start(tmp_path, *budget, "--output", "whole")) == 0
    assert_same(tmp_path / "whole", tmp_path / "out")


@pytest.mark.slow
def test_an_ssh_that_ends_is_answered_as_sigterm(tmp_path):
    """With a summary and a last checkpoint, from which the run goes on."""
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)  # also where tests run under nohup
    try:
        process = start(tmp_path, *FOREVER)
    finally:
        signal.signal(signal.SIGHUP, before)
    wait_for(lambda: rows(tmp_path) > 3, process)
    for _ in range(2):
        process.send_signal(signal.SIGHUP)
        time.sleep(0.05)
    assert finish(process) == 128 + signal.SIGHUP
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["status"] == "interrupted"
    assert len(list((tmp_path / "out" / "checkpoint").iterdir())) == 1


@pytest.mark.slow
def test_nohup_keeps_a_run_going(tmp_path):
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)  # which its child has too
    try:
        process = start(tmp_path, *FOREVER)
    finally:
        signal.signal(signal.SIGHUP, before)
    wait_for(lambda: rows(tmp_path) > 3, process)
    process.send_signal(signal.SIGHUP)
    reached = rows(tmp_path)
    wait_for(lambda: rows(tmp_path) > reached + 3, process)
    process.send_signal(signal.SIGTERM)
    assert finish(process) == 128 + signal.SIGTERM


@pytest.mark.slow
def test_a_signal_while_compiling_leaves_nothing(tmp_path):
    process = start(tmp_path, *HEAVY, cache=tmp_path / "cache")
    assert any("Training 4 seeds" in line for line in process.stdout)
    time.sleep(0.3)
    process.send_signal(signal.SIGTERM)
    begun = time.monotonic()
    output, errors = process.communicate(timeout=60)
    assert process.returncode == 143
    assert "Traceback" not in output
    assert errors == UNBEGUN
    assert time.monotonic() - begun < 5
    assert not (tmp_path / "out").exists()


def test_a_signal_before_training_is_answered(tmp_path):
    command = [sys.executable, "-c", QUICK_EXIT]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    process = subprocess.Popen(command, cwd=tmp_path, **pipes, text=True)
    assert process.stdout.readline() == "listening\n"
    process.send_signal(signal.SIGINT)
    assert process.communicate(timeout=30) == ("", UNBEGUN)
    assert process.returncode == 130


@pytest.mark.slow
def test_files_are_cleaned_up_however_long_it_takes_but_the_screen_is_not_waited_for(tmp_path):
    command = [sys.executable, "-c", SLOW_EXIT]
    process = subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, text=True)
    assert process.stdout.readline() == "listening\n"
    process.send_signal(signal.SIGTERM)
    assert process.wait(timeout=30) == 143
    assert (tmp_path / "cleaned").exists()


def test_a_signal_while_importing_shows_no_traceback(tmp_path):
    """Not before Python itself has started, whose own message that would be."""
    process = start(tmp_path, *HEAVY, cache=tmp_path / "cache")
    time.sleep(1)
    process.send_signal(signal.SIGINT)
    assert finish(process) in (130, -signal.SIGINT)
    assert not (tmp_path / "out").exists()


IMPORTING = """
import os, signal, sys

class Interrupting:
    def find_spec(self, name, path=None, target=None):
        if name == "mjx_reinforce.train":
            os.kill(os.getpid(), signal.SIGINT)

sys.meta_path.insert(0, Interrupting())
sys.argv.append("train")
from mjx_reinforce.__main__ import main
main()
"""


def test_ctrl_c_ends_the_imports_of_the_script_quietly():
    """Of ``mjx-reinforce``, whose file imports the function and calls it; a shell says 130."""
    assert entry_point("mjx-reinforce") == "mjx_reinforce.__main__:main"
    shell = ["bash", "-c", '"$0" -c "$1"; exit $?', sys.executable, IMPORTING]
    done = subprocess.run(shell, capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "")


def entry_point(name):
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    return project["scripts"][name]


@pytest.mark.slow
def test_a_second_signal_ends_at_once(tmp_path):
    """Although a block of updates takes minutes."""
    process = start(tmp_path, *FOREVER, "--eval-every", 1_000_000)
    wait_for(lambda: rows(tmp_path) > 0, process)  # the first evaluation is in the block
    time.sleep(0.5)
    process.send_signal(signal.SIGINT)
    assert process.poll() is None
    assert any("stopping after the current block" in line for line in process.stdout)
    process.send_signal(signal.SIGINT)
    begun = time.monotonic()
    assert finish(process) == 130
    assert time.monotonic() - begun < 5
