"""A run from Python: ``mjx_reinforce.run``."""

import dataclasses
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from mjx_reinforce.console.interrupt import Interrupt
from mjx_reinforce.engine.checks import check_kind
from mjx_reinforce.export.player import Player
from mjx_reinforce.export.policy_files import build_policy
from mjx_reinforce.export.run_files import Which
from mjx_reinforce.learning import counts
from mjx_reinforce.learning.policy import Actor, Policy
from mjx_reinforce.reports.curves import load_libraries
from mjx_reinforce.runs.begin import Begun, begun
from mjx_reinforce.runs.display import Display
from mjx_reinforce.runs.observers import Callbacks, RunFiles
from mjx_reinforce.settings.config import MAX_COUNT, Config
from mjx_reinforce.statistics import worst_if_not_finite
from mjx_reinforce.training.driver import Driver, Evaluation, Observer
from mjx_reinforce.training.progress import HOPELESS
from mjx_reinforce.training.record import RunRecord
from mjx_reinforce.training.slots import Slots, compile_run
from mjx_reinforce.training.state import Budget, begin_with, budget_of, last_actors


def compile_driver(
    begun: Begun,
    say: Callable[[str], None] = lambda text: None,
    meanwhile: Callable[[], object] = lambda: None,
) -> tuple[Driver, float]:
    """Returns a run before its first update, and how long it took to compile, in seconds.

    Args:
      begun: the run.
      say: shows a line to the user.
      meanwhile: begins other work in Python; called once the rest of the time is XLA's.
    """
    config, ready, found = begun.config, begun.ready, begun.found
    started = time.perf_counter()
    slots = compile_run(ready.programs, config, meanwhile)
    seconds = ready.engine_seconds + time.perf_counter() - started
    if config.init_from is not None and found is None:
        slots.restore(begin_with(slots.states(), last_actors(config, ready.policy)))
    if config.minutes is not None:
        first = slots.states()
        if found is not None:
            slots.restore(found.state[0])
        env_steps = env_steps_in(60 * config.minutes, slots, config)
        slots.restore(first)
        say(f"{config.minutes:g} min are about {env_steps:,} env steps of a seed in all here")
        config = dataclasses.replace(config, env_steps=env_steps, minutes=None)
    slots.budget = budget_of(config)
    config = dataclasses.replace(config, horizon=ready.horizon)
    return Driver(config, slots, RunRecord(config, ready.threshold)), seconds


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


def train_run(
    begun: Begun,
    display: Display,
    interrupt: Interrupt,
    observers: Sequence[Observer] = (),
    *,
    compiling: AbstractContextManager[None] | None = None,
) -> tuple[Driver, dict[str, Any]]:
    """Trains to the budget, a signal, or until nothing is finite, and writes the run's files.

    Args:
      begun: the run.
      display: where it is shown.
      interrupt: what listens to signals.
      observers: who sees it, besides its files and the display.
      compiling: a block around all that is compiled.

    Returns:
      The run at its end, and the contents of summary.json.

    Raises:
      OSError: the first or the last files cannot be written.
    """
    loading = threading.Thread(target=load_libraries, daemon=True)
    display.say(begun.plan)
    with display:
        interrupt.restore_screen(display.console.show_cursor)
        with display.compiling(), compiling or nullcontext():
            driver, seconds = compile_driver(begun, display.say, loading.start)
        # Not before: a run killed while it compiles leaves nothing that would refuse the next.
        interrupt.defer(display.say)
        if begun.directory is not None:
            files = RunFiles(begun.directory, begun.ready.policy, display.say)
            files.begin(driver, begun.found)
            driver.observers.append(files)
        driver.observers += [display, *observers]
        display.start(seconds)
        driver.drive(interrupt.heard)
    for observer in driver.observers:
        observer.ended(driver)
    # A signal after that changes nothing: what is left takes a second or two.
    test = driver.test(interrupt.heard)
    summary = summary_of(driver, begun.ready.engine, seconds, test)
    for observer in driver.observers:
        observer.finished(driver, summary)
    return driver, summary


#: The part of the time in which its speed is measured; what is trained in it is trained again.
_PART = 0.03


def env_steps_in(seconds: float, slots: Slots, config: Config) -> int:
    """Returns the env steps that a mean seed will have played in all after a time.

    The seeds are trained, and evaluated, for a small part of that time. The speed of the second
    half of that part counts: the first updates also have what a device does once, and the shortest
    episodes.

    Args:
      seconds: the time.
      slots: the seeds, where the run goes on.
      config: the settings.
    """
    most = MAX_COUNT if config.max_updates is None else config.max_updates
    began, past = time.perf_counter(), [(0.0, *_played(slots))]
    while past[-1][0] < _PART * seconds:
        slots.budget = Budget.of(None, min(past[-1][2] + 2 ** (len(past) - 1), most))
        if not slots.advance(look=False):
            break  # no seed has an update left
        past.append((time.perf_counter() - began, *_played(slots)))
    if len(past) == 1:
        return max(1, round(past[0][1]))
    end, played, updates = past[-1]
    half, before, made = next((x for x in past[1:-1] if x[0] >= end / 2), past[-2])
    a_block = config.block_length * (end - half) / (updates - made)
    evaluating = slots.seconds_to_evaluate()
    speed = (played - before) / (end - half) * a_block / (a_block + evaluating)
    left = max(seconds - end - evaluating, 0.0)
    return min(max(1, round(past[0][1] + speed * left)), MAX_COUNT)


