"""The sweeps of the seeds study: what is trained, and what is kept of each run."""

import dataclasses
import functools
import json
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import optax

import mjx_reinforce as mr
from mjx_reinforce import envs
from mjx_reinforce.console.interrupt import Interrupt
from mjx_reinforce.console.jax_setup import configure_jax
from mjx_reinforce.files import read_arrays, read_json, write_arrays
from mjx_reinforce.learning.policy import MLP
from mjx_reinforce.runs.design import Design, read_design
from mjx_reinforce.runs.perform import perform, report_on
from mjx_reinforce.settings.config import Config
from mjx_reinforce.statistics.survival import time_to_threshold

#: Root of all randomness of the study; no figure elsewhere in this repository uses it.
SEED = 20_261_122
#: All combinations of these are trained. The learning rates come last: they share a program.
FACTORS: dict[str, list[Any]] = {
    "estimator": ["reward-to-go", "leave-one-out", "value-baseline"],
    "discount_weights": [False, True],
    "standardize": [True, False],
    "learning_rate": [3e-3, 1e-2, 3e-2],
}
#: The settings that a sweep goes over for some of them, with their values in the same order.
_SETTINGS: dict[str, tuple[str, list[Any]]] = {
    "discount_weights": ("algorithm", [f"{__name__}:{name}" for name in ("plain", "discounted")]),
    "standardize": ("standardize_floor", [10.0, None]),
}


def plain(env: Any, config: Config, *, discounted: bool = False, **shared: Any) -> mr.Learner:
    """Returns the learner of the settings; the learning rate decays over 100 updates."""
    make = {"reward-to-go": mr.reward_to_go, "leave-one-out": mr.leave_one_out}
    estimator = make.get(config.estimator, _baseline)(config.discount)
    if config.standardize_floor is not None:
        estimator = mr.standardize(estimator, floor=config.standardize_floor)
    if discounted:
        estimator = mr.discount_weights(estimator, config.discount)
    rate = optax.linear_schedule(config.learning_rate, config.learning_rate / 10, 100)
    return mr.reinforce(
        env,
        estimator=estimator,
        optimizer=mr.make_optimizer("adam", rate),
        num_episodes=config.num_episodes,
        **shared,
    )


#: The same, with the weight at step t times discount^t.
discounted = functools.partial(plain, discounted=True)


def _baseline(discount: Any) -> mr.Estimator:
    """Returns a small baseline that reads the observation and is fitted to whole rollouts."""
    return mr.full_batch_value_baseline(discount, network=MLP((32, 32), 1), num_fits=10)


class Task(NamedTuple):
    """What the study keeps of one task's runs; arrays [...] have one axis for each factor.

    name: the environment's id
    factors: the values of each setting that was swept, in the order of the axes
    threshold: the return that counts as solved
    budget: env steps of a run
    untrained: mean return of the policies before training
    final_return: [..., S] return at the last evaluation
    average_return: [..., S] return averaged over the env steps of the budget
    steps_to_solve: [..., S] env steps at the first evaluation at or above the threshold, the
      whole budget where that came later or never
    env_steps: [..., S] env steps that were trained
    record: what sweep.json says, and ``nonfinite_runs``, runs that met numbers that are not finite
    """

    name: str
    factors: dict[str, list[Any]]
    threshold: float
    budget: int
    untrained: float
    final_return: np.ndarray
    average_return: np.ndarray
    steps_to_solve: np.ndarray
    env_steps: np.ndarray
    record: dict[str, Any]


_ARRAYS = ("final_return", "average_return", "steps_to_solve", "env_steps")


def base_settings(task: str, num_seeds: int) -> Config:
    """Returns what all runs of a task share: the defaults of the time when the study was made.

    But they are evaluated more often.
    """
    return Config(
        env=task,
        hidden_sizes=() if task.startswith("InvertedPendulum-") else (32, 32),
        num_seeds=num_seeds,
        seed=SEED,
        max_updates=150,  # a run whose episodes stay short ends here
        eval_every=2,
        # As ``_baseline`` has them; the page says so.
        value_hidden_sizes=(32, 32),
        value_fits=10,
    )


