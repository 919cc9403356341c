"""``python -m mjx_reinforce.train`` trains many seeds at once and reports over them."""

import signal

if __name__ == "__main__":  # Ctrl-C ends the imports below without a traceback
    signal.signal(signal.SIGINT, signal.SIG_DFL)

import contextlib
import dataclasses
import gc
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from mjx_reinforce import envs
from mjx_reinforce.console.interrupt import Interrupt
from mjx_reinforce.console.jax_setup import configure_jax
from mjx_reinforce.console.streams import accept_everything, heartbeat, silence_alarms, to_screen
from mjx_reinforce.runs.command_line import parse, refuse, refuse_full, start
from mjx_reinforce.runs.directory import own_directory
from mjx_reinforce.runs.plan import check_memory, make_plan
from mjx_reinforce.runs.sinks import check_installed
from mjx_reinforce.settings.config import MAX_COUNT, Config, check, code_flags
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
    try:
        with _collection_paused():
            config = parse(arguments)
            check(config)
            check_memory(config)
            check_installed(config)
            directory = held.enter_context(own_directory(config, config.resume, interrupt))
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
        refuse(str(error))
    except (ImportError, MemoryError) as error:
        remedy = "see pip check, and ulimit -v where memory is short"
        refuse(f"cannot load what this package needs ({error}); {remedy}")
    try:
        return train(ready, found, config, plan, directory, interrupt)
    except (RuntimeError, OSError) as error:
        begun = (directory / "config.json").exists()
        resumed = f"go on with --resume {directory}{code_flags(vars(config))}"
        again = resumed if begun else "try again"
        refuse_full(error, "this run", "this run", "--num-seeds", again)


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
    """Trains, and says what was learned; see ``runs.run.train_run``.

    Returns:
      The exit status, see ``main``.
    """
    with _collection_paused():
        from mjx_reinforce.runs.display import Display, print_summary
        from mjx_reinforce.runs.run import train_run

    display = Display()
    display.say(plan)
    _, summary = train_run(
        *(ready, config, display, directory, interrupt),
        found=found,
        compiling=_collection_paused(),
    )
    with contextlib.suppress(OSError):  # as ``Display.say``
        print_summary(display.console, summary, directory)
    if summary["status"] == "stopped":
        display.say(f"stopped: {summary['reason']}", "red")
        return 1
    return 0 if summary["status"] == "finished" else 128 + (interrupt.number or 0)


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
