"""A block of updates: how many each run makes, what it is told, what is written where."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct

from mjx_reinforce.engine import counts
from mjx_reinforce.training import programs
from mjx_reinforce.training.state import Budget, RunState


@struct.dataclass
class Trained:
    """What an update changes, in place of a ``TrainState``."""

    env_steps: jax.Array
    num_updates: jax.Array
    progress: jax.Array


class Counter:
    """Learns nothing: an update plays as many env steps as the setting says."""

    def __init__(self, settings):
        self.each = settings["each"]

    def step_with(self, state, going, evaluation):
        steps = jnp.where(going, self.each, 0)
        metrics = {"env_steps": steps, "share": state.progress}
        state = state.replace(
            env_steps=counts.plus(state.env_steps, steps),
            num_updates=counts.plus(state.num_updates, going.astype(jnp.int32)),
        )
        return state, metrics, evaluation


@pytest.fixture
def advance(monkeypatch):
    """Runs a block of 4 updates of runs that play so many env steps an update, of a budget."""

    def run(each, budget, evaluate=False, make_evaluation=None, begun=0):
        monkeypatch.setattr(
            programs, "evaluation_metrics", lambda played, evaluation: {"seen": evaluation}
        )
        monkeypatch.setattr(programs, "step_with", Counter.step_with)
        num = len(each)
        none = jnp.stack([jnp.asarray(counts.from_int(begun))] * num)
        states = RunState(
            train_states=Trained(none, jnp.zeros_like(none), jnp.zeros(num)),
            eval_keys=jax.random.split(jax.random.key(0), num),
            settings={"each": jnp.array(each)},
        )
        made = jax.jit(programs.block_of_updates(Counter, 4, make_evaluation))
        after, result = made(states, budget, jnp.asarray(evaluate))
        return counts.to_int(after.train_states.num_updates).tolist(), result

    return run


def test_each_run_stops_after_the_update_that_reaches_its_budget(advance):
    updates, result = advance([10, 25, 100], Budget.of(40, None))
    assert updates == [4, 2, 1]
    active = [[1, 1, 1], [1, 1, 0], [1, 0, 0], [1, 0, 0]]
    np.testing.assert_array_equal(result.metrics["active"], active)
    np.testing.assert_array_equal(result.metrics["env_steps"], np.array(active) * [10, 25, 100])


def test_it_is_over_when_all_runs_are(advance):
    updates, result = advance([50, 60], Budget.of(100, None))
    assert (updates, int(result.num_updates)) == ([2, 2], 2)
    assert not result.metrics["env_steps"][2:].any()
    updates, result = advance([1, 1], Budget.of(None, 3))
    assert (updates, int(result.num_updates)) == ([3, 3], 3)
    assert int(advance([1, 1], Budget.of(None, None))[1].num_updates) == 4
    assert int(advance([1], Budget.of(5, None), begun=5)[1].num_updates) == 0


def test_runs_count_beyond_32_bits(advance):
    """A budget that ends beyond 2^32 env steps, and the share of it."""
    budget, begun = Budget.of(2**32 + 200, None), 2**32 - 50
    updates, result = advance([100, 1], budget, begun=begun)
    assert updates == [3, 4]
    np.testing.assert_allclose(result.metrics["share"][:, 0], 1, atol=1e-6)


def test_schedules_are_told_the_share_of_the_budget(advance):
    _, result = advance([10], Budget.of(40, None))
    np.testing.assert_allclose(result.metrics["share"][:, 0], [0, 0.25, 0.5, 0.75])
    _, result = advance([1], Budget.of(1000, 8))  # of two budgets, the one that ends first
    np.testing.assert_allclose(result.metrics["share"][:, 0], [0, 0.125, 0.25, 0.375])


def test_only_the_first_update_evaluates_and_only_where_asked(advance):
    def make_evaluation(key, active):
        del key
        return active.astype(jnp.int32) + 1

    _, result = advance(
        [1, 1], Budget.of(None, None), evaluate=[True, False], make_evaluation=make_evaluation
    )
    assert result.eval_metrics["seen"].tolist() == [2, 1]
    _, result = advance(
        [1, 1], Budget.of(None, None), evaluate=False, make_evaluation=make_evaluation
    )
    assert result.eval_metrics["seen"].tolist() == [1, 1]
    assert advance([1], Budget.of(None, None), evaluate=True)[1].eval_metrics == {}
