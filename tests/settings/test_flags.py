"""Reading a command line into dataclasses, and refusing in one line of our words."""

import dataclasses
import sys
from pathlib import Path
from typing import Literal

import pytest

from mjx_reinforce.settings.flags import asks_brief_help, read_command_line, run_command


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


def read(*words, main=()):
    return read_command_line(Form, words, "prog", "What it does.", main)


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
        (["--number", "2.5"], "--number takes a whole number"),
        (["--number", "many"], "--number takes a whole number"),
        (["--number"], "Missing value for argument '--number'"),
        (["--rate", "fast"], "--rate takes a number, such as 0.5, got 'fast'"),
        (["--place", ""], "--place takes PATH, got ''"),
        (
            ["--kind", "oval"],
            "invalid choice 'oval' for argument '--kind'",
        ),
        (["--sizes", "8", "x"], "x"),
        (["--nubmer", "3"], "unknown flag '--nubmer'. Did you mean '--number'?"),
        (["--", "--number", "3"], "--number stands after --, which ends the flags: leave -- out"),
        (["--zzz"], "unknown flag '--zzz'. (See --help.)"),
        (["--quick", "true"], "no flag or command takes 'true'. (See --help.)"),
        (["--number", "3", "Hopper-v5"], "'Hopper-v5' is a task: write "),
        (["own:Crane"], "train --env own:Crane"),
        (["Hoper-v5"], "Did you mean 'Hopper-v5'?"),
        (["watch"], "'watch' is a command of its own, "),
        (["gymnasium-tutorial"], "a preset comes before all flags"),
    ],
)
def test_what_cannot_be_read_is_one_line(words, message):
    with pytest.raises(ValueError, match=r"^[^\n│]*$") as refused:
        read(*words)
    assert message in str(refused.value)


@pytest.mark.parametrize(
    ("words", "brief"),
    [("--help", True), ("-h", True), ("--help all", False), ("--rate 1", False), ("-h x", True)],
)
def test_the_help_is_brief_unless_all_is_asked_for(words, brief):
    assert asks_brief_help(words.split()) == brief


def test_the_brief_help_shows_the_main_settings_and_how_to_see_all(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "120")
    with pytest.raises(SystemExit):
        read("--help", main=["number", "quick"])
    page = capsys.readouterr().out
    assert "What it does." in page
    assert "--number INT" in page
    assert "How many there are, in one paragraph." in page
    assert "--rate" not in page
    assert "--help all shows all 6 settings." in page


def test_the_whole_help_shows_every_setting(capsys):
    with pytest.raises(SystemExit):
        read("--help", "all", main=["number"])
    page = capsys.readouterr().out
    assert all(f"--{name}" in page for name in ("number", "rate", "place", "kind", "sizes"))
    assert "--help all shows" not in page


@pytest.mark.parametrize(
    ("error", "status", "said"),
    [
        (ValueError("a\n b"), 2, "error: a b\n"),
        (FileNotFoundError(2, "No such file", "x"), 2, "error: [Errno 2] No such file: 'x'\n"),
        (KeyboardInterrupt(), 130, ""),
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
