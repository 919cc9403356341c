"""Command lines run in this process, with environments that are there for a test alone."""

import contextlib
import sys

import pytest
from toys import Drift, Survive

from mjx_reinforce import envs, train


@contextlib.contextmanager
def added_environments():
    """Adds Survive-v0 and Drift-v0; yields a function that adds or replaces others."""
    with pytest.MonkeyPatch.context() as patch:

        def register(name, entry):
            patch.setitem(envs._TABLE, name, (entry, {}))

        register("Survive-v0", Survive)
        register("Drift-v0", Drift)
        yield register


def run_command(*arguments, command=train.main):
    """Runs a command line; returns the exit code."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", [command.__name__, *map(str, arguments)])
        with pytest.raises(SystemExit) as stop:
            command()
    return stop.value.code
