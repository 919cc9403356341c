"""Runs and sweeps from Python: ``mjx_reinforce.run`` and ``mjx_reinforce.sweep``."""

import contextlib
import dataclasses
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from mjx_reinforce.console.interrupt import Interrupt
from mjx_reinforce.engine.checks import check_kind
from mjx_reinforce.export.policy_files import Player, played_policy
from mjx_reinforce.export.run_files import PolicyChoice
from mjx_reinforce.files import Arrays, expanded, naming_damage, read_arrays, read_json
from mjx_reinforce.learning.policy import Actor, Policy
from mjx_reinforce.runs.design import Design, check_swept
from mjx_reinforce.runs.perform import perform, report_on
from mjx_reinforce.settings.config import Config
from mjx_reinforce.statistics import worst_if_not_finite
from mjx_reinforce.training.driver import Evaluation, Observer, RunDriver


class Callbacks(Observer[RunDriver]):
    """A user's own functions, called with each ``Evaluation``; one that returns true ends it."""

    def __init__(self, callbacks: Sequence[Callable[[Evaluation], Any]]):
        """Takes the functions."""
        self._functions = callbacks

    def evaluated(self, driver: RunDriver, evaluation: Evaluation, rows: Arrays) -> None:
        """Calls the functions."""
        for callback in self._functions:
            if callback(evaluation):
                driver.ended = True


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

    def player(self, seed: int | None = None, which: PolicyChoice = "last") -> Player:
        """Returns the policy of a seed, to play in Gymnasium or elsewhere.

        Args:
          seed: its number; by default the seed with the best return in the test.
          which: "last" for the policy at the end of training, "best" for the one with the best
            evaluation.
        """
        if which == "last":
            returns = self.test_returns
            actors = self.actor
        else:
            returns = self.best_test_returns
            actors = self.best
        # A return that is NaN would be the greatest for ``argmax``.
        if seed is None:
            seed = int(np.argmax(worst_if_not_finite(returns)))
        if not 0 <= seed < len(returns):
            raise ValueError(f"seed must be in [0, {len(returns)}), got {seed}")
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
      observers: functions that are called with each evaluation, first with that of the untrained
        policies. One that returns a true value ends the run after the current block of updates.
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
    if not (isinstance(observers, Sequence) and all(map(callable, observers))):
        raise ValueError(
            "observers must be a list of functions of one Evaluation, such as "
            f"[lambda evaluation: print(evaluation.seconds)], got {observers!r}"
        )
    config = _beginning("config", config, output)
    # An ``Interrupt`` hears nothing before it is entered: signals are the caller's.
    outcome = perform(
        Design(base=config),
        Interrupt(),
        [Callbacks(observers)],
        files=config.output is not None,
        quiet=quiet,
    )
    driver = outcome.driver
    summary = outcome.summary
    assert isinstance(driver, RunDriver)
    history = driver.record.history()
    return RunResults(
        config=driver.config,
        directory=outcome.directory,
        eval_return=history["eval_return"],
        env_steps=history["env_steps"],
        training=driver.record.training(),
        test_returns=np.asarray(summary["final_test_returns"]),
        best_test_returns=np.asarray(summary["best_test_returns"]),
        policy=played_policy(outcome.policy),
        actor=driver.last_actors(),
        best=driver.best_actors(),
        summary=summary,
    )


class SweepResults(NamedTuple):
    """What a sweep measured, of R runs in E evaluations.

    Attributes:
      directory: of its files, None where none were asked for
      configurations: the values of what was swept, in each
      configuration: [R] the number of each run's
      seed: [R]
      eval_return: [E, R] mean return of the policy's mode; NaN where it was not finite
      env_steps: [E, R] trained until then
      nonfinite: [R] updates that met numbers which are not finite

    Examples:
      >>> import dataclasses
      >>> import mjx_reinforce as mr
      >>> config = dataclasses.replace(
      ...     mr.of_task("CartPole-v1", env_steps=200), num_seeds=2, eval_episodes=2
      ... )
      >>> swept = mr.sweep(config, over={"discount": [0.98, 0.99]}, quiet=True)
      >>> swept.configurations, swept.configuration.tolist()
      ([{'discount': 0.98}, {'discount': 0.99}], [0, 0, 1, 1])
    """

    directory: Path | None
    configurations: list[dict[str, Any]]
    configuration: np.ndarray
    seed: np.ndarray
    eval_return: np.ndarray
    env_steps: np.ndarray
    nonfinite: np.ndarray


