"""Ctrl-C, SIGTERM, and SIGHUP, which is the end of the terminal or of ssh."""

import contextlib
import functools
import os
import signal
import socket
import sys
import threading
from collections.abc import Callable, Iterable
from typing import Any, NoReturn


class Interrupt:
    """Ends the process at Ctrl-C, SIGTERM or SIGHUP, in one line; after ``defer`` it first asks.

    SIGHUP stays ignored where it was, as ``nohup`` leaves it.

    It listens inside a ``with`` block, in a thread of its own: Python runs signal handlers in the
    main thread only, which may be inside a compiler for minutes. The process ends with
    ``os._exit``, which waits for no other thread, with the status that shells give: 128 plus the
    signal's number. Once a signal has asked, later ones are ignored behind the block, where the
    process only ends.
    """

    def __init__(self):
        #: Number of the signal that asks the run to stop, or None so far.
        self.number: int | None = None
        self._say: Callable[[str], None] | None = None
        self._actions: list[Callable[[], Any]] = []
        self._screen_actions: list[Callable[[], Any]] = [sys.stdout.flush, sys.stderr.flush]

    def __enter__(self) -> "Interrupt":
        """Starts listening, until ``__exit__``."""
        # Python's own C handler, which runs at once in whatever thread, writes a signal's number
        # into the socket. It must not wait there: the reader may be what it has interrupted.
        self._receiver, self._sender = socket.socketpair()
        self._sender.setblocking(False)
        self._descriptor = signal.set_wakeup_fd(self._sender.fileno(), warn_on_full_buffer=False)
        signals = [signal.SIGINT, signal.SIGTERM]
        if signal.getsignal(signal.SIGHUP) != signal.SIG_IGN:
            signals.append(signal.SIGHUP)
        self._handlers = {number: signal.signal(number, _nothing) for number in signals}
        _start_thread(self._listen)
        return self

    def __exit__(self, *_: object) -> None:
        """Stops listening; signals do what they did before, or nothing once one has asked."""
        for number, handler in self._handlers.items():
            # Python's handlers would change the exit status that the first signal asked for.
            if self.number is not None:
                handler = signal.SIG_IGN
            signal.signal(number, handler)
        signal.set_wakeup_fd(self._descriptor)
        # The thread reads the end of the stream, and ends.
        self._sender.close()

    def heard(self) -> bool:
        """Returns whether a signal asks the run to stop."""
        return self.number is not None

    def deferred(self) -> bool:
        """Returns whether ``defer`` was called."""
        return self._say is not None

    def on_exit(self, action: Callable[[], Any]) -> None:
        """Adds what is done before a signal ends the process, however long that takes.

        Its errors are not shown.
        """
        self._actions.append(action)

    def restore_screen(self, action: Callable[[], Any]) -> None:
        """Adds what is tried, for a second at most, before a signal ends the process."""
        self._screen_actions.insert(0, action)

    def defer(self, say: Callable[[str], None]) -> None:
        """From now on the first signal only sets ``number``; the second ends the process.

        A second SIGHUP does not.

        Args:
          say: shows a line to the user.
        """
        self._say = say

    def leave(self, status: int, say: Callable[[], Any] | None = None) -> NoReturn:
        """Ends the process with a status, from any thread.

        Args:
          status: of the process.
          say: tells the user why, once the screen is as it was.
        """
        _try(self._actions)
        screen_actions = [*self._screen_actions]
        if say is not None:
            screen_actions.append(say)
        # Not for long: the screen may be a pipe that nobody reads.
        _start_thread(functools.partial(_try, screen_actions)).join(timeout=1)
        os._exit(status)

    def _listen(self) -> None:
        with self._receiver:
            while byte := self._receiver.recv(1):
                # Python writes other signals there, too, such as those of a user's own handlers.
                if byte[0] in self._handlers:
                    self._act(byte[0])

    def _act(self, number: int) -> None:
        """Does what a signal asks for: the end of the process, now or after the present block."""
        if self._say is None:
            self.leave(128 + number, _say_unbegun)
        if self.number is not None:
            # The shell and the kernel send one each when a terminal ends.
            if number == signal.SIGHUP:
                return
            self.leave(128 + number)
        self.number = number
        advice = "stopping after the current block of updates or test; Ctrl-C again stops at once"
        # In a thread of its own, for a screen that takes nothing must not keep this one from
        # hearing the second signal.
        _start_thread(functools.partial(self._say, advice))


def _try(actions: Iterable[Callable[[], Any]]) -> None:
    for action in actions:
        with contextlib.suppress(Exception):
            action()


def _start_thread(action: Callable[[], Any]) -> threading.Thread:
    thread = threading.Thread(target=action, daemon=True)
    thread.start()
    return thread


def _say_unbegun() -> None:
    """Says that there is no run; on a terminal below the bar, on whose line the cursor stands."""
    text = "stopped before training began; nothing was written"
    if sys.stderr.isatty():
        text = f"\n{text}"
    # Not to ``sys.stderr``, which rich replaces while it draws.
    print(text, file=sys.__stderr__, flush=True)


def _nothing(number: int, frame: object) -> None:
    """Handles a signal, so that Python tells the thread of it."""
