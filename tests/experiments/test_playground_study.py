"""The study of Playground's suite: what its tables say of made-up runs, and how a run goes on."""

import json

import numpy as np
import pytest

from experiments.kit import rows
from experiments.studies.playground import __main__ as study
from experiments.studies.playground import runs, tables
from mjx_reinforce.files import write_json

RUN = {"date": "", "commit": "", "device": "NVIDIA X", "jax": "", "status": "finished"}


def write_run(folder, task, minutes, returns):
    known = RUN | {"task": task, "minutes": f"{minutes:g}", "seconds": "58.2"}
    known |= {"env_steps": "2500000", "compile_seconds": "15.0"}
    lines = [known | {"seed": i, "return": x} for i, x in enumerate(returns)]
    rows.append(runs.returns_path(folder, task, minutes), lines, runs.COLUMNS)


def write_episodes(folder, task, ours, theirs):
    known = {"date": "", "commit": "", "device": "", "jax": "", "task": task, "seed": 3}
    lines = [
        known | {"implementation": name, "episode": i, "return": x}
        for name, numbers in (("ours", ours), ("jax", theirs))
        for i, x in enumerate(numbers)
    ]
    columns = [*known, "implementation", "episode", "return"]
    rows.append(folder / "agreement.csv", lines, columns)


def write_breaks(folder, seed, counts):
    known = {"task": "HumanoidRun", "seed": seed, "model": "as in the file"}
    lines = [
        known | {"implementation": name, "episodes": episodes, "broken": broken}
        for name, (episodes, broken) in counts.items()
    ]
    rows.append(folder / "breaks.csv", lines, [*known, "implementation", "episodes", "broken"])


def test_sweeps_of_several_tasks_share_a_table(tmp_path):
    """An action of CartpoleSwingup has one entry, one of WalkerRun six."""
    columns = ("task", "max_kl", "initial_std", "entropy_cost", "seed", "final_return")
    lines = [
        ("WalkerRun", 0.15, 1, 0, 0, 500),
        ("WalkerRun", 0.15, 1, 0, 1, 600),
        ("WalkerRun", 0.075, 0.41, 0, 0, 300),
        ("CartpoleSwingup", 0.025, 1, 0, 0, 850),
        ("CartpoleSwingup", 0.0125, 0.99, 0, 0, 7),
    ]
    rows.write(tmp_path / tables.SETTINGS, [dict(zip(columns, x, strict=True)) for x in lines])
    assert tables.settings(tmp_path).splitlines()[2:] == [
        "| 0.0125 n | 1 / sqrt(n) | 0 | 300.0 (300.0) | 7.00 (7.00) |",
        "| 0.025 n | 1 | 0 | 550.0 (500.0) | 850.0 (850.0) |",
    ]


def test_a_page_is_made_of_what_is_kept(tmp_path):
    data = tmp_path / "data"
    data.mkdir()
    for name in (tables.PUBLISHED, tables.PUBLISHED_SECONDS):
        (data / name).write_bytes((study.DATA / name).read_bytes())
    page = tmp_path / "page.md"
    marks = "<!-- not run: a comment -->\n"  # that has no end
    for mark in ("returns", "after a minute", "agreement", "breaks"):
        marks += f"<!-- {mark} -->\n<!-- end -->\n"
    page.write_text(marks)
    write_run(tmp_path / "one", "HopperHop", 1, [10.0, 20.0, 30.0, 40.0, 50.0, 60.0])
    write_run(tmp_path / "one", "WalkerRun", 1, [700.0] * 8)
    write_run(tmp_path / "one", "WalkerRun", 8, [800.0] * 8)
    write_run(tmp_path / "one", "PointMass", 1, [900.0] * 8)
    write_episodes(tmp_path / "one", "WalkerRun", [1.0, 2.0, 3.0], [2.0, 3.0, 4.0])
    write_episodes(tmp_path / "one", "BallInCup", [975.0, 975.0], [974.0, 974.0])
    write_breaks(tmp_path / "one", 2, {"native": (20, 3), "MJX": (5, 1)})
    study.keep(tmp_path / "one", data)
    study.write(data, page)
    lines = page.read_text().splitlines()
    of_returns, _, of_minutes = page.read_text().partition("| task | here, a minute |")
    walker, _, hopper = (
        x for x in of_returns.splitlines() if x.startswith(("| WalkerRun |", "| HopperHop |"))
    )
    assert "| X | 1 | 700.0 (no interval) | 700.0 | 58 | 2.5e6 | 470 | 601 | 711 |" in walker
    assert "| 1 | 35.0 (" in hopper
    assert hopper.endswith("| 10.0 | 58 | 2.5e6 | 2 | 2 | 122 | 61 | 188 |")
    # Means are over the tasks that have all figures. PointMass has none of REPPO.
    assert "| mean of the tasks (3) |  | 1 | 545 |  |  |  | 455 | 500 | 575 |  |  |" in lines
    means = "| mean of the tasks of all columns (2) |  | 1 | 368 |  |  |  | 236 | 302 | 416 |"
    assert f"{means} 446 | 542 |" in lines
    # All columns have the one task of eight minutes.
    assert "| mean of the tasks (1) |  | 8 | 800 |  |  |  | 470 | 601 | 711 | 832 | 896 |" in lines
    assert sum("tasks of all columns (" in line for line in lines) == 1
    # 900 of 894, 700 of 531, 35 of 8: the task that is most behind stands first.
    places = [of_minutes.index(f"| {task} |") for task in ("PointMass", "WalkerRun", "HopperHop")]
    assert places == sorted(places)
    assert "| PointMass | 900.0 (no interval) |  | 894 | 883 |" in lines
    assert any(x.startswith("| WalkerRun (seed 3) | 3 | 2.00 | 3.00 | 1.00 (") for x in lines)
    # Of episodes that are all alike, there is no interval.
    assert "| BallInCup (seed 3) | 2 | 975.0 | 974.0 | -1.00 (no interval) |" in lines
    assert "| HumanoidRun (seed 2) | as in the file | 3 of 20 |  | 1 of 5 |" in lines
    # A run that is kept again replaces what is there.
    write_run(tmp_path / "two", "HopperHop", 1, [1.0] * 8)
    write_breaks(tmp_path / "two", 1, {"native": (20, 4)})
    study.keep(tmp_path / "two", data)
    study.write(data, page)
    assert sum(x.startswith("| HopperHop | X |") for x in page.read_text().splitlines()) == 1
    assert len(tables.results(data)) == 4
    # A count of another policy is beside those that were there.
    places = [page.read_text().index(f"| HumanoidRun (seed {seed}) |") for seed in (1, 2)]
    assert places == sorted(places)


