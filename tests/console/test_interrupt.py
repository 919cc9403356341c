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


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM"])
def test_a_second_signal_leaves_the_exit_status_of_a_command_that_ends(name):
    assert status(name=name, asked=True) == 7


def test_without_a_first_one_a_signal_after_the_command_is_pythons():
    assert status(name="SIGTERM", asked=False) == -signal.SIGTERM