def sweep(
    base: Config,
    over: Mapping[str, Sequence[Any]],
    *,
    output: Path | str | None = None,
    exact: bool = False,
    chunk_runs: int | None = None,
    until_decided: bool = False,
    report: bool = True,
    quiet: bool = False,
) -> SweepResults:
    """Trains many configurations, ``base.num_seeds`` of each, as the command line does.

    Args:
      base: the settings that are not swept, such as ``mjx_reinforce.of_task("Hopper-v5")``.
      over: names of settings and the values of each; all combinations are trained.
      output: the directory of the sweep's files. None, with ``base.output`` None too, leaves none.
      exact: train one run at a time, so that no bit of a result depends on the other runs.
      chunk_runs: most runs that train at the same time; by default as many as fit in memory.
      until_decided: train fewer seeds if one configuration is surely the best before, see
        ``statistics.sequential``; what it found is "decision" in sweep.json.
      report: write report.html among the files.
      quiet: show no progress.

    Returns:
      What was measured; the same is in the files of the directory.

    Raises:
      ValueError: a setting makes no sense, or the directory is not empty.
      OSError: a file cannot be written.

    Examples:
      >>> import dataclasses
      >>> import mjx_reinforce as mr
      >>> config = dataclasses.replace(
      ...     mr.of_task("CartPole-v1", env_steps=200), num_seeds=2, eval_episodes=2
      ... )
      >>> swept = mr.sweep(config, over={"discount": [0.98, 0.99]}, quiet=True)
      >>> swept.configurations, swept.configuration.tolist()
      ([{'discount': 0.98}, {'discount': 0.99}], [0, 0, 1, 1])
    """
    base = _beginning("base", base, output)
    check_swept(over)
    # Both spellings are accepted, as --over does.
    over = {name.replace("-", "_"): setting_values for name, setting_values in over.items()}
    directory = base.output
    with contextlib.ExitStack() as stack:
        folder = directory
        # The chunks of a sweep meet in its files alone, so one that leaves none has a folder, too.
        if folder is None:
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="sweep-")))
        base = dataclasses.replace(base, output=folder)
        design = Design(
            base=base,
            over=over,
            exact=exact,
            chunk_runs=chunk_runs,
            until_decided=until_decided,
        )
        outcome = perform(design, Interrupt(), quiet=quiet)
        report_on(outcome, report=report and directory is not None)
        return read_results(folder)._replace(directory=directory)


def _beginning(name: str, config: Config, output: Path | str | None) -> Config:
    """Returns settings of what begins, with its directory, or raises ValueError.

    Args:
      name: of the argument.
      config: that was given.
      output: its directory, if that was given too.
    """
    check_kind(name, config, Config, 'mjx_reinforce.of_task("Hopper-v5")')
    if (directory := config.resume) is not None:
        raise ValueError(
            f"this begins anew: python -m mjx_reinforce.train --resume {directory} goes on with "
            "what is there"
        )
    output_directory = config.output if output is None else output
    # ``~`` is read as on the command line.
    if output_directory is not None:
        output_directory = expanded(output_directory)
    return dataclasses.replace(config, output=output_directory)


def read_results(directory: Path) -> SweepResults:
    """Returns what a finished sweep measured, or raises ValueError."""
    record = read_json(directory / "sweep.json")
    if not (directory / "curves.npz").exists():
        raise ValueError(
            f"{directory} has no results yet: the sweep is {record.get('status', 'unfinished')}; "
            f"go on with it by --resume {directory}"
        )
    with naming_damage(directory / "sweep.json"):
        # Each with its number, which here is its place in the list.
        records = record["configurations"]
        configurations = [
            {name: x for name, x in configuration.items() if name != "configuration"}
            for configuration in records
        ]
    arrays = read_arrays(directory / "curves.npz", SweepResults._fields[2:])
    return SweepResults(directory, configurations, **arrays)
