"""``python -m mjx_reinforce.train`` trains many seeds at once and reports over them."""

import signal

if __name__ == "__main__":  # Ctrl-C ends the imports below without a traceback
    signal.signal(signal.SIGINT, signal.SIG_DFL)

import contextlib
import dataclasses
import gc
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NoReturn

from mjx_reinforce import envs
from mjx_reinforce.runs import resume
from mjx_reinforce.runs.alarms import silence_alarms
from mjx_reinforce.runs.command_line import parse
from mjx_reinforce.runs.config import Config, check
from mjx_reinforce.runs.files import choose_directory, prepare, remove_empty
from mjx_reinforce.runs.flags import accept_all_characters
from mjx_reinforce.runs.interrupt import Interrupt
from mjx_reinforce.runs.jax_setup import configure_jax
from mjx_reinforce.runs.memory import check_size
from mjx_reinforce.runs.plan import Plan, make_plan


def main() -> None:
    """Reads the command line, trains, and exits.

    The status is 0 when done, 1 if files cannot be written or nothing is finite any more, 2 for bad
    input, 130 after Ctrl-C and 143 after SIGTERM.
    """
    accept_all_characters()
    silence_alarms()
    with Interrupt() as interrupt, contextlib.ExitStack() as held:
        sys.exit(_main(sys.argv[1:], interrupt, held))


def _main(arguments: Sequence[str], interrupt: Interrupt, held: contextlib.ExitStack) -> int:
    """Returns the exit status of a command line; ``held`` keeps what is released at its end."""
    from mjx_reinforce.runs.files import locked

    made: Sequence[Path] = ()
    try:
        with _collection_paused():
            config = parse(arguments)
            check(config)
            check_size(config)
            directory, made = _directory(config)
            interrupt.on_exit(lambda: remove_empty(made))
            held.enter_context(locked(directory))
            env = envs.make(config.env)
            configure_jax()
            learner, horizon, found = _start(env, config)
            plan = make_plan(env, learner, horizon, config)
    except ValueError as error:
        _refuse(str(error), made)
    try:
        return train(env, learner, horizon, found, config, plan, directory, interrupt)
    except RuntimeError as error:  # XLA's
        if "RESOURCE_EXHAUSTED" not in str(error):
            raise
        remedy = "lower --num-seeds, --num-episodes, --eval-episodes or --horizon"
        _refuse(f"this run does not fit into memory ({error}); {remedy}", made)
    except OSError as error:
        remedy = f"make room, then go on with --resume {directory}"
        _refuse(f"cannot write the files of this run ({error}); {remedy}", made, status=1)


def _directory(config: Config) -> tuple[Path, Sequence[Path]]:
    """Returns the run directory, and the folders that were made for it."""
    if config.resume is not None:
        return config.resume, ()
    directory = choose_directory(config.output, config.env)
    return directory, prepare(directory, config.overwrite)


def _start(env: Any, config: Config) -> tuple[Any, int, Any]:
    """Returns the learner, the horizon, and the checkpoint from which the run goes on, if any.

    Raises:
      ValueError: the settings do not fit the environment, or the run cannot go on here.
    """
    from mjx_reinforce.runs.build import build
    from mjx_reinforce.runs.files import provenance

    learner, horizon = build(env, config)
    if config.resume is None:
        return learner, horizon, None
    resume.check_program(config.resume, provenance())
    return learner, horizon, resume.find(learner, config, print)


def _refuse(message: str, made: Sequence[Path], status: int = 2) -> NoReturn:
    """Says in one line what is wrong, removes the folders that this run made, and exits."""
    remove_empty(made)
    print(f"error: {' '.join(message.split())}", file=sys.stderr)
    sys.exit(status)


