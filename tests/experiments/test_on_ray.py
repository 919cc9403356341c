"""Shares of a run as tasks of a Ray that runs on this machine."""

import subprocess
import sys

import pytest
from places import PYTHONPATH, ROOT

from mjx_reinforce.reports.sources import read_experiment

DRIFT = "--env toys:Drift --num-episodes 4 --eval-episodes 2 --hidden-sizes 4 --env-steps None"


@pytest.mark.slow
def test_shares_are_trained_and_reported_on_together(tmp_path, monkeypatch):
    pytest.importorskip("ray")
    monkeypatch.setenv("PYTHONPATH", PYTHONPATH)
    monkeypatch.setenv("RAY_ENABLE_UV_RUN_RUNTIME_ENV", "0")
    line = f"on_ray.py {tmp_path} --num-seeds 3 --share 2 --max-updates 2 {DRIFT}".split()
    line[0] = str(ROOT / "experiments" / "examples" / line[0])
    done = subprocess.run([sys.executable, *line], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-3000:]
    (found,) = read_experiment([tmp_path / "0-2", tmp_path / "2-3"]).configurations
    assert found.seed.tolist() == [0, 1, 2]
    assert (tmp_path / "report.html").is_file()
