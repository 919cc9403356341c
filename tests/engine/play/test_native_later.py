"""Long machine code is compiled in a process of its own while XLA compiles; who calls it waits."""

import os
import subprocess
import sys
import threading
import time
from concurrent.futures import Future
from pathlib import Path

import jax
import jax.numpy as jnp
import native_items as items
import pytest
from places import PYTHONPATH

from mjx_reinforce.engine.cpu import machine, seam

pytestmark = pytest.mark.cpu
ACTIVE = [1, 0, 1]


@pytest.fixture(autouse=True)
def everything_is_long(monkeypatch, request):
    """And XLA has not met it: it takes a handler's name once."""
    text = f"; {request.node.name}\n{items.text()}"
    monkeypatch.setattr(items, "text", lambda lanes: text)
    monkeypatch.setattr(machine, "_CACHE", {})
    monkeypatch.setattr(machine, "_LONG_TEXT", len(text) - 1)


@pytest.fixture
def slow(monkeypatch):
    """Compiles once the event is set; an exception in the list is raised instead."""
    go_on, errors = threading.Event(), []
    compile_elsewhere = machine._compile_elsewhere

    def compile_later(text, target):
        assert go_on.wait(60)
        if errors:
            raise errors[0]
        return compile_elsewhere(text, target)

    monkeypatch.setattr(machine, "_compile_elsewhere", compile_later)
    return go_on, errors


def test_what_xla_compiled_meanwhile_waits_for_it(slow, tmp_path):
    go_on, _ = slow
    code = items.load(tmp_path)
    seam.register(code)
    play = jax.jit(lambda active: items.play(code, active)).lower(jnp.array(ACTIVE)).compile()
    assert not code.future_addresses.done()
    assert not list(tmp_path.iterdir())
    threading.Timer(0.2, go_on.set).start()
    began = time.monotonic()
    items.check(play(jnp.array(ACTIVE)), ACTIVE)
    assert time.monotonic() - began > 0.1
    assert code.compiled
    machine._CACHE.clear()
    assert not items.load(tmp_path).compiled  # it is on disk


def test_what_is_not_compiled_is_an_error_of_the_program(slow):
    go_on, errors = slow
    errors.append(RuntimeError("no memory is left"))
    code = items.load()
    seam.register(code)
    play = jax.jit(lambda active: items.play(code, active)).lower(jnp.array(ACTIVE)).compile()
    go_on.set()
    with pytest.raises(Exception, match=r"step was not compiled, .* vmap needs none"):
        jax.block_until_ready(play(jnp.array(ACTIVE)))
    with pytest.raises(RuntimeError, match="no memory is left"):
        _ = code.addresses


def test_what_failed_before_xla_asks_is_an_error_of_the_program(slow):
    go_on, errors = slow
    errors.append(RuntimeError("no memory is left"))
    go_on.set()
    code = items.load()
    assert code.future_addresses.exception(timeout=9)
    seam.register(code)
    with pytest.raises(Exception, match="step was not compiled"):
        jax.block_until_ready(jax.jit(lambda active: items.play(code, active))(jnp.array(ACTIVE)))


def test_a_text_that_is_no_ir_is_known_at_once():
    target = machine.this_machine()
    with pytest.raises(RuntimeError, match="expected"):
        machine.load_module("bad", lambda: 9999 * "no IR ", ("f",), target, None)


def test_both_processes_make_the_same_object():
    target = machine.this_machine()
    made = machine._compile_elsewhere(items.text(1), target)
    assert made == machine._compile(items.text(1), target)


def program(tmp_path, line):
    """Returns a program of one line of the shell."""
    path = tmp_path / "python"
    path.write_text(f"#!/bin/sh\n{line}\n")
    path.chmod(0o755)
    return str(path)


def test_where_no_other_process_starts_this_one_compiles(monkeypatch, tmp_path):
    monkeypatch.setattr(sys, "executable", program(tmp_path, "exit 3"))
    assert "handler" in items.load().addresses
    monkeypatch.setattr(machine, "_CACHE", {})
    monkeypatch.setattr(sys, "executable", str(tmp_path / "nothing"))
    assert "handler" in items.load().addresses
    monkeypatch.setattr(machine, "_CACHE", {})
    monkeypatch.setattr(sys, "executable", "")
    code = items.load()
    assert isinstance(code.future_addresses, Future)
    assert code.future_addresses.done()


def test_a_process_that_is_killed_is_an_error(monkeypatch, tmp_path):
    """A second try would need as much memory."""
    monkeypatch.setattr(sys, "executable", program(tmp_path, "kill -9 $$"))
    with pytest.raises(RuntimeError, match="LLVM was stopped by signal 9"):
        _ = items.load().addresses


#: XLA goes on in a thread of its own, and JAX waits for it when Python ends.
WAITING = """
import jax
import jax.numpy as jnp
machine._LONG_TEXT = 10**9
play = jax.jit(lambda x, active: items.play(code, active + jnp.int32(0 * (x @ x @ x)[0, 0])))
play(jnp.ones((2000, 2000)), jnp.array([1, 0, 1]))
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("end", "status"),
    [("sys.exit(7)", 7), ("os.kill(os.getpid(), signal.SIGINT)", -2), (WAITING, 0)],
    ids=["exit", "interrupt", "waiting program"],
)
def test_who_ends_does_not_wait(end, status, tmp_path):
    """And leaves no process behind."""
    script = f"""
import os, signal, sys
import native_items as items
from mjx_reinforce.engine.cpu import machine
text = "; played by no other test\\n" + items.text()
items.text = lambda lanes: text
machine._LONG_TEXT = 0
signal.signal(signal.SIGINT, signal.default_int_handler)  # in the background it is ignored
machine.sys.executable = {program(tmp_path, f"echo $$ > {tmp_path}/number; exec sleep 60")!r}
code = items.load()
while not os.path.exists({str(tmp_path / "number")!r}): pass
{end}
"""
    began = time.monotonic()
    done = subprocess.run(
        [sys.executable, "-c", script],
        env=os.environ | {"PYTHONPATH": PYTHONPATH},
        capture_output=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == status, done.stderr
    assert time.monotonic() - began < 50
    number = int((tmp_path / "number").read_text())
    deadline = time.monotonic() + 10
    while (
        Path(f"/proc/{number}").exists() and "sleep" in Path(f"/proc/{number}/cmdline").read_text()
    ):
        assert time.monotonic() < deadline
        time.sleep(0.05)
