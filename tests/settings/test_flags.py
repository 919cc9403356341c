"""Reading a command line into dataclasses."""

import dataclasses
import sys
from pathlib import Path
from typing import Literal

import pytest

from mjx_reinforce.settings.flags import (
    cannot_load,
    read_command_line,
    run_command,
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Group:
    """Settings of a kind."""

    number: int = 4
    """How many there are,
    in one paragraph."""
    rate: float = 0.5
    place: Path | None = None
    quick: bool = False
    kind: Literal["round", "square"] = "round"
    sizes: tuple[int, ...] = (32,)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Form:
    """All settings."""

    group: Group = Group()


def read(*words):
    return read_command_line(Form, words, "prog", "What it does.")


def test_what_is_not_said_stays_as_it_is():
    assert read() == Form()


def test_values_of_all_types():
    words = "--number 2e3 --rate 1e-2 --place a/b --quick --kind square --sizes 8 16"
    assert read(*words.split()).group == Group(
        number=2000, rate=0.01, place=Path("a/b"), quick=True, kind="square", sizes=(8, 16)
    )
    assert read("--number=7", "--no-quick").group == Group(number=7)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("--number 2.5", "takes a whole number, such as 4 or 2e6, got '2.5'"),
        ("--rate fast", "could not convert string to float: 'fast'"),
        ("--nubmer 3", "--number"),
        ("--quick true", "true"),
    ],
)
def test_what_cannot_be_read_is_said_by_tyro_and_in_our_words(words, message, capsys):
    with pytest.raises(SystemExit, match="2"):
        read(*words.split())
    assert message in capsys.readouterr().err


@pytest.mark.parametrize("words", [[""], ["--place", ""], ["--place="]])
def test_an_empty_value_is_no_current_folder(words):
    with pytest.raises(ValueError, match="a value on the command line is empty"):
        read(*words)


def test_the_help_shows_every_setting(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "120")
    with pytest.raises(SystemExit):
        read("--help")
    page = capsys.readouterr().out
    assert "What it does." in page
    assert "--number INT" in page
    assert "How many there are, in one paragraph." in page
    assert all(f"--{name}" in page for name in ("rate", "place", "kind", "sizes"))


@pytest.mark.parametrize(
    ("error", "status", "said"),
    [
        (ValueError("a\n b"), 2, "error: a b\n"),
        (FileNotFoundError(2, "No such file", "x"), 2, "error: [Errno 2] No such file: 'x'\n"),
        (KeyboardInterrupt(), 130, ""),
        (ImportError("no libfoo"), 2, f"error: {cannot_load(ImportError('no libfoo'))}\n"),
    ],
)
def test_bad_input_is_one_line_and_a_status(capsys, monkeypatch, error, status, said):
    def fail(_):
        raise error

    monkeypatch.setattr(sys, "argv", ["prog"])
    with pytest.raises(SystemExit) as stop:
        run_command(Form, "watch", fail)
    assert stop.value.code == status
    assert capsys.readouterr().err == said
