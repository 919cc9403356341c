"""Reading the directory of a run or a sweep: what is whole is read, what is damaged is named."""

import json
import sys

import numpy as np
import pytest

from mjx_reinforce import report
from mjx_reinforce.reports.sources import read_directory, read_metrics

HEADER = "seed,env_steps,eval_return,entropy\n"
ROWS = ["0,10,1.5,2\n", "1,12,-0.5,2\n", "0,20,nan,2\n", "1,22,3.0,2\n"]


@pytest.fixture
def run(tmp_path):
    (tmp_path / "metrics.csv").write_text(HEADER + "".join(ROWS))
    config = {"env": "Hopper-v5", "learning_rate": 0.01, "device": "cpu", "engine": "auto"}
    (tmp_path / "config.json").write_text(json.dumps(config))
    return tmp_path


def test_a_run_that_goes_on(run):
    source = read_directory(run)
    [part] = source.configurations
    assert (source.env, source.status, source.threshold) == ("Hopper-v5", "running", None)
    named = {"env": "Hopper-v5", "learning_rate": 0.01, "engine": "auto"}
    assert source.settings == named | {"race": 1}
    assert source.provenance == {"device": "cpu", "engine": "auto"}
    np.testing.assert_array_equal(part.eval_return, [[1.5, -0.5], [np.nan, 3.0]])
    assert part.env_steps.tolist() == [[10, 12], [20, 22]]
    assert part.nonfinite.tolist() == [0, 0]


def test_a_run_that_ended(run):
    summary = {
        "status": "finished",
        "threshold": 3000,
        "engine": "native",
        "nonfinite": [0, 2],
        "run_seconds": 2.5,
        "compile_seconds": None,
    }
    (run / "summary.json").write_text(json.dumps(summary))
    source = read_directory(run)
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
        ("seed,env_steps\n0,1\n", "eval_return is missing"),
        (HEADER + "0,10,high,2\n", "could not convert .* 'high'"),
        (HEADER + ROWS[0] + "1,12\n", "metrics.csv is damaged: line 3 has 2 entries, not 4"),
        (HEADER + "".join(ROWS[i] for i in (0, 1, 3, 2)), "order of the seeds"),
        (HEADER + ROWS[0] + ROWS[0] + ROWS[1], "order of the seeds"),
        (HEADER + "0,10,1.5," + 131_073 * "2" + "\n", "metrics.csv is damaged: .*field larger"),
        (HEADER + '0,10,"1.5' + 131_073 * "\n2" + "\n", "metrics.csv is damaged: "),
        (HEADER + "0,10,1.5,2\0\n0,1\0,1.5,2\n", "metrics.csv is damaged: "),
        (HEADER + "0,10,1\r5,2\n", "metrics.csv is damaged: "),
        (HEADER + "0,-10,1.5,2\n", "metrics.csv is damaged: env_steps are negative, or fewer"),
        (HEADER + ROWS[0] + ROWS[1] + "0,9,1.5,2\n1,22,3.0,2\n", "or fewer than at the eval"),
    ],
)
def test_a_damaged_table_is_named_with_its_line(run, text, message):
    (run / "metrics.csv").write_text(text)
    with pytest.raises(ValueError, match=message):
        read_metrics(run / "metrics.csv")


def test_a_table_that_csv_refuses_is_one_line(run, capsys, monkeypatch):
    (run / "metrics.csv").write_text(HEADER + "0,10,1.5," + 131_073 * "2" + "\n")
    monkeypatch.setattr(sys, "argv", ["report", str(run)])
    with pytest.raises(SystemExit, match="2"):
        report.main()
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert "metrics.csv is damaged" in said


def test_a_table_that_cannot_be_read(run):
    (run / "metrics.csv").write_bytes(b"seed\xff\n")
    with pytest.raises(ValueError, match="cannot read"):
        read_metrics(run / "metrics.csv")
    (run / "metrics.csv").unlink()
    with pytest.raises(ValueError, match="No such file"):
        read_metrics(run / "metrics.csv")


