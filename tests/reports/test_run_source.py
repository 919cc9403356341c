"""Reading the directory of a run: what is whole is read, and what is damaged is named."""

import json

import numpy as np
import pytest

from mjx_reinforce.reports.run_source import number_entry, read_metrics, read_run_source, timings

HEADER = "seed,env_steps,eval_return,entropy\n"
ROWS = ["0,10,1.5,2\n", "1,12,-0.5,2\n", "0,20,nan,2\n", "1,22,3.0,2\n"]


@pytest.fixture
def run(tmp_path):
    (tmp_path / "metrics.csv").write_text(HEADER + "".join(ROWS))
    config = {"env": "Hopper-v5", "learning_rate": 0.01, "device": "cpu", "engine": "auto"}
    (tmp_path / "config.json").write_text(json.dumps(config))
    return tmp_path


def test_a_run_that_goes_on(run):
    source = read_run_source(run)
    [part] = source.configurations
    assert (source.env, source.status, source.threshold) == ("Hopper-v5", "running", None)
    assert source.settings == {"env": "Hopper-v5", "learning_rate": 0.01, "engine": "auto"}
    assert source.provenance == {"device": "cpu", "engine": "auto"}
    np.testing.assert_array_equal(part.eval_return, [[1.5, -0.5], [np.nan, 3.0]])
    assert part.env_steps.tolist() == [[10, 12], [20, 22]]
    assert part.nonfinite.tolist() == [0, 0]


def test_a_run_that_ended(run):
    summary = {
        "status": "finished",
        "threshold": 3000,
        "engine": "native",
        "nonfinite": [{"seed": 1}, {"seed": 1}],
        "run_seconds": 2.5,
        "compile_seconds": None,
    }
    (run / "summary.json").write_text(json.dumps(summary))
    source = read_run_source(run)
    assert (source.status, source.threshold) == ("finished", 3000.0)
    assert source.provenance["engine"] == "native"
    assert source.timings == {"run_seconds": 2.5}
    assert source.configurations[0].nonfinite.tolist() == [0, 2]


@pytest.mark.parametrize("end", ["0,30,1", "0,30,1.0,2\n", "0,30,1.0,2\n1,32,4"])
def test_a_last_evaluation_that_is_not_whole_is_left_out(run, end):
    with (run / "metrics.csv").open("a") as file:
        file.write(end)
    assert read_metrics(run / "metrics.csv")["env_steps"].tolist() == [[10, 12], [20, 22]]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (HEADER, "has no evaluation yet"),
        ("seed,env_steps\n0,1\n", "has no column eval_return"),
        (HEADER + "0,10,high,2\n", "eval_return in line 2 is 'high'"),
        (HEADER + ROWS[0] + "1,12\n", "line 3 has 2 entries, not 4"),
        (HEADER + "".join(ROWS[i] for i in (0, 1, 3, 2)), "line 4 is not of seed 0"),
        (HEADER + ROWS[1], "line 2 is not of seed 0"),
    ],
)
def test_a_damaged_table_is_named_with_its_line(run, text, message):
    (run / "metrics.csv").write_text(text)
    with pytest.raises(ValueError, match=message):
        read_metrics(run / "metrics.csv")


def test_a_table_that_cannot_be_read(run):
    (run / "metrics.csv").write_bytes(b"seed\xff\n")
    with pytest.raises(ValueError, match="cannot read"):
        read_metrics(run / "metrics.csv")
    (run / "metrics.csv").unlink()
    with pytest.raises(ValueError, match="No such file"):
        read_metrics(run / "metrics.csv")


def test_a_run_without_a_task(run):
    (run / "config.json").write_text("{}")
    with pytest.raises(ValueError, match=r"config.json is damaged: env is None"):
        read_run_source(run)


@pytest.mark.parametrize("events", [3, [3], [{}], [{"seed": "one"}]])
def test_damaged_events(run, events):
    (run / "summary.json").write_text(json.dumps({"nonfinite": events}))
    with pytest.raises(ValueError, match="nonfinite is no list of updates"):
        read_run_source(run)


def test_entries_are_numbers_or_none(tmp_path):
    assert number_entry({"x": 2}, "x", tmp_path) == 2.0
    assert number_entry({}, "x", tmp_path) is None
    for value in (True, "2"):
        with pytest.raises(ValueError, match=f"x is {value!r}, not a number"):
            number_entry({"x": value}, "x", tmp_path)
    with pytest.raises(ValueError, match="run_seconds"):
        timings({"run_seconds": "long"}, tmp_path)