def _played(slots: Slots) -> tuple[float, int]:
    """Returns the env steps of the mean seed, and the updates of the seed with the most."""
    states = slots.states().train_states
    updates = counts.to_int(states.num_updates)
    return float(counts.to_int(states.env_steps).mean()), int(updates.max())


class RunResults(NamedTuple):
    """What a run of S seeds learned and measured, in E evaluations and U updates.

    Attributes:
      config: its settings, its horizon and its budget among them
      directory: of its files, None where none were asked for
      eval_return: [E, S] mean return of the policy's mode; NaN where it was not finite
      env_steps: [E, S] trained until then
      training: [U, S] each: ``episode_return``, the mean of an update's episodes, and the
        ``env_steps`` and ``episodes`` after it
      test_returns: [S] of the last policies, on starts that nothing else is played on
      best_test_returns: [S] the same of the policies with the best evaluations
      policy: the network and its distribution
      actor: [S, ...] the last policies
      best: [S, ...] the policies with the best evaluations
      summary: the contents of summary.json

    Examples:
      >>> import dataclasses
      >>> import mjx_reinforce as mr
      >>> config = dataclasses.replace(
      ...     mr.of_task("CartPole-v1", env_steps=200), num_seeds=2, eval_episodes=2
      ... )
      >>> results = mr.run(config, quiet=True)
      >>> results.test_returns.shape, results.summary["status"]
      ((2,), 'finished')
    """

    config: Config
    directory: Path | None
    eval_return: np.ndarray
    env_steps: np.ndarray
    training: dict[str, np.ndarray]
    test_returns: np.ndarray
    best_test_returns: np.ndarray
    policy: Policy
    actor: Actor
    best: Actor
    summary: dict[str, Any]

    def __repr__(self) -> str:
        mean = float(np.mean(self.test_returns))
        return f"RunResults({self.config.env}, {len(self.test_returns)} seeds, return {mean:.4g})"

    def player(self, seed: int | None = None, which: Which = "last") -> Player:
        """Returns the policy of a seed, to play in Gymnasium or elsewhere.

        Args:
          seed: its number; by default the seed with the best return in the test.
          which: "last" for the policy at the end of training, "best" for the one with the best
            evaluation.
        """
        returns = self.test_returns if which == "last" else self.best_test_returns
        if seed is None:
            seed = int(np.argmax(worst_if_not_finite(returns)))
        if not 0 <= seed < len(returns):
            raise ValueError(f"seed must be in [0, {len(returns)}), got {seed}")
        actors = self.actor if which == "last" else self.best
        actor = jax.tree.map(lambda x: x[seed], actors)
        return Player(self.config.env, seed, self.policy, actor)


def run(
    config: Config,
    *,
    output: Path | str | None = None,
    observers: Sequence[Callable[[Evaluation], Any]] = (),
    quiet: bool = False,
) -> RunResults:
    """Trains the seeds of a run, to the same numbers as ``python -m mjx_reinforce.train``.

    Args:
      config: the settings, such as ``mjx_reinforce.of_task("Hopper-v5")``; others by
        ``dataclasses.replace``.
      output: the directory of the run's files. None, with ``config.output`` None too, writes none.
      observers: functions that are called with each evaluation. One that returns a true value
        ends the run after the present block of updates.
      quiet: show no progress.

    Returns:
      What was learned and measured.

    Raises:
      ValueError: a setting makes no sense, or the directory is not empty.
      OSError: the last files of the run cannot be written.

    Examples:
      >>> import dataclasses
      >>> import mjx_reinforce as mr
      >>> config = dataclasses.replace(
      ...     mr.of_task("CartPole-v1", env_steps=200), num_seeds=2, eval_episodes=2
      ... )
      >>> results = mr.run(config, quiet=True)
      >>> results.test_returns.shape, results.summary["status"]
      ((2,), 'finished')
    """
    check_kind("config", config, Config, 'mjx_reinforce.of_task("Hopper-v5")')
    if not (isinstance(observers, Sequence) and all(map(callable, observers))):
        raise ValueError(
            "observers must be a list of functions of one Evaluation, such as "
            f"[lambda evaluation: print(evaluation.seconds)], got {observers!r}"
        )
    if config.resume is not None:
        raise ValueError(
            f"run() begins a run: go on with {config.resume} by python -m mjx_reinforce.train "
            f"--resume {config.resume}"
        )
    if output is not None:
        config = dataclasses.replace(config, output=Path(output))
    interrupt = Interrupt()  # that hears nothing: signals are the caller's
    display, files = Display(quiet=quiet), config.output is not None
    with begun(config, config, interrupt, display.say, files=files) as made:
        driver, summary = train_run(made, display, interrupt, [Callbacks(observers)])
    return _results_of(driver, build_policy(made.ready.policy), summary)


def _results_of(driver: Driver, policy: Policy, summary: dict[str, Any]) -> RunResults:
    history = driver.record.history()
    return RunResults(
        config=driver.config,
        directory=driver.config.output,
        eval_return=history["eval_return"],
        env_steps=history["env_steps"],
        training=driver.record.training(),
        test_returns=np.asarray(summary["final_test_returns"]),
        best_test_returns=np.asarray(summary["best_test_returns"]),
        policy=policy,
        actor=driver.states.train_states.actor,
        best=driver.best.actor,
        summary=summary,
    )
