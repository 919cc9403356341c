"""Returns by seconds: what is kept of runs that had a time, and the page's part on them."""

import numpy as np
import pytest

from experiments.studies.results import clock, seconds
from experiments.studies.results import readme as results_readme
from mjx_reinforce.files import write_json

GPU = {"device": "NVIDIA X", "git_commit": "0123456789abcdef", "cpu": None, "cores": None}
CPU = {"device": "cpu", "cpu": "zen, 8 lanes", "cores": 2, "cpu_count": 8, "git_commit": None}


def _run(place, config, times, returns, status="finished", test=None):
    """Makes a run up whose evaluations [E, S] were at so many seconds [E]."""
    place.mkdir(parents=True)
    write_json(place / "config.json", {"env": "Hopper-v5", "seed": 7, "num_episodes": 16} | config)
    summary = {"status": status, "compile_seconds": 3.0}
    write_json(place / "summary.json", summary | ({"final_test_returns": test} if test else {}))
    lines = ["seed,env_steps,wall_seconds,eval_return"]
    for number, (second, row) in enumerate(zip(times, returns, strict=True)):
        lines += [f"{i},{1000 * number},{second},{x}" for i, x in enumerate(row)]
    (place / "metrics.csv").write_text("\n".join(lines) + "\n")


@pytest.fixture
def folder(tmp_path):
    times = [0.0, 30.0, 60.0, 90.0]
    seen = [[0, 0], [1, 3], [4, 8], [10, 20]]
    _run(tmp_path / "runs" / "gpu", GPU, times, seen, test=[11.0, 21.0])
    _run(tmp_path / "runs" / "one", CPU | {"seed": 1}, times, [[0], [2], [5], [6]], test=[6.5])
    _run(tmp_path / "runs" / "two", CPU | {"seed": 2}, times, [[0], [1], [7], [9]], "interrupted")
    _run(tmp_path / "runs" / "young", CPU, [0.0], [[0]])
    (tmp_path / "runs" / "no run").mkdir()
    (tmp_path / "kept").mkdir()
    seconds.gather(tmp_path / "runs", tmp_path / "kept")
    return tmp_path


def test_returns_are_those_after_a_minute_and_at_the_end(folder):
    gpu, cpu = seconds.load(folder / "kept")
    assert (gpu.device, cpu.device) == ("NVIDIA X", "zen, 2 of 8 threads")
    np.testing.assert_array_equal(gpu.minute, [4, 8])
    np.testing.assert_array_equal(gpu.final, [11, 21])
    np.testing.assert_array_equal(cpu.minute, [5, 7])
    np.testing.assert_array_equal(cpu.final, [6.5, 9])  # the last evaluation of what was stopped
    assert (gpu.seconds, gpu.env_steps, gpu.stopped, cpu.stopped) == (90, 3000, False, True)


def test_curves_are_means_at_the_last_evaluation(folder):
    curves = seconds.curves(folder / "kept")
    gpu = curves["Hopper-v5", "NVIDIA X"]
    assert gpu["seconds"][0] == pytest.approx(30)
    assert gpu["seconds"][-1] == pytest.approx(90)
    assert set(gpu["mean"]) == {2, 6, 15}
    assert set(curves["Hopper-v5", "zen, 2 of 8 threads"]["mean"]) == {1.5, 6, 7.5}


def test_what_is_kept_of_a_task_and_machine_is_replaced(folder):
    before = seconds.load(folder / "kept")
    seconds.gather(folder / "runs", folder / "kept")
    after = seconds.load(folder / "kept")
    assert [x.rows for x in after] == [x.rows for x in before]
    _run(folder / "more" / "gpu", GPU, [0.0, 50.0], [[0], [2]], test=[3.0])
    seconds.gather(folder / "more", folder / "kept")
    gpu, cpu = seconds.load(folder / "kept")
    np.testing.assert_array_equal(gpu.final, [3])
    assert cpu.rows == before[1].rows


def test_the_page_sets_others_beside_ours(folder):
    docs = folder / "docs"
    docs.mkdir()
    (docs / "published.csv").write_text(
        "algorithm,implementation,task,mean,env_steps\n"
        "PPO,A,Hopper,10,1000000\nPPO (asynchronous),B,Hopper,12,3000000\nSAC,C,Ant,1,1\n"
    )
    (docs / "peers.csv").write_text(
        "task,peer,machine,budget_seconds,mean_return\n"
        'Hopper-v5,Stable-Baselines3 PPO,"z, 2 of 8 threads",60,2\n'
        'Hopper-v5,Stable-Baselines3 PPO,"z, 2 of 8 threads",60,4\n'
        'Hopper-v5,Stable-Baselines3 PPO,"z, 2 of 8 threads",600,5\n'
        'Hopper-v5,Stable-Baselines3 SAC,"other, 4 of 8 threads",60,9\n'
    )
    page = "\n\n".join(clock.sections(folder / "kept", docs))
    assert "| Hopper-v5 | X | 2 | 6.00, 4.00 | 16.0 (" in page
    assert "| 12.0 (B, 3 million) | none |" in page
    assert (
        "| 6.00 (5.00, 7.00) | 7.75 (6.50, 9.00) after 90.0 s (stopped) | 3.00, 5.00 | not run |"
        in page
    )
    assert (docs / "results" / "seconds.png").exists()
    assert clock.sections(folder / "nothing", docs) == []


def test_the_table_of_the_readme(folder):
    docs = folder / "docs"
    docs.mkdir()
    (docs / "published.csv").write_text(
        "algorithm,implementation,task,mean,env_steps\nPPO,A,Hopper,3000.4,1000000\n"
    )
    readme = folder / "README.md"
    readme.write_text("Before.\n<!-- results -->\nold\n<!-- end -->\nAfter.\n")
    results_readme.write(seconds.load(folder / "kept"), docs, readme)
    text = readme.read_text()
    assert text.startswith("Before.\n<!-- results -->\n| task |")
    assert "| Hopper-v5 | 6.0 | 6.0 | 16.0 in 90.0 s | 3,000 |\n" in text
    assert "| Ant-v5 |  |  |  |  |\n" in text
    assert text.endswith("<!-- end -->\nAfter.\n")
    assert "old" not in text
