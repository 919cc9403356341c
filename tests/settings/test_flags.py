"""Reading a command line into dataclasses."""

import dataclasses
import sys
from pathlib import Path
from typing import Literal

import pytest

from mjx_reinforce.export import run_files
from mjx_reinforce.report import ReportSettings
from mjx_reinforce.runs import results
from mjx_reinforce.runs.command_line import parse
from mjx_reinforce.runs.design import read_over
from mjx_reinforce.settings.config import Config
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


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "word", "value"),
    [
        *(("env_steps", word, None) for word in ("None", "none", "NONE")),
        *(("env_steps", word, 10**6) for word in ("1e6", "1_000_000", "1000000")),
        ("decay_steps", "none", None),
        ("decay_steps", "9e11", 900_000_000_000),
        ("max_kl", "none", None),
        ("max_kl", "1e-2", 0.01),
        ("hidden_sizes", "32,16", (32, 16)),
        ("hidden_sizes", "none", ()),
        ("value_hidden_sizes", "8", (8,)),
        ("value_hidden_sizes", "none", ()),
    ],
)
def test_a_value_is_read_alike_by_a_flag_and_by_over(name, word, value):
    """After --env CartPole-v1, whose defaults are other layers than none."""
    for flag in (f"--{name}", f"--{name.replace('_', '-')}"):
        for words in ([flag, word], [f"{flag}={word}"]):
            assert getattr(parse(["--env", "CartPole-v1", *words]).base, name) == value
    assert read_over([[name, word, "7"]])[name][0] == value


def test_layers_are_words_or_one_word():
    for words in ("--sizes 8 16", "--sizes", "--sizes 8"):
        assert read(*words.split()).group.sizes == tuple(map(int, words.split()[1:]))
    assert parse(["--hidden-sizes", "8", "16", "--seed", "3"]).base.hidden_sizes == (8, 16)
    assert parse(["--hidden-sizes", "--seed", "3"]).base.hidden_sizes == ()


@pytest.mark.parametrize("words", ["--distribution normal", "--distribution=normal"])
def test_the_flag_of_the_distribution_is_named(words):
    for command in ("train", "sweep"):
        with pytest.raises(ValueError, match="no flag is called --distribution: write --policy"):
            parse(words.split(), command)
    with pytest.raises(ValueError, match=r"'distribution' after --over\. Did you mean 'policy'\?"):
        read_over([["distribution", "normal", "tanh-normal"]])


def test_home_is_home_in_every_place_of_a_path(monkeypatch, tmp_path):
    """A shell leaves ``--output=~/run`` as it is, and Python does."""
    monkeypatch.setenv("HOME", str(tmp_path))
    assert read("--place=~/a").group.place == tmp_path / "a"
    sources = read_command_line(ReportSettings, ["~/a", "~/b"], "prog").sources
    assert sources == (tmp_path / "a", tmp_path / "b")
    assert parse(["--output=~/a"]).base.output == tmp_path / "a"
    for output in ("~/a", Path("~/a")):
        assert results._beginning("config", Config(), output).output == tmp_path / "a"
    assert results._beginning("config", Config(output=Path("~/a")), None).output == tmp_path / "a"
    for call in (lambda: parse(["--resume", "~/a"]), lambda: run_files.read_run("~/a")):
        with pytest.raises(ValueError, match=str(tmp_path / "a")):
            call()


def test_python_and_the_command_line_sweep_over_the_same_names(monkeypatch):
    seen = []

    def stop(design, *_, **__):
        seen.append(dict(design.over))
        raise KeyboardInterrupt

    monkeypatch.setattr(results, "perform", stop)
    for name in ("learning-rate", "learning_rate"):
        with pytest.raises(KeyboardInterrupt):
            results.sweep(Config(), {name: [0.1, 0.2]})
        assert seen.pop() == read_over([[name, "0.1", "0.2"]]) == {"learning_rate": [0.1, 0.2]}


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