@pytest.mark.parametrize(
    ("name", "entry", "said"),
    [
        ("config", {}, "env is missing"),
        ("summary", {"nonfinite": ["one"]}, "invalid literal"),
        ("summary", {"nonfinite": [0, 1, 2]}, "could not be broadcast"),
        ("summary", {"threshold": "high"}, "could not convert string to float: 'high'"),
        ("summary", {"run_seconds": [2]}, "float.. argument must be"),
    ],
)
def test_a_damaged_file_of_a_run_is_named(run, name, entry, said):
    (run / f"{name}.json").write_text(json.dumps(entry))
    with pytest.raises(ValueError, match=f"{name}.json is damaged: .*{said}"):
        read_directory(run)


@pytest.mark.parametrize(
    ("config", "summary", "said"),
    [
        (
            {"num_seeds": 3},
            {},
            "metrics.csv has 2 seeds, config.json 3: they are of different runs",
        ),
        ({}, {"env": "Ant-v5"}, "summary.json is for Ant-v5, config.json for Hopper-v5"),
    ],
)
def test_files_of_two_runs_are_named(run, config, summary, said):
    (run / "config.json").write_text(json.dumps({"env": "Hopper-v5", "num_seeds": 2} | config))
    (run / "summary.json").write_text(json.dumps({"status": "running"} | summary))
    with pytest.raises(ValueError, match=said):
        read_directory(run)


CONTENT = {
    "status": "interrupted",
    "env": "Hopper-v5",
    "threshold": 3000.0,
    "settings": {"discount": 0.9},
    "configurations": [
        {"configuration": 0, "learning_rate": 0.1},
        {"configuration": 1, "learning_rate": 0.2},
    ],
    "device": "cpu",
    "run_seconds": 3,
}
ARRAYS = {
    "configuration": np.array([1, 0, 1]),
    "seed": np.array([0, 0, 1]),
    "eval_return": np.arange(6, dtype=np.float32).reshape(2, 3),
    "env_steps": 10 * np.arange(6).reshape(2, 3),
    "nonfinite": np.array([4, 3, 5]),
}


@pytest.fixture
def sweep(tmp_path):
    """Returns a function that writes a sweep, with other parts."""

    def write(content=CONTENT, **arrays):
        (tmp_path / "sweep.json").write_text(json.dumps(content))
        whole = {k: x for k, x in (ARRAYS | arrays).items() if x is not None}
        np.savez(tmp_path / "curves.npz", **whole)
        return tmp_path

    return write


def test_a_sweep_that_was_interrupted(sweep):
    source = read_directory(sweep())
    first, second = source.configurations
    assert (source.env, source.threshold, source.status) == ("Hopper-v5", 3000.0, "interrupted")
    assert (first.label, second.label) == ("learning rate 0.1", "learning rate 0.2")
    assert (first.seed.tolist(), second.seed.tolist()) == ([0], [0, 1])
    assert second.eval_return.tolist() == [[0, 2], [3, 5]]
    assert second.env_steps.tolist() == [[0, 20], [30, 50]]
    assert (first.nonfinite.tolist(), second.nonfinite.tolist()) == ([3], [4, 5])
    assert source.settings == {"discount": 0.9}
    assert source.provenance == {"device": "cpu"}
    assert source.timings == {"run_seconds": 3.0}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"env": 3}, "env must be text, got 3"),
        ({"configurations": [3]}, "'int' object"),
        ({"configurations": CONTENT["configurations"][:1]}, "configuration 1 is missing"),
        ({"threshold": "high"}, "could not convert string to float: 'high'"),
    ],
)
def test_a_damaged_sweep_json_is_named(sweep, change, message):
    with pytest.raises(ValueError, match=f"sweep.json is damaged: .*{message}"):
        read_directory(sweep(content=CONTENT | change))


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"seed": None}, "curves.npz is damaged: seed is missing"),
        ({"seed": np.array(["a", "b", "c"])}, "curves.npz is damaged: invalid literal .*'a'"),
        ({"seed": np.zeros(2, int)}, "curves.npz is damaged: its arrays .*'seed': .2,"),
        ({"env_steps": np.zeros((1, 3))}, "curves.npz is damaged: its arrays"),
        ({"env_steps": -ARRAYS["env_steps"]}, "curves.npz is damaged: env_steps are negative"),
    ],
)
def test_damaged_curves_are_named(sweep, arrays, message):
    with pytest.raises(ValueError, match=message):
        read_directory(sweep(**arrays))


def test_a_sweep_without_results(sweep):
    nothing = {name: x[..., :0] for name, x in ARRAYS.items()}
    with pytest.raises(ValueError, match="has no results yet"):
        read_directory(sweep(**nothing))
