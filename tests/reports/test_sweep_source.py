"""Reading the directory of a sweep: what is whole is read, and what is damaged is named."""

import json

import numpy as np
import pytest

from mjx_reinforce.reports.sources import read_sweep_source

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
}
RESULTS = "configuration,seed,nonfinite\n0,0,3\n1,0,4\n1,1,5\n"


@pytest.fixture
def sweep(tmp_path):
    """Returns a function that writes a sweep, with other parts."""

    def write(results=RESULTS, content=CONTENT, **arrays):
        (tmp_path / "sweep.json").write_text(json.dumps(content))
        (tmp_path / "results.csv").write_text(results)
        whole = {k: x for k, x in (ARRAYS | arrays).items() if x is not None}
        np.savez(tmp_path / "curves.npz", **whole)
        return tmp_path

    return write


def test_a_sweep_that_was_interrupted(sweep):
    source = read_sweep_source(sweep())
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
        ({"env": None}, "env is None"),
        ({"configurations": {}}, "does not name configuration 0"),
        ({"configurations": [3]}, "configurations is no list of settings"),
        ({"configurations": CONTENT["configurations"][:1]}, "does not name configuration 1"),
        ({"threshold": "high"}, "threshold is 'high', not a number"),
    ],
)
def test_a_damaged_sweep_json_is_named(sweep, change, message):
    with pytest.raises(ValueError, match=message):
        read_sweep_source(sweep(content=CONTENT | change))


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"seed": None}, "it has no array seed"),
        ({"extra": np.zeros(3)}, "'extra' is not an array of a sweep"),
        ({"seed": np.array(["0", "1", "2"])}, "seed holds no numbers"),
        ({"seed": np.zeros(2, int)}, r"seed has the shape \(2,\), not \(3,\)"),
        ({"env_steps": np.zeros((1, 3))}, r"env_steps has the shape \(1, 3\), not \(2, 3\)"),
        ({"eval_return": np.zeros(3)}, "has the shape"),
    ],
)
def test_damaged_curves_are_named(sweep, arrays, message):
    with pytest.raises(ValueError, match=f"curves.npz is damaged: .*{message}"):
        read_sweep_source(sweep(**arrays))


def test_a_curve_without_its_row_is_named(sweep):
    with pytest.raises(ValueError, match="no row of configuration 1, seed 1"):
        read_sweep_source(sweep(results=RESULTS.removesuffix("1,1,5\n")))


def test_a_sweep_without_results(sweep):
    nothing = {name: x[..., :0] for name, x in ARRAYS.items()}
    with pytest.raises(ValueError, match="has no results yet"):
        read_sweep_source(sweep(**nothing))
