"""The results page: its statistics, and what its tables say of made-up runs with a known answer."""

import dataclasses

import numpy as np
import pytest
from PIL import Image

from experiments.studies.results import __main__ as results
from experiments.studies.results import films, kept, listing, runs, tables
from experiments.studies.results.tasks import TASKS, settings_of
from mjx_reinforce.files import read_json, write_json
from mjx_reinforce.runs import command_line
from mjx_reinforce.settings.config import check

PENDULUM = TASKS["InvertedPendulum-v5"]
GPU = {"device": "NVIDIA X", "git_commit": "0123456789abcdef", "cpu": None, "cores": None}
CPU = {"device": "cpu", "cpu": "zen, 8 lanes", "cores": 2, "cpu_count": 8, "git_commit": None}


def test_the_tasks_have_settings_that_hold(tmp_path):
    for task in TASKS.values():
        config = command_line.parse(runs.command(task, tmp_path / task.name)[3:]).base
        assert config == dataclasses.replace(settings_of(task), output=tmp_path / task.name)
        check(config)
    (tmp_path / "config.json").write_text("{}")
    assert runs.command(PENDULUM, tmp_path)[3:] == ["--resume", str(tmp_path)]


def write_run(place, config, times, returns, status="finished", test=None):
    """Makes a run up whose evaluations [E, S] were at so many seconds [E]."""
    place.mkdir(parents=True)
    known = {"env": "Hopper-v5", "seed": 7, "num_episodes": 16, "packages": {}, "num_devices": 1}
    write_json(place / "config.json", known | config)
    summary = {"status": status, "compile_seconds": 3.0, "run_seconds": 600.0, "threshold": 5.0}
    summary |= {"num_seeds": len(returns[0]), "engine": "native"}
    write_json(place / "summary.json", summary | ({"final_test_returns": test} if test else {}))
    lines = ["seed,env_steps,wall_seconds,eval_return"]
    for number, (second, row) in enumerate(zip(times, returns, strict=True)):
        lines += [f"{i},{30000 * number},{second},{x}" for i, x in enumerate(row)]
    (place / "metrics.csv").write_text("\n".join(lines) + "\n")


@pytest.fixture
def folder(tmp_path):
    """Small files of runs on a GPU and a CPU; one was stopped, one has just begun."""
    times = [0.0, 30.0, 60.0, 90.0]
    seen = [[0, 0], [1, 3], [4, 8], [10, 20]]
    write_run(tmp_path / "runs" / "gpu", GPU, times, seen, test=[11.0, 21.0])
    write_run(tmp_path / "runs" / "one", CPU | {"seed": 1}, times, [[0], [2], [5], [6]], test=[6.5])
    write_run(
        tmp_path / "runs" / "two", CPU | {"seed": 2}, times, [[0], [1], [7], [9]], "interrupted"
    )
    write_run(tmp_path / "runs" / "young", CPU, [0.0], [[0]])
    (tmp_path / "runs" / "no run").mkdir()
    (tmp_path / "kept").mkdir()
    kept.gather_clock(tmp_path / "runs", tmp_path / "kept")
    return tmp_path


def test_returns_are_those_after_a_minute_and_at_the_end(folder):
    gpu, cpu = kept.clock(folder / "kept")
    assert (gpu.device, cpu.device) == ("NVIDIA X", "zen, 2 of 8 threads")
    np.testing.assert_array_equal([gpu.minute, gpu.final], [[4, 8], [11, 21]])
    np.testing.assert_array_equal(cpu.minute, [5, 7])
    np.testing.assert_array_equal(cpu.final, [6.5, 9])  # the last evaluation of what was stopped
    assert (gpu.seconds, gpu.env_steps, gpu.stopped, cpu.stopped) == (90, 90000, False, True)
    curve = kept.curves(folder / "kept")["Hopper-v5", "NVIDIA X"]
    assert (curve["seconds"][0], curve["seconds"][-1]) == pytest.approx((30, 90))
    assert set(curve["mean"]) == {2, 6, 15}


def test_what_is_kept_of_a_task_and_machine_is_replaced(folder):
    write_run(folder / "more" / "gpu", GPU, [0.0, 50.0], [[0], [2]], test=[3.0])
    kept.gather_clock(folder / "more", folder / "kept")
    gpu, cpu = kept.clock(folder / "kept")
    np.testing.assert_array_equal(gpu.final, [3])
    np.testing.assert_array_equal(cpu.final, [6.5, 9])


def test_races_are_kept_and_listed_as_such(folder):
    """Their rows stand beside those of independent seeds, and replace none."""
    write_run(folder / "more" / "race", GPU | {"race": 4}, [0.0, 50.0], [[0], [2]], test=[3.0])
    kept.gather_clock(folder / "more", folder / "kept")
    gpu, cpu, race = kept.clock(folder / "kept")
    assert (gpu.task, cpu.task, race.task) == ("Hopper-v5",) * 2 + (
        "Hopper-v5, best of races of 4",
    )
    np.testing.assert_array_equal([*gpu.final, *race.final], [11, 21, 3])


