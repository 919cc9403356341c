"""A connection between two processes of one run: messages, and notice when the other ends.

The system closes the connections of a process that dies, however it died, so the other end reads
that at once. Where a whole host is gone, TCP's own signs of life stop within ``_SILENCE`` seconds.
"""

import contextlib
import queue
import socket
import struct
import threading
from collections.abc import Callable

#: Kinds of messages: data for a process that waits, a signal that asks to stop, a leave-taking, and
#: word of a third process that died.
DATA, STOP, BYE, DIED = b"D", b"S", b"B", b"X"
#: A message begins with its kind and its length in bytes.
_HEAD = struct.Struct("!cQ")
#: Seconds after which a host that does not answer is gone, and between two questions.
_SILENCE, _INTERVAL = 15, 3


class Link:
    """A connection whose messages a thread of its own reads."""

    def __init__(self, connection: socket.socket, heard: Callable[[bytes, bytes], None]):
        """Takes a connection.

        Args:
          connection: open.
          heard: is called in the thread with the kind and the content of what is no data, and with
            ``DIED`` and nothing where the other process ended without a leave-taking.
        """
        self._connection, self._heard = connection, heard
        self._inbox: queue.SimpleQueue[bytes | None] = queue.SimpleQueue()
        self._sending = threading.Lock()
        keep_alive(connection)

    def listen(self) -> None:
        """Begins to read."""
        threading.Thread(target=self._listen, daemon=True).start()

    def send(self, kind: bytes, content: bytes = b"") -> None:
        """Sends a message; to a process that ended it is lost, which the thread notices."""
        with self._sending, contextlib.suppress(OSError):
            send(self._connection, kind, content)

    def receive(self) -> bytes | None:
        """Waits for data; None where the other process took its leave."""
        return self._inbox.get()

    def _listen(self) -> None:
        while True:
            try:
                kind, content = receive(self._connection)
            except OSError:
                kind, content = DIED, b""
            if kind == DATA:
                self._inbox.put(content)
                continue
            self._heard(kind, content)
            if kind != STOP:
                self._inbox.put(None)
                return


def keep_alive(connection: socket.socket) -> None:
    """Has the system ask whether the other host is still there."""
    connection.settimeout(None)
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for name, value in (
        ("TCP_KEEPIDLE", _INTERVAL),
        ("TCP_KEEPINTVL", _INTERVAL),
        ("TCP_KEEPCNT", _SILENCE // _INTERVAL),
        ("TCP_USER_TIMEOUT", _SILENCE * 1000),
    ):
        if hasattr(socket, name):  # as on Linux
            connection.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)


def send(connection: socket.socket, kind: bytes, content: bytes) -> None:
    """Sends a message, or raises OSError."""
    connection.sendall(_HEAD.pack(kind, len(content)))
    connection.sendall(content)


def receive(connection: socket.socket) -> tuple[bytes, bytes]:
    """Returns the kind and the content of the next message; OSError where there is none."""
    kind, length = _HEAD.unpack(_receive_bytes(connection, _HEAD.size))
    return kind, _receive_bytes(connection, length)


def _receive_bytes(connection: socket.socket, length: int) -> bytes:
    parts = []
    while length:
        part = connection.recv(min(length, 2**20))
        if not part:
            raise ConnectionResetError("the other process has ended")
        parts.append(part)
        length -= len(part)
    return b"".join(parts)
