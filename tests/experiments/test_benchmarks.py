"""The tables of speed say what docs/benchmarks.csv says, and its rows say all of a measurement."""

import itertools
import time

import pytest

from experiments.kit import rows as kit_rows
from experiments.kit.rows import threads
from experiments.speed.benchmark import rows, tables
from experiments.speed.benchmark.peers import c_mujoco

ROW = {
    "date": "2026-11-24T12:00:00",
    "commit": "abc",
    "machine": "a CPU, 2 of 2 threads",
    "device": "cpu",
    "jax": "0.10.2",
    "task": "Hopper-v5",
    "what": "rollout",
    "engine": "native",
    "precision": "float32",
    "batch": 512,
    "steps": 20,
    "settings": "",
    "env_steps_per_second": [1e6, 3e6, 2e6],
}
DOUBLE = ROW | {"precision": "float64", "env_steps_per_second": [4e5]}
GPU = ROW | {"date": "2026-11-24T13:00:00", "device": "a GPU"}
C = ROW | {"engine": "C MuJoCo", "precision": "float64", "env_steps_per_second": [1e5]}


@pytest.mark.parametrize("path", tables.PAGES, ids=lambda path: path.name)
def test_tables_are_those_of_the_raw_rows(path):
    text = path.read_text(encoding="utf-8")
    assert tables.page(text, tables.last_calls(rows.read())) == text
    assert "<!-- end -->" in text


def test_rows_come_back_with_every_repetition(tmp_path):
    path = tmp_path / "rows.csv"
    rows.append(path, [ROW])
    rows.append(path, [C])
    back = rows.read(path)
    assert [row["engine"] for row in back] == ["native", "C MuJoCo"]
    assert back[0]["env_steps_per_second"] == [1e6, 3e6, 2e6]
    assert rows.speed(back[0]) == 2e6


def test_c_mujoco_stands_beside_its_own_precision_of_the_same_call():
    old = {"date": "2026-11-23T12:00:00", "env_steps_per_second": [1e9]}
    raw = tables.last_calls([ROW | old, C | old, ROW, DOUBLE, C, GPU])
    line = next(line for line in tables.cpu(raw).splitlines() if line.startswith("| Hopper"))
    cells = [cell.strip() for cell in line.split("|")[1:-1]]
    assert cells == ["Hopper-v5", "512 x 20", "2.00e6", "4.00e5", "1.00e5", "4.0", "20", ""]
    sentence = " ".join(tables.words(raw).splitlines())
    assert "4.0 (Hopper) to 4.0 (Hopper) times as fast as C MuJoCo in float64" in sentence


def test_rows_beside_envpool_have_calls_of_their_own():
    """A later call with EnvPool, on another machine, leaves the table of two cores as it is."""
    later = {"date": "2026-11-25T12:00:00", "env_steps_per_second": [8e5]}
    pool = C | later | {"engine": "EnvPool", "env_steps_per_second": [2e5]}
    raw = tables.last_calls([ROW, DOUBLE, C, *(row | later for row in (ROW, DOUBLE, C)), pool])
    assert "| 2.00e6 | 4.00e5 | 1.00e5 |" in tables.cpu(raw)
    assert tables.envpool(raw).splitlines()[-1] == (
        "| Hopper-v5 | 8.00e5 | 8.00e5 | 8.00e5 | 2.00e5 | 4.0 | 4.0 |"
    )


def test_a_busy_machine_counts_what_is_computed(monkeypatch):
    """Not the seconds that pass: 3 s of two threads together are 1.5 s."""
    seconds = itertools.count(0.0, 3.0)
    monkeypatch.setattr(time, "process_time", lambda: next(seconds))
    monkeypatch.setattr(kit_rows, "threads", lambda: 2)
    (row,) = rows.measure([rows.Candidate(ROW, lambda: None, 6)], 1, kit_rows.shared_clock)
    assert rows.speed(row) == 4


def test_few_episodes_have_calls_of_their_own():
    """The last call of few episodes stands beside an earlier one of many."""
    few = GPU | {"date": "2026-11-24T14:00:00", "batch": 1, "env_steps_per_second": [5e3]}
    raw = tables.last_calls([GPU, few, few | {"engine": "MuJoCo Warp"}])
    assert "| 2.00e6 | 512 x 20 |  |  |  |" in tables.gpu(raw)  # not beside one world of Warp
    assert [row["batch"] for row in raw.gpu] == [512, 1, 1]
    assert "| Hopper-v5 | 1 | 0.2 | 0.2 | 1.0 |" in tables.latency(raw)
    assert tables.rate(tables.best(raw.gpu, "Hopper-v5", "native")) == "2.00e6"


def test_peers_say_their_precision_and_settings():
    candidate = c_mujoco("InvertedPendulum-v5", batch=2, steps=1)
    candidate.run()
    assert (candidate.env_steps, candidate.row["precision"]) == (2, "float64")
    assert f"{threads()} threads; NEWTON, 100 iterations" in candidate.row["settings"]


def test_a_trained_policy_stands_beside_warp_and_few_episodes_have_milliseconds():
    robot = "m:Robot xml_file=models/go1/xmls/scene.xml"
    row = GPU | {"task": robot, "batch": 2048, "what": rows.UNTRAINED}
    few = row | {"batch": 32, "env_steps_per_second": [1.6e5]}
    trained = row | {"what": rows.TRAINED, "env_steps_per_second": [9e6]}
    warp = row | {"engine": "MuJoCo Warp", "what": "rollout, no policy"}
    slow, fast = (
        warp | {"env_steps_per_second": [x], "batch": n} for x, n in ((4e4, 32), (5e5, 9))
    )
    raw = tables.last_calls([row, few, trained, slow, fast])
    assert tables.gpu(raw).splitlines()[-1].count("2.00e6") == 1
    assert tables.trained(raw).splitlines()[-1] == (
        "| go1 scene | 2.00e6 | 9.00e6 | 5.00e5 | 9 x 20 | 4.0 | 18 |"
    )
    assert tables.latency(raw).splitlines()[2:] == ["| go1 scene | 32 | 0.2 | 0.8 | 4.0 |"]
