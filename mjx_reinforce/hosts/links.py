"""A connection between two processes of one run: how it is made, messages, and notice of an end.

The system closes the connections of a process that dies, however it died, so the other end reads
that at once. Where a whole host is gone, TCP's own signs of life stop within ``_SILENCE`` seconds.
"""

import contextlib
import errno
import json
import queue
import socket
import struct
import threading
from collections.abc import Callable
from typing import Any

#: Kinds of messages: data for a process that waits, a signal that asks to stop, a leave-taking, and
#: word of a third process that died.
DATA, STOP, BYE, DIED = b"D", b"S", b"B", b"X"
#: A message begins with its kind and its length in bytes.
_HEAD = struct.Struct("!cQ")
#: Seconds after which a host that does not answer is gone, and between two questions.
_SILENCE, _INTERVAL = 15, 3
#: Seconds to wait for a greeting.
GREETING = 10.0


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


def address(coordinator: str) -> tuple[str, int]:
    """Returns host and port; raises ValueError if they are none."""
    host, _, port = coordinator.rpartition(":")
    if not host or not port.isascii() or not port.isdigit() or not 0 < int(port) < 2**16:
        raise ValueError(f"--coordinator must be HOST:PORT, such as node1:4321, got {coordinator}")
    return host.strip("[]"), int(port)


def listener(coordinator: str) -> socket.socket:
    """Returns what listens at the address, or at that port on all of this host's addresses."""
    host, port = address(coordinator)
    try:
        family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
        try:
            return socket.create_server((host, port), family=family)
        except OSError as error:
            if error.errno != errno.EADDRNOTAVAIL:  # the name may be that of a gateway
                raise
            return socket.create_server(("", port))
    except OSError as error:
        raise ValueError(
            f"cannot listen at --coordinator {coordinator} ({error.strerror or error}); it must be "
            "the host of process 0, and a port that is free there"
        ) from error


def greeting(connection: socket.socket) -> dict[str, Any] | None:
    """Returns what a process says of itself; None if it is none of ours."""
    connection.settimeout(GREETING)
    with contextlib.suppress(OSError, ValueError):
        said = json.loads(receive(connection)[1])
        if isinstance(said, dict) and said.keys() == {"index", "count", "common", "name"}:
            return said
    return None
