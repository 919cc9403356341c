"""``python -m mjx_reinforce.train`` trains many seeds at once and reports over them."""

import signal

if __name__ == "__main__":  # Ctrl-C ends the imports below without a traceback
    signal.signal(signal.SIGINT, signal.SIG_DFL)

import contextlib
from typing import TYPE_CHECKING

from mjx_reinforce.runs.command_line import parse, train_to_the_end

if TYPE_CHECKING:
    from mjx_reinforce.runs.perform import Outcome


def main() -> None:
    """Reads the command line, trains, and exits as ``train_to_the_end`` says."""
    train_to_the_end(parse, _end)


def _end(outcome: "Outcome") -> None:
    """Says what a run learned."""
    from mjx_reinforce.runs.display import print_summary

    display, summary = outcome.display, outcome.summary
    assert outcome.directory is not None
    with contextlib.suppress(OSError):  # as ``Display.say``
        print_summary(display.console, summary, outcome.directory)
    if summary["status"] == "stopped":
        display.say(f"stopped: {summary['reason']}", "red")


if __name__ == "__main__":
    main()
