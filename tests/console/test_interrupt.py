"""What a signal does to a command, in a process of its own."""

import signal
import subprocess
import sys

import pytest

BEGUN = """
import os, signal, sys, time
from mjx_reinforce.console.interrupt import Interrupt

signal.signal(signal.{name}, signal.SIG_DFL)  # whatever the shell of the tests does with it
with Interrupt() as interrupt:
    interrupt.defer(lambda said: None)
    if {asked}:
        os.kill(os.getpid(), signal.{name})
        while interrupt.number is None:
            time.sleep(0.01)
os.kill(os.getpid(), signal.{name})  # a second one, while the interpreter ends
time.sleep(0.1)
sys.exit(7)
"""


def status(**named):
    return subprocess.run([sys.executable, "-c", BEGUN.format(**named)], check=False).returncode


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGHUP"])
def test_a_second_signal_leaves_the_exit_status_of_a_command_that_ends(name):
    assert status(name=name, asked=True) == 7


def test_without_a_first_one_a_signal_after_the_command_is_pythons():
    assert status(name="SIGTERM", asked=False) == -signal.SIGTERM


HANGUPS = """
import os, signal, sys, time
from mjx_reinforce.console.interrupt import Interrupt

signal.signal(signal.SIGHUP, signal.{before})
with Interrupt() as interrupt:
    if {begun}:
        interrupt.defer(lambda said: None)
    for _ in range(2):  # the kernel and the shell send one each
        os.kill(os.getpid(), signal.SIGHUP)
        time.sleep(0.3)
sys.exit(interrupt.number or 7)
"""


@pytest.mark.parametrize(
    ("before", "begun", "expected"),
    [
        ("SIG_DFL", True, int(signal.SIGHUP)),  # it was asked to stop, once
        ("SIG_DFL", False, 128 + signal.SIGHUP),
        ("SIG_IGN", True, 7),
        ("SIG_IGN", False, 7),
    ],
)
def test_the_end_of_a_terminal_asks_to_stop_unless_it_is_ignored(before, begun, expected):
    """``nohup`` ignores it."""
    command = [sys.executable, "-c", HANGUPS.format(before=before, begun=begun)]
    assert subprocess.run(command, check=False, capture_output=True).returncode == expected
