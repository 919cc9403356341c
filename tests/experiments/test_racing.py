"""The study of races: what it compares, from runs that nobody trained."""

import json

import numpy as np

from experiments.studies import racing


def make_run(directory, training, **summary):
    directory.mkdir()
    said = {"run_seconds": 2.0, "env_steps": [40, 40]} | summary
    (directory / "summary.json").write_text(json.dumps(said))
    (directory / "config.json").write_text(json.dumps({"env": "Task-v0", "race": 2}))
    np.savez(directory / "returns.npz", **training)
    return directory


def test_independent_policies_are_chosen_by_training_returns_and_judged_by_the_test(tmp_path):
    """The third has ended an update before; its last return is that of the second row."""
    training = {
        "episode_return": np.array([[1.0, 9, 9, 1], [1, 3, 8, 7], [4, 2, np.nan, 7]]),
        "env_steps": np.array([[10, 10, 10, 10], [20, 20, 20, 20], [30, 30, 20, 30]]),
    }
    raced = make_run(tmp_path / "race", training, final_test_returns=[6.0, 8.0])
    tested = {"final_test_returns": [5.0, 50, 7, 70], "env_steps": [30, 30, 20, 30]}
    independent = make_run(tmp_path / "independent", training, **tested)
    race_row, best_row, all_row = racing.compare(raced, independent)
    assert [x["arm"] for x in (race_row, best_row, all_row)] == [
        "race of 2",
        "best of 2",
        "no choice",
    ]
    assert [x["mean"] for x in (race_row, best_row, all_row)] == ["7", "6", "33"]
    assert [x["worst"] for x in (race_row, best_row, all_row)] == ["6", "5", "5"]
    assert [x["env_steps"] for x in (race_row, best_row, all_row)] == [80, 110, 110]
    assert [x["policies"] for x in (race_row, best_row, all_row)] == [2, 2, 4]
