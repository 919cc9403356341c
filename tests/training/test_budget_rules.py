"""How much of a budget is used, and when a checkpoint is due."""

import errno

import numpy as np
import pytest

from mjx_reinforce.settings.config import Config
from mjx_reinforce.training import checkpoint, progress


def test_the_budget_that_is_nearer_to_its_end_counts():
    steps, updates = np.array([[50, 200], [0, 0]]), np.array([[9, 1], [5, 0]])
    both = progress.used(Config(env_steps=100, max_updates=10), steps, updates)
    np.testing.assert_allclose(both, [[0.9, 2.0], [0.5, 0.0]])
    alone = progress.used(Config(env_steps=None, max_updates=10), steps, updates)
    np.testing.assert_allclose(alone, [[0.9, 0.1], [0.5, 0.0]])
    np.testing.assert_allclose(progress.used(Config(env_steps=100), steps, updates), steps / 100)


def test_a_checkpoint_is_due_after_so_many_updates():
    due = checkpoint.SaveDue(5)
    assert [due.is_due(n) for n in (0, 4, 5, 6)] == [False, False, True, True]
    due.saved(6)
    assert [due.is_due(n) for n in (6, 10, 11)] == [False, False, True]


def test_a_checkpoint_is_due_after_a_minute(monkeypatch):
    now = [100.0]
    monkeypatch.setattr(checkpoint.time, "perf_counter", lambda: now[0])
    due = checkpoint.SaveDue(None)
    now[0] += 59.0
    assert not due.is_due(10**9)
    now[0] += 1.0
    assert due.is_due(0)
    due.saved(0)
    assert not due.is_due(0)


@pytest.mark.parametrize(
    ("error", "said"),
    [(OSError(errno.ENOSPC, "No space left on device"), "No space"), (OSError("gone"), "gone")],
)
def test_the_first_failure_in_a_row_is_a_warning(error, said):
    heard, fails = [], [True, True, False, True]
    attempts = checkpoint.Attempts(heard.append)

    def write():
        if fails.pop(0):
            raise error

    written = [attempts.attempt("metrics.csv", write) for _ in range(4)]
    assert written == [False, False, True, False]
    assert len(heard) == 2
    assert heard[0].startswith(f"warning: cannot write metrics.csv ({said}")