def train(base: Config, directory: Path) -> bool:
    """Trains all combinations of ``FACTORS``, or goes on with it, and measures the runs.

    Args:
      base: the settings that all runs share.
      directory: of the sweep; one that was begun goes on where it stopped.

    Returns:
      Whether it ended; Ctrl-C stops it so that it can go on.

    Raises:
      ValueError: fewer than 8 seeds, a task without a threshold, or what ``perform`` refuses.
    """
    if base.num_seeds < 8:
        raise ValueError(f"--num-seeds must be at least 8, half to choose, got {base.num_seeds}")
    configure_jax()
    if envs.make(base.env).reward_threshold is None:
        raise ValueError(f"{base.env} names no return at which it is solved; choose another task")
    if (directory / "sweep.json").exists():
        design = read_design(directory)
    else:
        over = dict(_SETTINGS.get(name, (name, values)) for name, values in FACTORS.items())
        design = Design(base=dataclasses.replace(base, output=directory), over=over)
    with Interrupt() as interrupt:
        report_on(perform(design, interrupt))
        ended = interrupt.number is None
    if ended:
        save(measure(directory), directory)
    return ended


def measure(directory: Path) -> Task:
    """Returns what the study keeps of a finished sweep.

    A return that is not finite counts as the worst finite one of the sweep.
    """
    record = read_json(directory / "sweep.json")
    runs = read_arrays(directory / "curves.npz", ("eval_return", "env_steps"))
    names = {setting: name for name, (setting, _) in _SETTINGS.items()}
    factors: dict[str, list[Any]] = {}
    for x, values in record["over"].items():
        factors |= {names[x]: FACTORS[names[x]]} if x in names else {x: values}
    shape = [len(values) for values in factors.values()]
    returns, steps = runs["eval_return"].astype(float), runs["env_steps"]
    finite = np.isfinite(returns)
    record["nonfinite_runs"] = int(np.sum(~finite.all(axis=0)))
    returns = np.where(finite, returns, returns[finite].min())
    budget = record["settings"]["env_steps"]
    grid = np.linspace(0, budget, 57)  # over which returns are averaged
    curves = np.stack([np.interp(grid, x, y) for x, y in zip(steps.T, returns.T, strict=True)])
    first, solved = time_to_threshold(returns, steps, record["threshold"])
    measured = {
        "final_return": returns[-1],
        "average_return": np.trapezoid(curves, grid, axis=1) / budget,
        "steps_to_solve": np.where(solved, np.minimum(first, budget), budget),
        "env_steps": steps[-1],
    }
    return Task(
        name=record["env"],
        factors=factors,
        threshold=record["threshold"],
        budget=budget,
        untrained=float(np.mean(returns[0])),
        record=record,
        **{name: x.reshape(*shape, -1) for name, x in measured.items()},
    )


def save(task: Task, directory: Path) -> None:
    """Writes study.npz: all that the page is made of, a few megabytes."""
    facts = {name: x for name, x in task._asdict().items() if name not in _ARRAYS}
    arrays = {name: np.asarray(getattr(task, name), np.float32) for name in _ARRAYS}
    arrays["facts"] = np.array(json.dumps(facts))
    write_arrays(directory / "study.npz", arrays, compressed=True)


def load(path: Path) -> Task:
    """Returns what ``save`` wrote, from the file or its directory; ValueError without one."""
    arrays = read_arrays(path / "study.npz" if path.is_dir() else path)
    kept: dict[str, Any] = json.loads(str(arrays.pop("facts")))
    kept.update({name: arrays[name].astype(float) for name in _ARRAYS})
    return Task(**kept)
