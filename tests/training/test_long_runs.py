"""Counts beyond 2^31 and 2^32: env steps of long runs, and updates."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from toys import Survive

import mjx_reinforce as mr
from mjx_reinforce.engine import counts
from mjx_reinforce.engine.base import Trajectory
from mjx_reinforce.learning import normalize, schedules, value
from mjx_reinforce.learning.updates import Clock
from mjx_reinforce.settings.config import Config, check
from mjx_reinforce.training.driver import RunDriver

SMALL = ["--env", "Survive-v0", "--num-seeds", "1", "--num-episodes", "4", "--eval-episodes", "2"]
SMALL += ["--hidden-sizes", "2", "--horizon", "8", "--engine", "vmap", "--eval-every", "1"]


@pytest.mark.parametrize("length", [10**6, 2**31, 900_000_000_000, 2**53])
def test_a_schedule_may_be_of_any_length_that_is_counted(length):
    """One beyond 2^31 ended in an OverflowError."""
    for used in (0, length // 3, length - length // 4, length, 2 * length):
        clock = Clock(jnp.zeros(()), counts.as_float(counts.from_int(min(used, 2**53))))
        expected = min(min(used, 2**53) / length, 1.0)
        for env_steps in (length, float(length), jnp.float32(length)):
            assert schedules.share(clock, env_steps) == pytest.approx(expected, rel=1e-6)


@pytest.mark.slow
def test_a_step_counts_over_the_end_of_an_int32():
    """The learning rate of a run of 2^33 steps falls with them."""
    rate = schedules.decay_rate(0.0, 2**33)
    learner = mr.reinforce(Survive(), optimizer=rate, num_episodes=4, horizon=8, engine="vmap")
    state = learner.init(jax.random.key(0))
    for before in (2**31 - 5, 2**32 - 5):
        words = jnp.asarray(counts.from_int(before))
        after, metrics = mr.train_step(
            learner, dataclasses.replace(state, env_steps=words, num_updates=words)
        )
        assert counts.to_int(after.env_steps) == before + int(metrics["env_steps"]) > before + 5
        assert counts.to_int(after.num_updates) == before + 1


@pytest.mark.slow
def test_a_run_passes_2_to_31_and_goes_on_there(run, tmp_path, monkeypatch):
    """Its files, its budget and its checkpoints count on, with schedules of 10^12 steps."""
    begun, begin = 2**31 - 12, RunDriver.__init__

    def late(self, *given):
        begin(self, *given)
        words = counts.from_int(begun)[None]
        states = self.states
        train = dataclasses.replace(states.train_states, env_steps=words)
        self.slots.restore(dataclasses.replace(states, train_states=train))
        self.states = self._before = self.slots.states()
        self.record.env_steps += begun

    monkeypatch.setattr(RunDriver, "__init__", late)
    budgets = ["--env-steps", "1e12", "--decay-steps", "9e11", "--final-std", "0.1"]
    budgets += ["--checkpoint-every", "1", "--output", "out"]
    assert run(*SMALL, *budgets, "--max-updates", 3) == 0
    monkeypatch.undo()
    first = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert run("--resume", "out", "--max-updates", 6) == 0
    last = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert last["env_steps"][0] > first["env_steps"][0] > 2**31
    rows = (tmp_path / "out" / "metrics.csv").read_text().splitlines()
    column = rows[0].split(",").index("env_steps")
    counted = [int(row.split(",")[column]) for row in rows[1:]]
    assert counted == sorted(counted)
    assert counted[0] == begun
    assert counted[-1] == last["env_steps"][0]
    with np.load(tmp_path / "out" / "returns.npz") as returns:
        assert any(returns[name].max() == counted[-1] for name in returns.files)


@pytest.mark.slow
@pytest.mark.parametrize("length", [2**31, 10**12])
def test_the_scale_may_be_of_as_many_steps_as_a_run(length):
    """A whole number beyond 2^31 ended in an OverflowError, and --normalize-steps took none."""
    check(Config(normalize_steps=length))
    for learner in (
        mr.reinforce(Survive(), num_episodes=4, horizon=8, engine="vmap", normalize_steps=length),
        mr.ars(Survive(), num_directions=2, horizon=8, engine="vmap", normalize_steps=length),
    ):
        state = learner.init(jax.random.key(0))
        for _ in range(2):
            before = float(state.actor.normalizer.count)
            state, metrics = mr.train_step(learner, state)
            after = float(state.actor.normalizer.count)
            assert after - before == int(metrics["env_steps"]) > 0


def test_counts_of_an_update_are_less_than_2_to_31():
    """From Python, too, where they ended in errors of JAX and XLA."""
    learner = mr.reinforce(Survive(), num_episodes=4, horizon=8, engine="vmap")
    actor = learner.init(jax.random.key(0)).actor
    for episodes, horizon in ((10**12, 8), (4, 10**12)):
        with pytest.raises(ValueError, match=r"must be less than 2\^31, got 1000000000000"):
            mr.evaluate(
                *(Survive(), learner, actor, jax.random.key(1)),
                num_episodes=episodes,
                horizon=horizon,
            )
    with pytest.raises(ValueError, match=r"num_directions must be less than 2\^31"):
        mr.ars(Survive(), num_directions=2**31, horizon=8)
    with pytest.raises(ValueError, match="an update may have 4,294,967,296 env steps"):
        mr.ars(Survive(), num_directions=2**15, horizon=2**16)


@pytest.mark.parametrize("batch", [7, 9])
def test_statistics_of_more_observations_than_a_float_counts_stay(batch):
    """A count of 2^27 is rounded to 16: seven more are none, nine are sixteen.

    What their squares are rounded by is another share: the variance went from 0.6 to 0.63.
    """
    first = normalize.Normalizer(
        count=jnp.array(2.0**27), mean=jnp.zeros(1), m2=jnp.array([0.6 * 2**27])
    )
    x = np.resize([-1.0, 1.0], (batch, 1, 1)) * np.sqrt(0.6)
    x[-1] = 0 if batch % 2 else x[-1]
    x *= np.sqrt(0.6 / np.mean(x**2))
    mask = jnp.ones((batch, 1), bool)

    def body(_, statistics):
        return normalize.update(statistics, jnp.float32(x), mask, jnp.inf)

    last = jax.jit(lambda s: jax.lax.fori_loop(0, 2**18, body, s))(first)
    assert float(last.m2[0] / last.count) == pytest.approx(0.6, rel=1e-3)
    assert abs(float(last.mean[0])) < 1e-6


def test_a_baseline_keeps_its_moments_beyond_2_to_31_updates():
    """The number of updates was negative there, and each update's returns all that counted."""
    estimator = value.value_baseline(horizon=4, num_fits=1, batch_size=2)
    critic = estimator.init(jax.random.key(0), 1)
    critic = critic._replace(
        updates=jnp.int32(2**31 - 1), mean=jnp.float32(10), variance=jnp.ones(())
    )
    zeros = jnp.zeros((4, 2))
    played = Trajectory(
        observation=zeros[..., None],
        action=zeros[..., None],
        reward=zeros,
        mask=jnp.ones((4, 2), bool),
        nonfinite=jnp.zeros(2, bool),
        simulated=jnp.int32(8),
    )
    for expected in (9.0, 8.1, 7.29):
        _, critic, _ = estimator.update(critic, played)
        assert float(critic.mean) == pytest.approx(expected, rel=1e-5)