def test_the_list_of_runs(folder):
    said = {"final_returns": [10.0, 20.0], "env_steps": [100, 300]}
    for place, race, tested in (("a", 4, [12.0, 24.0]), ("b/c", 1, None)):
        write_run(folder / "list" / place, GPU | {"race": race}, [0.0], [[0, 0]], test=tested)
        path = folder / "list" / place / "summary.json"
        write_json(path, read_json(path) | said)
    first, second = (x.split(" | ") for x in listing.of_runs(folder / "list").splitlines()[2:])
    assert first[:5] == ["| a", "Hopper-v5, best of races of 4", "2", "7", "finished"]
    assert first[6:10] == ["12.0", "24.0", "15.0, 10.0", "10.0 min"]
    assert first[11] == "200"
    # Not tested: the last evaluation.
    assert second[:5] == ["| b/c", "Hopper-v5", "2", "7", "finished, not tested"]
    assert second[6:8] == ["10.0", "20.0"]
    with pytest.raises(ValueError, match="has no run"):
        listing.of_runs(folder / "kept")


def test_the_tables_of_both_pages(folder):
    config = CPU | {"env": PENDULUM.env, "hidden_sizes": [], "env_steps": 90000}
    run, data, docs = folder / "tasks" / PENDULUM.name, folder / "kept", folder / "docs"
    write_run(run, config, [0.0, 1.0, 2.0], [[0, 0], [9, 0], [1, 9]], test=[4.0, 8.0])
    write_run(folder / "tasks" / "Reacher-v5", config, [0.0], [[0]], "interrupted")
    kept.gather_tasks(TASKS.values(), folder / "tasks", data)
    rows = [
        {"policy": policy, "seed": 3, "simulation": name, "episode": i, "return": value + i % 2}
        for policy in kept.POLICIES
        for name, value in (("ours", 998), ("gymnasium 1.4.0", 900))
        for i in range(20)
    ]
    kept.write_played(data / "seconds-play-Hopper-v5.csv", rows)
    (docs / "films").mkdir(parents=True)
    (docs / "films" / "Hopper-v5-best.gif").touch()
    (docs / "published.csv").write_text(
        "algorithm,policy,implementation,task,mean,env_steps\n"
        "PPO,on-policy,A,Hopper,10,1000000\nPPO (asynchronous),on-policy,B,Hopper,12,3000000\n"
        "SAC,off-policy,C,Ant,1,1\nXQC (2 updates),off-policy,C,Ant,3,2\n"
    )
    (docs / "peers.csv").write_text(
        "task,peer,machine,budget_seconds,mean_return\n"
        'Hopper-v5,Stable-Baselines3 PPO,"z, 2 of 8 threads",60,2\n'
        'Hopper-v5,Stable-Baselines3 PPO,"z, 2 of 8 threads",60,4\n'
        'Hopper-v5,Stable-Baselines3 PPO,"z, 2 of 8 threads",600,5\n'
        'Hopper-v5,Stable-Baselines3 SAC,"other, 4 of 8 threads",60,9\n'
    )
    marks = "".join(
        f"<!-- {x} -->\nwas here\n<!-- end -->\n" for x in ("gpu", "cpu", "play", "tasks")
    )
    pendulum = "<!-- pendulum -->\n<!-- end -->\n"
    (docs / "results.md").write_text(marks + pendulum)
    (folder / "README.md").write_text("Before.\n<!-- results -->\nwas here\n<!-- end -->\nAfter.\n")
    assert tables.published_interval(10, 1).high == pytest.approx(10.7154, abs=1e-4)  # Student's
    results.write(data, docs, folder / "README.md")
    page, readme = (docs / "results.md").read_text(), (folder / "README.md").read_text()
    for line in (
        "| Hopper-v5 | X | 2 | 6.00, 4.00 | 16.0 (",
        "| 12.0 (3e6) | none |",
        "| 6.00 (5.00, 7.00) | 7.75 (6.50, 9.00) after 90.0 s (stopped) | 3.00, 5.00 | not run |",
        "| Hopper-v5 | best (3) | 998.5 | 900.5 | -98.0 (",
        "| [video](films/Hopper-v5-best.gif) |\n| Hopper-v5 | median (3) |",
        "| InvertedPendulum-v5 | 2 | 90,000 | 6.00 (",
        "| 4.00 | 1 of 2 (5) | 1,000.0 (1,000.0 to 1,000.0) | 10.0 min, 3.0 s | ",
        "| linear | 2 | 50.00% (1) | 100.00% (2) | 30,000 | 60,000 |",
    ):
        assert line in page
    assert "Reacher" not in page
    assert "| Hopper-v5 | 6.0 | 6.0 | 16.0 in 90.0 s | 12.0 |  |\n" in readme
    assert "| Ant-v5 |  |  |  |  | 3.0 |\n" in readme
    assert (docs / "results" / "seconds.png").exists()
    for text in (page, readme):
        assert "was here" not in text


def test_a_film_that_is_too_large_has_fewer_colors_and_then_no_end(tmp_path):
    path, noise = tmp_path / "noise.gif", np.random.default_rng(0)
    frames = noise.integers(0, 256, (8, 32, 32, 3), np.uint8)
    lengths = []
    for most_bytes in (9_000, 4_000, 3_000):
        films.write_small_gif(path, frames, 10.0, most_bytes)
        assert path.stat().st_size <= most_bytes
        with Image.open(path) as film:
            lengths.append(film.n_frames)
    assert lengths == [8, 6, 4]
    with pytest.raises(ValueError, match=r"half of .*noise\.gif would have"):
        films.write_small_gif(path, frames, 10.0, 1_000)
