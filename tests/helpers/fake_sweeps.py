"""Sweep directories as `runs/` writes them, of curves drawn from a formula: nobody trained."""

import itertools
import json

import numpy as np

GRID = {
    "learning_rate": [1e-3, 3e-3, 1e-2, 3e-2],
    "discount": [0.97, 0.98, 0.99, 0.995],
}
THRESHOLD = 950.0


def make_sweep(directory, *, num_seeds=12, evaluations=20, over=GRID, **changes):
    """Writes a finished sweep: seeds that solve the task, fail, fall back, or leave the numbers.

    changes: entries of sweep.json that are replaced
    """
    directory.mkdir(parents=True, exist_ok=True)
    named = [dict(zip(over, values, strict=True)) for values in itertools.product(*over.values())]
    numbered = [{"configuration": i} | settings for i, settings in enumerate(named)]
    drawn = [draw_curves(entry, num_seeds, evaluations) for entry in numbered]
    returns, steps = (np.concatenate(part, axis=1) for part in zip(*drawn, strict=True))
    configuration = np.repeat(np.arange(len(named), dtype=np.int32), num_seeds)
    seed = np.tile(np.arange(num_seeds, dtype=np.int32), len(named))
    np.savez_compressed(
        directory / "curves.npz",
        configuration=configuration,
        seed=seed,
        eval_return=returns,
        env_steps=steps,
        nonfinite=np.isnan(returns).sum(axis=0, dtype=np.int32),
    )
    content = {
        "status": "finished",
        "env": "InvertedPendulum-v5",
        "threshold": THRESHOLD,
        "settings": {"env": "InvertedPendulum-v5", "num_seeds": num_seeds, "seed": 0},
        "over": over,
        "num_seeds": num_seeds,
        "configurations": numbered,
        "compile_seconds": 21.4,
        "run_seconds": 63.0,
        "engine": "vmap",
        "command": "python -m mjx_reinforce.sweep --over learning-rate 1e-3 3e-3 1e-2 3e-2",
        "python": "3.11.9",
        "packages": {"jax": "0.10.2", "mujoco": "4.0.0"},
        "git_commit": "0123456789abcdef0123456789abcdef01234567",
        "device": "cpu",
        "num_devices": 1,
        "cpu_count": 2,
        "x64": False,
        "xla_flags": "",
    }
    (directory / "sweep.json").write_text(json.dumps(content | changes), encoding="utf-8")
    return directory


def draw_curves(settings, num_seeds, evaluations):
    """Returns eval_return and env_steps [E, S]: rises to 1,000, with failures the harder the rate.

    The rate decides how early seeds solve the task and how many of them fail.
    """
    random = np.random.default_rng(settings["configuration"])
    rate = settings.get("learning_rate", 3e-3)
    discount = settings.get("discount", 0.99)
    typical = 46_000 * (3e-3 / rate) ** 0.5 * (1 + 40 * abs(discount - 0.99))
    failing = 0.004 + 0.12 * max(0, np.log10(rate / 3e-3)) + 3 * abs(discount - 0.99)
    steps = np.linspace(0, 280_000, evaluations)[:, None] + random.integers(0, 900, num_seeds)
    steps[0] = 0
    when = typical * np.exp(0.35 * random.standard_normal(num_seeds))
    curve = 1000 / (1 + np.exp(-(steps - when) / (0.22 * when)))
    top = np.where(random.random(num_seeds) < failing, random.uniform(60, 700, num_seeds), 1000)
    curve = np.minimum(curve, top) + 15 * random.standard_normal(curve.shape) * (curve < 990)
    fallen = (random.random(num_seeds) < failing / 2) & (top == 1000)
    curve = np.where(fallen & (steps > 2.5 * when), random.uniform(100, 900, num_seeds), curve)
    broken = random.random(num_seeds) < failing / 8
    curve = np.where(broken & (steps > 90_000), np.nan, curve)
    return np.clip(curve, 3, 1000).astype(np.float32), steps.astype(np.int32)
