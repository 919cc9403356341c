"""``python -m mjx_reinforce.train`` trains many seeds at once and reports over them."""

import signal

if __name__ == "__main__":  # Ctrl-C ends the imports below without a traceback
    signal.signal(signal.SIGINT, signal.SIG_DFL)

import contextlib
import dataclasses
import gc
import sys
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from mjx_reinforce import envs
from mjx_reinforce.console.interrupt import Interrupt
from mjx_reinforce.console.jax_setup import configure_jax
from mjx_reinforce.console.streams import accept_everything, heartbeat, silence_alarms, to_screen
from mjx_reinforce.runs.command_line import parse, refuse, refuse_full, start
from mjx_reinforce.runs.directory import (
    check_writable,
    choose_directory,
    make_directory,
    remove_empty,
)
from mjx_reinforce.runs.plan import make_plan
from mjx_reinforce.runs.sinks import check_installed
from mjx_reinforce.settings.config import MAX_COUNT, Config, check
from mjx_reinforce.settings.memory import check_memory
from mjx_reinforce.settings.own_code import code_flags
from mjx_reinforce.training import resume

if TYPE_CHECKING:
    from mjx_reinforce.engine.base import Environment
    from mjx_reinforce.store.ready import Ready
    from mjx_reinforce.training.checkpoint import Checkpoint


def main() -> None:
    """Reads the command line, trains, and exits.

    The status is 0 when done, 1 if files cannot be written or nothing is finite any more, 2 for bad
    input, 130 after Ctrl-C and 143 after SIGTERM.
    """
    accept_everything()
    silence_alarms()
    with Interrupt() as interrupt, contextlib.ExitStack() as held:
        status = _main(sys.argv[1:], interrupt, held)
    sys.exit(status)


def _main(arguments: Sequence[str], interrupt: Interrupt, held: contextlib.ExitStack) -> int:
    """Returns the exit status of a command line; ``held`` keeps what is released at its end."""
    from mjx_reinforce.runs.directory import locked

    made: Sequence[Path] = ()
    try:
        with _collection_paused():
            config = parse(arguments)
            check(config)
            check_memory(config)
            check_installed(config)
            directory, new = _directory(config)
            held.enter_context(locked(directory))  # a folder in which another trains stays
            made = new
            interrupt.on_exit(lambda: remove_empty(made))
            # A module of the user's is imported before JAX starts, which it may set up.
            env = None if envs.is_ours(config.env) else envs.make_set(config.env, config.env_set)
            configure_jax()
            with heartbeat(to_screen, "writing the simulation out"):
                default = start(arguments, "train")[0]
                ready, found = _start(env, config, default)
            if config.init_from is not None and found is None:
                from mjx_reinforce.training.state import last_actors

                last_actors(config, ready.policy)  # refused before anything is compiled
            plan = make_plan(ready, config)
    except ValueError as error:
        refuse(str(error), made)
    except (ImportError, MemoryError) as error:
        remedy = "see pip check, and ulimit -v where memory is short"
        refuse(f"cannot load what this package needs ({error}); {remedy}", made)
    try:
        return train(ready, found, config, plan, directory, interrupt)
    except (RuntimeError, OSError) as error:
        begun = (directory / "config.json").exists()
        resumed = f"go on with --resume {directory}{code_flags(vars(config))}"
        again = resumed if begun else "try again"
        refuse_full(error, "this run", "this run", "--num-seeds", again, made)


def _directory(config: Config) -> tuple[Path, Sequence[Path]]:
    """Returns the run directory, and the folders that were made for it."""
    if config.resume is not None:
        check_writable(config.resume)
        return config.resume, ()
    directory = choose_directory(config.output, config.env)
    return directory, make_directory(directory)


def _start(
    env: "Environment | None", config: Config, default: Config
) -> "tuple[Ready, Checkpoint | None]":
    """Returns a run that is ready, and the checkpoint from which it goes on, if any.

    Args:
      env: the environment, if it is the user's own.
      config: the settings.
      default: those that hold where the user gave none.

    Raises:
      ValueError: the settings do not fit the environment, or the run cannot go on here.
    """
    from mjx_reinforce.store.provenance import provenance
    from mjx_reinforce.store.ready import get_ready
    from mjx_reinforce.training.state import shape_of_all

    ready = get_ready(config, default, env)
    if config.resume is None:
        return ready, None
    recorded = resume.read_record(config.resume)
    resume.check_same_program(config.resume, recorded, provenance())
    like = shape_of_all(ready.programs.like, config.num_seeds)
    if config.minutes is not None:  # more than any checkpoint has used
        config = dataclasses.replace(config, env_steps=MAX_COUNT)
    found = resume.newest_checkpoint(like, config, print)
    if found is None and config.minutes is not None:
        raise ValueError(
            f"{config.resume} has no checkpoint to go on from for {config.minutes:g} min; leave "
            "--minutes out to train it again, or start another run"
        )
    return ready, found


def train(
    ready: "Ready",
    found: "Checkpoint | None",
    config: Config,
    plan: str,
    directory: Path,
    interrupt: Interrupt,
) -> int:
    """Trains to the budget, a signal, or until nothing is finite, and writes the run's files.

    Args:
      ready: the run.
      found: the checkpoint from which the run goes on, if any.
      config: the settings of the run.
      plan: what is said of it beforehand.
      directory: where the files go.
      interrupt: what listens to signals.

    Returns:
      The exit status, see ``main``.
    """
    with _collection_paused():
        from mjx_reinforce.runs.display import Display, print_summary

    with Display() as display:
        interrupt.restore_screen(display.console.show_cursor)
        display.say(plan)
        with display.compiling(), _collection_paused():
            from mjx_reinforce.reports.curves import load_libraries
            from mjx_reinforce.runs.observers import RunFiles, RunLog, Screen
            from mjx_reinforce.runs.run import compile_driver, draw, summary_of

            loading = threading.Thread(target=load_libraries, daemon=True)
            driver, seconds = compile_driver(ready, config, found, display.say, loading.start)
        # Not before: a run killed while it compiles leaves nothing that would refuse the next.
        interrupt.defer(display.say)
        files = RunFiles(RunLog(directory), ready.policy, display.say)
        files.begin(driver, found)
        driver.observers += [files, Screen(display)]
        display.start(seconds)
        driver.drive(lambda: interrupt.number is not None)
    files.end(driver)
    # A signal after that changes nothing: what is left takes a second or two.
    test = driver.test(lambda: interrupt.number is not None)
    summary = summary_of(driver, ready.engine, seconds, test)
    files.finish(driver, draw(driver), summary)
    with contextlib.suppress(OSError):  # as ``Display.say``
        print_summary(display.console, summary, directory)
    if summary["status"] == "stopped":
        display.say(f"stopped: {summary['reason']}", "red")
        return 1
    return 0 if interrupt.number is None or test else 128 + interrupt.number


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
