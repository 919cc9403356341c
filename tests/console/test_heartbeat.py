"""Signs of life: as often as asked, with what is known of the end, and none after it."""

import threading
import time

import pytest

from mjx_reinforce.console.heartbeat import heartbeat, to_screen


def lines(expected, wait=0.2):
    said = []
    with heartbeat(said.append, expected, what="packing", interval=0.02):
        deadline = time.monotonic() + 10
        while len(said) < 2 and time.monotonic() < deadline:
            time.sleep(wait / 10)
    return said


def test_it_says_what_goes_on_and_how_long_it_will():
    assert lines(1000.0)[0] == "still packing, 0 s; about 1000 s expected"


@pytest.mark.parametrize("expected", [None, 0.001])
def test_it_promises_nothing_that_is_unknown_or_over(expected):
    assert lines(expected)[-1] == "still packing, 0 s"


def test_it_ends_with_its_block_also_by_an_error():
    said, threads = [], threading.active_count()

    def fail():
        with heartbeat(said.append, None, interval=0.01):
            raise KeyError

    with pytest.raises(KeyError):
        fail()
    assert threading.active_count() == threads
    told = len(said)
    time.sleep(0.05)
    assert len(said) == told


def test_nothing_is_said_of_what_is_quick():
    said = []
    with heartbeat(said.append, None, interval=60.0):
        pass
    assert said == []


def test_a_line_that_the_screen_does_not_take_is_lost(monkeypatch, capsys):
    to_screen("shown")
    assert capsys.readouterr().out == "shown\n"

    def full(*_, **__):
        raise OSError("no space")

    monkeypatch.setattr("builtins.print", full)
    to_screen("lost")
