"""Runs on several devices: what is divided, and that nothing else changes."""

import csv
import dataclasses
import json
import os
import subprocess
import sys

import jax
import numpy as np
import pytest
from places import PYTHONPATH, ROOT

from mjx_reinforce.runs import plan
from mjx_reinforce.settings.config import Config
from mjx_reinforce.training import resume
from mjx_reinforce.training.division import ALONE, Division

#: What is compared, the settings, and how that is divided. Those of a name share a process.
VARIANTS = {
    "runs": [
        ("run", {}, [{"episodes": 8}, {"seeds": 3}]),
        ("run", {"algorithm": "ars", "engine": "vmap"}, [{"seeds": 2}]),
    ],
    "steps": [
        ("step", {"estimator": "value-baseline"}, [{"episodes": 8}]),
        ("step", {"update": "natural-gradient", "max_kl": 0.01}, [{"episodes": 8}]),
        ("step", {"algorithm": "continuous-cartpole"}, [{"episodes": 2}]),
        (
            "step in groups",
            {"estimator": "value-baseline", "update": "natural-gradient", "max_kl": 0.01},
            [{"episodes": 8}],
        ),
    ],
}


def on_devices(count, folder, *line):
    """Runs a program in a process that has so many devices; returns what it printed."""
    flags = f"{os.environ['XLA_FLAGS']} --xla_force_host_platform_device_count={count}"
    environment = os.environ | {"XLA_FLAGS": flags, "PYTHONPATH": PYTHONPATH}
    done = subprocess.run(
        [sys.executable, *line], cwd=folder, env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout


@pytest.mark.slow
@pytest.mark.cpu
@pytest.mark.parametrize("name", VARIANTS)
def test_devices_change_nothing_but_rounding(tmp_path, name):
    program = str(ROOT / "tests" / "helpers" / "divided.py")
    printed = on_devices(8, tmp_path, program, json.dumps(VARIANTS[name]))
    assert printed.count("equal") == sum(len(divisions) for *_, divisions in VARIANTS[name])


@pytest.mark.parametrize(
    ("seeds", "episodes", "here", "backend", "expected"),
    [
        (1, 16, 1, "cpu", ALONE),
        (16, 16, 8, "gpu", Division(seeds=8)),
        (9, 16, 8, "gpu", Division(seeds=5)),  # of two seeds each
        (9, 4096, 8, "gpu", Division(episodes=8)),
        (3, 16, 8, "gpu", Division(seeds=3)),
        (1, 1024, 2, "gpu", ALONE),
        (1, 2048, 2, "gpu", Division(episodes=2)),
        (1, 65_536, 6, "gpu", Division(episodes=4)),
        (1, 7, 2, "cpu", ALONE),
        (1, 16, 8, "cpu", Division(episodes=8)),
    ],
)
def test_what_is_divided(monkeypatch, seeds, episodes, here, backend, expected):
    monkeypatch.setattr(jax, "__version__", "0.10.2")
    monkeypatch.setattr(jax, "local_device_count", lambda: here)
    monkeypatch.setattr(jax, "default_backend", lambda: backend)
    config = Config(num_seeds=seeds, num_episodes=episodes)
    division = plan.divide_run(config)
    assert division == expected
    assert division.capacity(seeds) >= seeds
    assert episodes % division.episodes == 0


@pytest.mark.parametrize("settings", [{}, {"engine": "vmap"}, {"policy": "categorical"}])
def test_a_jax_that_dies_of_it_divides_no_episodes_among_devices_of_a_cpu(monkeypatch, settings):
    """XLA of JAX 0.11.2 ends the process as it compiles; GPUs, and other versions, are fine."""
    monkeypatch.setattr(jax, "local_device_count", lambda: 2)
    config = Config(num_seeds=1, num_episodes=2048, **settings)
    for version, backend, division in (
        ("0.11.2", "cpu", ALONE),
        ("0.11.2", "gpu", Division(episodes=2)),
        ("0.12.0", "cpu", Division(episodes=2)),
    ):
        monkeypatch.setattr(jax, "__version__", version)
        monkeypatch.setattr(jax, "default_backend", lambda backend=backend: backend)
        assert plan.divide_run(config) == division
        assert plan.divide_run(dataclasses.replace(config, num_seeds=2)) == Division(seeds=2)


def rows(folder):
    return list(csv.DictReader((folder / "metrics.csv").open()))


@pytest.mark.slow
@pytest.mark.cpu
@pytest.mark.skipif(jax.__version__ == "0.11.2", reason="it divides no episodes on a CPU")
def test_a_run_goes_on_on_fewer_devices(run, tmp_path, capsys):
    """Its checkpoints are those of any number."""
    command = "--env toys:Drift --num-episodes 8 --eval-episodes 2 --hidden-sizes 4 --num-seeds 1"
    command += " --env-steps None --eval-every 2 --checkpoint-every 2 --learning-rate 1e-4"
    line = f"-m mjx_reinforce.train {command} --max-updates 4 --output out"
    assert "which share the episodes of an update" in on_devices(2, tmp_path, *line.split())
    assert run("--resume", "out", "--env", "toys:Drift", "--max-updates", "8") == 0
    assert "going on after 4 updates" in capsys.readouterr().out
    assert run(*command.split(), "--max-updates", "8", "--output", "one") == 0
    one, other = rows(tmp_path / "one"), rows(tmp_path / "out")
    assert len(one) == len(other) == 5
    for ours, theirs in zip(one, other, strict=True):
        for name in ("update", "env_steps"):
            assert ours[name] == theirs[name]
        for name in ("train_return", "eval_return", "gradient_norm"):
            values = [float(row[name] or 0) for row in (ours, theirs)]
            np.testing.assert_allclose(*values, rtol=1e-3)


@pytest.mark.slow
@pytest.mark.cpu
def test_programs_of_several_devices_are_kept(tmp_path):
    """The second start reads them, and trains to the bit what the first did."""
    command = "-m mjx_reinforce.train --env CartPole-v1 --num-episodes 8 --eval-episodes 2"
    command += " --num-seeds 1 --env-steps None --max-updates 2 --output"
    for name in ("first", "second"):
        on_devices(2, tmp_path, *command.split(), name)
    for ours, theirs in zip(rows(tmp_path / "first"), rows(tmp_path / "second"), strict=True):
        del ours["wall_seconds"], theirs["wall_seconds"]
        assert ours == theirs


def test_flags_of_xla_but_the_number_of_devices_keep_a_run_from_going_on(tmp_path):
    several = "--xla_a=1 --xla_force_host_platform_device_count=8"
    recorded = {"xla_flags": several}
    resume.check_same_program(tmp_path, recorded, {"xla_flags": "--xla_a=1"})
    with pytest.raises(ValueError, match="xla_flags"):
        resume.check_same_program(tmp_path, recorded, {"xla_flags": "--xla_a=2"})
