"""The text of the report's page, without drawing it."""

import json
from pathlib import Path

import pytest

from mjx_reinforce.reports import document
from mjx_reinforce.reports.experiment import Experiment


def experiment(**changes):
    fields = dict.fromkeys(Experiment._fields, None) | {
        "directories": [Path("b"), Path("a"), Path("b")],
        "provenance": {},
        "timings": {},
        "settings": {},
    }
    return Experiment(**fields | changes)


def test_provenance_is_in_words():
    rows = document.provenance_rows(
        experiment(
            timings={"compile_seconds": 1234.56, "run_seconds": 2.0},
            provenance={
                "git_commit": "abc",
                "packages": {"jax": "0.10.2", "brax": None, "my_own": "1"},
                "devices": ["cpu", "gpu"],
                "x64": False,
                "xla_flags": "",
                "host": None,
                "processes": [],
            },
            settings={"learning_rate": 0.01, "hidden_sizes": [32, 32], "antithetic": True},
        )
    )
    assert rows["facts"] == [
        ("read from", "b, a"),
        ("compile time", "1,234.6 s"),
        ("run time", "2.0 s"),
        ("last commit of the package's files", "abc"),
        ("packages", "jax 0.10.2; my own 1"),
        ("devices", "cpu, gpu"),
        ("x64", "False"),
    ]
    assert rows["settings"] == [
        ("learning rate", "0.01"),
        ("hidden sizes", "32-32"),
        ("antithetic", "True"),
    ]


@pytest.mark.parametrize(
    ("size", "words"),
    [(0, "1 kB"), (1499, "1 kB"), (1501, "2 kB"), (999_999, "1000 kB"), (1_250_001, "1.3 MB")],
)
def test_sizes_in_words(size, words):
    assert document._size_in_words("x" * size) == words
    assert document._size_in_words("é" * 1000) == "2 kB"


def test_no_line_breaks_within_a_number():
    unbroken = document._unbroken("at 95 % with p = 0.01 or p < 0.001, not so")
    assert unbroken == "at 95\u00a0% with p\u00a0=\u00a00.01 or p\u00a0<\u00a00.001, not so"
    markup = document.Markup("95 %")
    assert document._unbroken(markup) is markup
    assert document._unbroken(3) == 3


def test_json_cannot_end_its_script():
    text = document._json({"a": "</script>\u2028\u2029é"})
    assert "<" not in text
    assert "\u2028" not in text
    assert "\u2029" not in text
    assert json.loads(text) == {"a": "</script>\u2028\u2029é"}
    assert "é" in text
    with pytest.raises(ValueError, match="JSON"):
        document._json(float("nan"))


def test_paths_that_are_no_text_are_escaped():
    assert document.encoded("é\udcff") == b"\xc3\xa9\\udcff"
