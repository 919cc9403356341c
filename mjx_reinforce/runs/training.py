"""What the command line and ``mjx_reinforce.run`` both do with a run that is ready."""

import dataclasses
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from mjx_reinforce.learners import counts
from mjx_reinforce.reports.curves import draw_learning_curve
from mjx_reinforce.settings.config import Config
from mjx_reinforce.training.best import first_best
from mjx_reinforce.training.budget import env_steps_in
from mjx_reinforce.training.driver import Driver
from mjx_reinforce.training.programs import compile_run
from mjx_reinforce.training.progress import HOPELESS
from mjx_reinforce.training.record import RunRecord
from mjx_reinforce.training.state import begin_with, last_actors

if TYPE_CHECKING:
    from mjx_reinforce.store.ready import Ready
    from mjx_reinforce.training.checkpoint import Checkpoint


def compile_driver(
    ready: "Ready",
    config: Config,
    found: "Checkpoint | None" = None,
    say: Callable[[str], None] = lambda text: None,
    meanwhile: Callable[[], object] = lambda: None,
) -> tuple[Driver, float]:
    """Returns a run before its first update, and how long it took to compile, in seconds.

    Args:
      ready: the run.
      config: its settings.
      found: the checkpoint from which it will go on, if any.
      say: shows a line to the user.
      meanwhile: begins other work in Python; called once the rest of the time is XLA's.
    """
    started = time.perf_counter()
    state, programs = compile_run(ready.programs, config, meanwhile)
    seconds = ready.engine_seconds + time.perf_counter() - started
    if config.init_from is not None and found is None:
        state = begin_with(state, last_actors(config, ready.policy))
    if config.minutes is not None:
        first = state if found is None else found.state[0]
        env_steps = env_steps_in(60 * config.minutes, programs, first, config.max_updates)
        say(f"{config.minutes:g} min are about {env_steps:,} env steps of a seed in all here")
        config = dataclasses.replace(config, env_steps=env_steps, minutes=None)
    record, best = RunRecord(config, ready.threshold), first_best(state.train_states)
    known = dataclasses.replace(config, horizon=ready.horizon)
    return Driver(known, programs, record, state, best), seconds


def summary_of(
    driver: Driver, engine: str, compile_seconds: float, test: dict[str, Any]
) -> dict[str, Any]:
    """Returns the contents of summary.json.

    Args:
      driver: of the run, at its end.
      engine: the name of the engine that played.
      compile_seconds: wall time of compiling.
      test: from ``Driver.test``, empty if the run was interrupted.
    """
    record, seconds = driver.record, driver.seconds()
    end = {"status": "stopped", "reason": HOPELESS} if record.hopeless() else {"status": "finished"}
    return {
        **(end if test else {"status": "interrupted"}),
        **record.summary(engine, compile_seconds, seconds),
        "best_updates": counts.to_int(driver.best.num_updates).tolist(),
        **test,
    }


def draw(driver: Driver) -> bytes:
    """Returns the contents of learning_curve.png."""
    config, record = driver.config, driver.record
    axis = "episodes" if config.env_steps is None else "env_steps"
    history, training = record.history(), record.training()
    return draw_learning_curve(history, training, config.env, record.threshold, axis)
