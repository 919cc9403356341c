"""The comparison of lanes and threads by the number of episodes."""

import sys

import pytest

from experiments.kit import rows
from experiments.speed import lanes


def test_lanes_stand_beside_threads(tmp_path):
    """What threads did not play has no cell."""
    speeds = {
        ("Walker2d-v5", 1): ("2e6", "8e6"),
        ("Walker2d-v5", 16): ("3e6", "4e6"),
        ("playground:WalkerRun", 1): ("1e6", "4e6"),
        ("playground:WalkerRun", 8): ("1.5e6", "1e6"),
        ("playground:HopperHop", 8): ("1e6", "2e6"),
        ("Hopper-v5", 1): ("2e6",),
        ("Hopper-v5", 16): ("1e6", "1e6"),
    }
    lines = [
        dict.fromkeys(lanes.COLUMNS, "")
        | {"task": task, "lanes": count, "episodes": size, "env_steps_per_second": speed}
        for (task, count), pair in speeds.items()
        for size, speed in zip((256, 2048), pair, strict=False)
    ]
    rows.write(tmp_path / "lanes.csv", lines)
    assert lanes.speeds(tmp_path / "lanes.csv").splitlines() == [
        "| task | lanes | 256 episodes | 2,048 episodes |",
        "| --- | --- | --- | --- |",
        "| Hopper-v5 | 16 | 0.50 |  |",
        "| Walker2d-v5 | 16 | 1.50 | 0.50 |",
        "| WalkerRun | 8 | 1.50 | 0.25 |",
    ]


@pytest.mark.slow
@pytest.mark.cpu
def test_a_row_is_measured_for_each_number_of_episodes(monkeypatch, tmp_path):
    """On a CPU, whose lanes are not those that are asked for."""
    for name in ("_is_for_teams", "_lanes", "play_few"):
        monkeypatch.setattr(lanes.teams, name, getattr(lanes.teams, name))  # it is put back after
    lines = lanes.measure("InvertedPendulum-v5", 1, (2, 3))
    assert [(row["lanes"], row["episodes"]) for row in lines] == [(1, 2), (1, 3)]
    assert all(float(row["env_steps_per_second"]) > 0 for row in lines)
    rows.append(tmp_path / "lanes.csv", lines, lanes.COLUMNS)


@pytest.mark.cpu
def test_without_a_gpu_there_is_nothing_to_measure(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["lanes", "measure", "Walker2d-v5"])
    with pytest.raises(SystemExit):
        lanes.main()
    assert "JAX finds none here" in capsys.readouterr().err
