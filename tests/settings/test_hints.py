"""What a command line that cannot be read was probably meant to say."""

import dataclasses
from typing import Annotated

import pytest
import tyro

from mjx_reinforce.settings.groups import GROUPS
from mjx_reinforce.settings.hints import (
    _ELSEWHERE,
    _NONE,
    _OTHERS,
    Known,
    about_unknown,
    about_word,
    known,
    other_names,
    required,
    unknown_flags,
)


@dataclasses.dataclass
class Form:
    """A few of the settings."""

    run: Annotated[str, tyro.conf.Positional]
    learning_rate: float = 0.1
    num_seeds: int = dataclasses.field(default=4, metadata={"once": "all have as many"})
    overwrite: bool = False


def about(*words):
    """What is said of the first word that no flag takes."""
    unknown = unknown_flags(words, Form) or [x for x in words if not x.startswith("--")][-1:]
    return about_unknown(unknown, words, Form, "prog")


def test_the_flags_of_a_form():
    assert known(Form) == {
        "--run": Known(switch=False, positional=True),
        "--learning-rate": Known(switch=False, positional=False),
        "--num-seeds": Known(switch=False, positional=False, once="all have as many"),
        "--overwrite": Known(switch=True, positional=False),
    }
    assert required(Form) == ["RUN"]


def test_flags_that_a_form_has_not():
    words = ["--learning_rate=1", "--no-overwrite", "--overwrite", "--lr", "2", "--", "--run", "x"]
    assert unknown_flags(words, Form) == ["--lr", "--run"]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--lr", "1"], "unknown flag '--lr'. Did you mean '--learning-rate'?"),
        (["--learning-rat", "1"], "Did you mean '--learning-rate'?"),
        (["--LEARNING-RATE", "1"], "write --learning-rate"),
        (["--no-learning-rate"], "--learning-rate is no switch but takes a value"),
        (["--run", "x"], "leave it out, and write what follows it alone"),
        (["--learning-rate 1"], "is one word: leave the quotes out"),
        (["--version"], "--version says it"),
        (["--over", "lr"], "it is one of "),
        (["--zzzzzz"], "unknown flag '--zzzzzz'. (See prog --help.)"),
        (["--overwrite", "yes"], "it takes no value, got 'yes'; --no-overwrite switches it off"),
        (["--n-seeds", "3"], "Did you mean '--num-seeds'?"),
        (
            ["--gamma", "1"],
            "unknown flag '--gamma'. (See prog --help.)",
        ),  # the form has no discount
        (["--config", "mine.json"], "config.json; mjx-reinforce train --like RUN repeats them"),
        (["--device", "cuda"], "JAX_PLATFORMS=cuda before the command"),
        (["--learning-rate", "1", "2"], "--learning-rate takes one value; "),
        (["--num-seeds", "4", "8"], "--num-seeds takes one value, also in a sweep: all have as"),
    ],
)
def test_what_was_meant(words, said):
    assert said in about(*words)


@pytest.mark.parametrize(
    ("word", "said"),
    [
        ("Hopper-v5", "is a task: write --env Hopper-v5"),
        ("own:Crane", "is a task: write --env own:Crane"),
        ("Hoper-v5", "unknown task 'Hoper-v5'. Did you mean --env Hopper-v5?"),
        ("hopper", "unknown task 'hopper'. Did you mean --env Hopper-v5?"),
        ("seeds=4", "lacks its dashes: write --seeds 4"),
        ("arm.xml", "is a model: "),
        ("own.py", "a task is a class in one: write --env module:Class"),
        ("runs/old", "--resume runs/old goes on"),
        ("watch", "'watch' is a command of its own"),
        ("plot", "Did you mean the command "),
        ("help", "'help' is written --help"),
        ("\N{EM DASH}lr", "begins with a long dash: write --lr"),
    ],
)
def test_a_word_that_stands_where_none_may(word, said):
    assert said in about_word(word, True, "prog")


def test_a_command_that_is_given_twice():
    assert "is given twice" in about_word("train", True, "python -m mjx_reinforce.train [PRESET]")


def test_a_word_without_a_meaning():
    assert about_word("qqqqqqqq", True, "prog") is None
    assert about_word("Hopper-v5", False, "prog") is None  # of a program that trains nothing


def test_every_hint_names_a_flag_that_some_command_has():
    """Most are of a run; the others are of watch, sweep and export."""
    ours = set().union(*(known(form) for form in GROUPS.values()))
    elsewhere = {"--over", "--search", "--budget", "--to", "--backend", "--noise", "--which"}
    assert {f"--{name}" for name in _OTHERS["flags"]} <= ours | elsewhere
    assert set(_ELSEWHERE) <= elsewhere
    assert not set(_NONE) & ours


def test_no_name_of_another_library_is_a_flag_of_ours():
    for theirs, ours in {"lr": "learning-rate", "steps": "env-steps", "gamma": "discount"}.items():
        assert f"--{ours}" in other_names(f"--{theirs}")
        assert other_names(f"--{ours}") == ()
    assert "--env-steps" in other_names("--total-timesteps")
    assert "--num-episodes" in other_names("--batch-size")