def test_a_policy_whose_test_broke_counts_as_nothing(tmp_path):
    """A summary has null for such a seed, and the data nan."""
    run = tmp_path / "WalkerRun"
    run.mkdir()
    write_json(run / "config.json", {"git_commit": "1234567", "device": "NVIDIA X"})
    summary = {"status": "finished", "compile_seconds": 15.0, "final_test_returns": [None, 700.0]}
    write_json(run / "summary.json", summary)
    (run / "metrics.csv").write_text("seed,env_steps,wall_seconds\n0,1000,58.2\n1,3000,58.2\n")
    path = runs.returns_path(tmp_path, "WalkerRun", 8)
    runs._write(path, run, 8)
    assert [row["return"] for row in rows.read(path)] == ["nan", "700"]
    study.keep(tmp_path, tmp_path)
    (result,) = tables.results(tmp_path)
    assert result.returns.tolist() == [0, 700]
    assert result.env_steps == 2000


def test_every_task_has_published_figures():
    published = rows.read(study.DATA / "published.csv")
    assert {row["task"] for row in published} == set(runs.TASKS)
    assert all(0 <= float(row["mean"]) <= 1000 for row in published)


@pytest.mark.slow
def test_a_run_goes_on_for_more_minutes_and_is_not_repeated(tmp_path, monkeypatch, capsys):
    pytest.importorskip("mujoco_playground")
    from experiments.studies.playground import breaks

    monkeypatch.setattr(runs, "TEST_EPISODES", 2)
    tasks = ["NoSuchTask", "PendulumSwingup"]
    assert not runs.train(tasks, tmp_path, num_seeds=2, minutes=0.02)
    said = capsys.readouterr().out
    assert "NoSuchTask: failed" in said
    first = rows.read(runs.returns_path(tmp_path, "PendulumSwingup", 0.02))
    assert [row["seed"] for row in first] == ["0", "1"]
    assert all(0 <= float(row["return"]) <= 1000 for row in first)
    assert runs.train(tasks[1:], tmp_path, num_seeds=2, minutes=0.02)
    assert "is there" in capsys.readouterr().out
    summary_path = tmp_path / "PendulumSwingup" / "summary.json"
    summary = summary_path.read_text()
    for status, is_new_budget in {"finished": True, "interrupted": False, "running": False}.items():
        summary_path.write_text(json.dumps(json.loads(summary) | {"status": status}))
        design = runs._design(summary_path.parent, runs.settings_of(tasks[1], 2, 0.1))
        assert (design.base.minutes is not None) == is_new_budget, status
    summary_path.write_text(summary)
    assert runs.train(tasks[1:], tmp_path, num_seeds=2, minutes=0.1)
    second = rows.read(runs.returns_path(tmp_path, "PendulumSwingup", 0.1))
    steps = [np.array([float(row["env_steps"]) for row in x]) for x in (first, second)]
    assert (steps[1] > steps[0]).all()
    assert float(second[0]["seconds"]) > float(first[0]["seconds"])
    # The pendulum has nothing to break, in any implementation. What has no run is named.
    breaks.count(tasks, tmp_path, seeds=[1], num_episodes=8, models=[breaks.AS_IN_THE_FILE])
    assert "NoSuchTask, seed 1: failed, cannot read" in capsys.readouterr().out
    counts = {row["implementation"]: row for row in rows.read(tmp_path / "breaks.csv")}
    assert {name: row["episodes"] for name, row in counts.items()} == {
        "native": "8",
        "mujoco": "8",
        "MJX": "2",
    }
    assert {row["broken"] for row in counts.values()} == {"0"}


def test_options_of_a_model_keep_the_time_of_an_env_step():
    pytest.importorskip("mujoco_playground")
    from experiments.studies.playground import breaks

    changes = ("implicit damping, 100 iterations", "half the timestep")
    task = breaks.changed("HumanoidRun", [x for name in changes for x in breaks.MODELS[name]])
    assert task.n_substeps == 10
    assert task.n_substeps * float(task.mjx_model.opt.timestep) == pytest.approx(0.025)
    assert (task.mjx_model.opt.disableflags, task.mjx_model.opt.iterations) == (0, 100)