def train(
    env: Any,
    learner: Any,
    horizon: int,
    found: Any,
    config: Config,
    plan: Plan,
    directory: Path,
    interrupt: Interrupt,
) -> int:
    """Trains to the budget, a signal, or until nothing is finite, and writes the run's files.

    Args:
      env: what is trained on.
      learner: how.
      horizon: the time limit of an episode in steps.
      found: the checkpoint from which the run goes on, if any.
      config: the settings of the run.
      plan: what is said of it beforehand.
      directory: where the files go.
      interrupt: what listens to signals.

    Returns:
      The exit status, see ``main``.
    """
    with _collection_paused():
        from mjx_reinforce.reports.curves import load_libraries
        from mjx_reinforce.runs.display import Display, print_summary
        from mjx_reinforce.runs.nonfinite import HOPELESS

    with Display() as display:
        interrupt.on_exit(display.console.show_cursor)
        display.say(plan.text)
        with display.compiling(plan.compiling):
            session, compile_seconds = _compile(env, learner, horizon, config, directory, display)
        # Not before: a run killed while it compiles leaves nothing that would refuse the next.
        interrupt.defer(display.say)
        _begin(session, horizon, found)
        display.start(compile_seconds)
        threading.Thread(target=load_libraries, daemon=True).start()
        interrupted = _loop(session, interrupt, evaluated=found is not None)
    if not session.saved:
        session.save()
    summary = _finish(session, learner.engine.name, compile_seconds, interrupted)
    print_summary(display.console, summary, directory)
    if session.record.hopeless():
        display.say(HOPELESS, "red")
        return 1
    return 128 + interrupted if interrupted else 0


def _compile(
    env: Any, learner: Any, horizon: int, config: Config, directory: Path, display: Any
) -> tuple[Any, float]:
    """Returns a run before its first update, and how long it took to compile, in seconds."""
    with _collection_paused():
        from mjx_reinforce.runs.best import first_best
        from mjx_reinforce.runs.build import policy_settings
        from mjx_reinforce.runs.log import RunLog
        from mjx_reinforce.runs.record import Record
        from mjx_reinforce.runs.session import Session
        from mjx_reinforce.runs.state import compile_programs, first_state

    started = time.perf_counter()
    with _collection_paused():
        state = first_state(learner, config)
        programs = compile_programs(env, learner, horizon, config, state)
    seconds = time.perf_counter() - started
    record = Record(config, getattr(env, "reward_threshold", None))
    best, policy = first_best(state.train_states), policy_settings(env, config)
    session = Session(config, policy, programs, record, RunLog(directory), display, state, best)
    return session, seconds


def _begin(session: Any, horizon: int, found: Any) -> None:
    """Writes the first files, or takes the run and its files back to where it goes on."""
    config, log = session.config, session.log
    if config.resume is None:
        settings = dataclasses.asdict(config) | {"horizon": horizon, "output": str(log.directory)}
        del settings["resume"]
        log.begin(settings)
        return
    budget = {name: getattr(config, name) for name in resume.BUDGETS}
    log.resume(resume.read_record(config.resume), budget, found)
    if found is not None:
        session.restore(found)
    session.display.say(f"going on after {session.record.updates.max()} updates")


def _loop(session: Any, interrupt: Interrupt, *, evaluated: bool) -> int | None:
    """Trains until the budget is used or nothing is finite, or a signal came; returns its number.

    Args:
      session: the run.
      interrupt: what listens to signals.
      evaluated: whether the present policies have been.
    """
    if not evaluated:
        session.evaluate()
    while not (session.record.finished() or session.record.hopeless()):
        if interrupt.number is not None:
            return interrupt.number
        session.advance()
        session.evaluate()
        session.save_if_due()
    return None


def _finish(
    session: Any, engine: str, compile_seconds: float, interrupted: int | None
) -> dict[str, Any]:
    """Writes the last files; returns the contents of summary.json."""
    from mjx_reinforce.reports.curves import draw_learning_curve

    config, record = session.config, session.record
    # A run that was interrupted is to end soon, and is tested when it has been resumed.
    test = {} if interrupted else session.test()
    run_seconds = session.seconds()
    summary = {
        "status": "interrupted" if interrupted else "finished",
        **record.summary(engine, compile_seconds, run_seconds),
        "best_updates": session.best.num_updates.tolist(),
        **test,
    }
    history, training = record.history(), record.training()
    axis = "episodes" if config.env_steps is None else "env_steps"
    picture = draw_learning_curve(history, training, config.env, record.threshold, axis)
    session.save_policies()
    session.log.finish(training, picture, summary)
    return summary


@contextlib.contextmanager
def _collection_paused() -> Iterator[None]:
    """Stops the garbage collector in a block that makes many objects and no garbage.

    Imports and tracing are such: it saves a second in eight. The objects of a block that
    succeeds are never looked at again.
    """
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
        gc.freeze()
    finally:
        if enabled:
            gc.enable()


if __name__ == "__main__":
    main()
