"""All tasks together: scores of 0 untrained and 1 solved, and the fastest over tasks."""

import numpy as np
import pytest
from fake_sweeps import make_sweep
from measured_runs import make_measured_run

from experiments.examples import all_tasks

RATES = {"learning_rate": [1e-3, 3e-3, 1e-2]}


def all_solve(directory, first):
    """Lets all seeds end alike, those of configuration i having solved it at ``first[i]``."""
    with np.load(directory / "curves.npz") as archive:
        arrays = dict(archive)
    arrays["eval_return"][:] = 20.0
    for i, evaluation in enumerate(first):
        arrays["eval_return"][evaluation:, arrays["configuration"] == i] = 1000.0 - i
    np.savez(directory / "curves.npz", **arrays)


def test_a_table_and_a_figure_of_all_tasks(tmp_path, capsys):
    """Of the configurations that both have; the means tell them hardly apart, the times do."""
    second = {"learning_rate": [1e-3, 3e-3, 1e-2, 3e-2]}
    changes = {"env": "Other-v0", "threshold": 500.0}
    directories = [
        make_sweep(tmp_path / "a", num_seeds=12, over=RATES),
        make_sweep(tmp_path / "b", num_seeds=8, over=second, **changes),
    ]
    for each in directories:
        all_solve(each, [3, 3, 9, 2])
    found = all_tasks.read(directories)
    all_tasks.compare(found, str(tmp_path / "figure.png"))
    rows = [line.strip("| ").split(" | ") for line in capsys.readouterr().out.splitlines()[2:]]
    assert [row[0] for row in rows] == [f"learning rate {x}" for x in (0.001, 0.003, 0.01)]
    for i, row in enumerate(rows):
        score = [(1000 - i - 20) / (one - 20) for one in (950, 500)]
        assert row[1] == "20"
        assert float(row[2].split()[0]) == pytest.approx(np.mean(score), abs=1e-3)
    assert float(rows[0][-1]) == 1
    assert float(rows[1][-1]) > 0.05
    assert float(rows[2][-1]) < 1e-6
    assert (tmp_path / "figure.png").read_bytes().startswith(b"\x89PNG")


def test_one_run_of_each_task_is_one_configuration(tmp_path, capsys):
    runs = [make_measured_run(tmp_path / "a"), make_measured_run(tmp_path / "b", env="Other-v0")]
    all_tasks.compare(all_tasks.read(runs), str(tmp_path / "figure.png"))
    assert capsys.readouterr().out.splitlines()[2].startswith("| all | 6 | ")
