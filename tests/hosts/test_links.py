"""A connection between two processes: messages arrive whole and in order, and an end is noticed."""

import queue
import socket
import threading

import pytest

from mjx_reinforce.hosts import links
from mjx_reinforce.hosts.links import BYE, DATA, DIED, STOP, Link

SECONDS = 10


@pytest.fixture
def ends():
    """Two ends of a connection."""
    with socket.create_server(("localhost", 0)) as server:
        near = socket.create_connection(server.getsockname())
        far, _ = server.accept()
    with near, far:
        near.settimeout(SECONDS)
        yield near, far


@pytest.fixture
def link(ends):
    """A link at the first end that listens, what it heard, and the other end."""
    heard = queue.SimpleQueue()
    link = Link(ends[0], lambda *message: heard.put(message))
    link.listen()
    return link, heard, ends[1]


@pytest.mark.parametrize("content", [b"", b"x", bytes(range(256)) * 20_000])
def test_a_message_is_received_as_it_was_sent(ends, content):
    if len(content) > 2**16:  # more than the system holds for a reader who is not there yet
        threading.Thread(target=links.send, args=(ends[0], DATA, content), daemon=True).start()
    else:
        links.send(ends[0], DATA, content)
    links.send(ends[1], STOP, b"other way")
    assert links.receive(ends[1]) == (DATA, content)
    assert links.receive(ends[0]) == (STOP, b"other way")


def test_data_waits_in_order(link):
    mine, heard, other = link
    for part in (b"one", b"two"):
        links.send(other, DATA, part)
    assert [mine.receive(), mine.receive()] == [b"one", b"two"]
    assert heard.empty()


def test_a_signal_is_heard_and_data_goes_on(link):
    mine, heard, other = link
    links.send(other, STOP, b"15")
    links.send(other, DATA, b"still here")
    assert heard.get(timeout=SECONDS) == (STOP, b"15")
    assert mine.receive() == b"still here"


def test_a_leave_taking_ends_the_data(link):
    mine, heard, other = link
    links.send(other, DATA, b"last")
    links.send(other, BYE, b"")
    assert [mine.receive(), mine.receive()] == [b"last", None]
    assert heard.get(timeout=SECONDS) == (BYE, b"")


@pytest.mark.parametrize("sent", [b"", b"D\0\0", links._HEAD.pack(DATA, 9) + b"half"])
def test_a_death_is_heard_also_within_a_message(link, sent):
    mine, heard, other = link
    other.sendall(sent)
    other.close()
    assert heard.get(timeout=SECONDS) == (DIED, b"")
    assert mine.receive() is None


def test_what_is_sent_to_a_dead_process_is_lost_without_an_error(link):
    mine, heard, other = link
    other.close()
    assert heard.get(timeout=SECONDS) == (DIED, b"")
    for _ in range(3):
        mine.send(DATA, b"nobody")


def test_the_system_asks_whether_the_other_host_is_there(ends):
    links.keep_alive(ends[0])
    assert ends[0].getsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE)
    assert ends[0].gettimeout() is None
