"""Classes that the command ``new`` writes from models."""

import subprocess
import sys

from mjx_reinforce import new


def write(monkeypatch, *arguments):
    """Runs the command in this process."""
    monkeypatch.setattr(sys, "argv", ["new", *arguments])
    new.main()


def lint(file):
    """Raises an error if a file is not in ruff's format, or has what ruff warns of."""
    for check in (["check", "--select", "E,F,W"], ["format", "--check"]):
        options = ["--isolated", "--line-length", "100", file]
        subprocess.run([sys.executable, "-m", "ruff", *check, *options], check=True)
