"""Signs of life: as often as asked, and none after the end."""

import threading
import time

import pytest

from mjx_reinforce.console.streams import heartbeat


def test_it_says_what_goes_on():
    said = []
    with heartbeat(said.append, "packing", interval=0.02):
        deadline = time.monotonic() + 10
        while len(said) < 2 and time.monotonic() < deadline:
            time.sleep(0.02)
    assert said[:2] == ["still packing, 0 s"] * 2


def test_it_ends_with_its_block_also_by_an_error():
    said, threads = [], threading.active_count()

    def fail():
        with heartbeat(said.append, interval=0.01):
            raise KeyError

    with pytest.raises(KeyError):
        fail()
    assert threading.active_count() == threads
    told = len(said)
    time.sleep(0.05)
    assert len(said) == told


def test_nothing_is_said_of_what_is_quick():
    said = []
    with heartbeat(said.append, interval=60.0):
        pass
    assert said == []
