"""metrics.jsonl: a line for each row, null where there is no number."""

import json

import pytest

from mjx_reinforce import files
from mjx_reinforce.runs.sinks import JsonLines

NAMES = ("update", "seed", "eval_return", "entropy")
FIRST = {"update": ["0", "0"], "seed": ["0", "1"], "eval_return": ["1.5", "nan"]}
FIRST["entropy"] = ["", ""]


@pytest.fixture
def directory(tmp_path):
    files.create_csv(tmp_path / "metrics.csv", NAMES)
    return tmp_path


def lines(directory):
    text = (directory / "metrics.jsonl").read_text()
    return [json.loads(line, parse_constant=pytest.fail) for line in text.splitlines()]


def test_numbers_that_are_none_are_null(directory):
    JsonLines(directory).write(FIRST)
    assert lines(directory) == [
        {"update": 0, "seed": 0, "eval_return": 1.5, "entropy": None},
        {"update": 0, "seed": 1, "eval_return": None, "entropy": None},
    ]
    assert '"update": 0,' in (directory / "metrics.jsonl").read_text()  # no 0.0


def test_it_begins_with_the_rows_that_are_there(directory):
    (directory / "metrics.jsonl").write_text("of another run\n")
    (directory / "metrics.csv").write_text(",".join(NAMES) + "\n3,0,-inf,2\n")
    sink = JsonLines(directory)
    assert lines(directory) == [{"update": 3, "seed": 0, "eval_return": None, "entropy": 2}]
    sink.write(FIRST)
    assert [line["update"] for line in lines(directory)] == [3, 0, 0]


def test_without_rows_it_is_empty(directory):
    JsonLines(directory)
    assert lines(directory) == []


def test_rows_of_which_none_are_written_raise(directory, monkeypatch):
    sink = JsonLines(directory)
    (directory / "metrics.jsonl").unlink()
    (directory / "metrics.jsonl").mkdir()
    with pytest.raises(OSError, match="jsonl"):
        sink.write(FIRST)
