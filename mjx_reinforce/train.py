"""``python -m mjx_reinforce.train`` trains many seeds at once and reports over them."""

import signal

if __name__ == "__main__":  # Ctrl-C ends the imports below without a traceback
    signal.signal(signal.SIGINT, signal.SIG_DFL)

import contextlib
import gc
import sys
from collections.abc import Iterator, Sequence

from mjx_reinforce.console.interrupt import Interrupt
from mjx_reinforce.console.streams import accept_everything, silence_alarms, to_screen
from mjx_reinforce.runs.begin import Begun, begun
from mjx_reinforce.runs.command_line import parse, refuse, refuse_full, start
from mjx_reinforce.settings.config import code_flags


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
            config, default = parse(arguments), start(arguments, "train")[0]
            run = held.enter_context(begun(config, default, interrupt, to_screen))
    except ValueError as error:
        refuse(str(error))
    except (ImportError, MemoryError) as error:
        remedy = "see pip check, and ulimit -v where memory is short"
        refuse(f"cannot load what this package needs ({error}); {remedy}")
    try:
        return train(run, interrupt)
    except (RuntimeError, OSError) as error:
        assert run.directory is not None
        resumed = f"go on with --resume {run.directory}{code_flags(vars(config))}"
        again = resumed if (run.directory / "config.json").exists() else "try again"
        refuse_full(error, "this run", "this run", "--num-seeds", again)


def train(run: Begun, interrupt: Interrupt) -> int:
    """Trains, and says what was learned; see ``runs.run.train_run``.

    Returns:
      The exit status, see ``main``.
    """
    with _collection_paused():
        from mjx_reinforce.runs.display import Display, print_summary
        from mjx_reinforce.runs.run import train_run

    display = Display()
    _, summary = train_run(run, display, interrupt, compiling=_collection_paused())
    with contextlib.suppress(OSError):  # as ``Display.say``
        assert run.directory is not None
        print_summary(display.console, summary, run.directory)
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
