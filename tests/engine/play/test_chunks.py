"""Loops over time in chunks: how long they run, alone and vmapped over seeds."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_reinforce import Distribution
from mjx_reinforce.engine.play.episode import (
    CHUNK_STEPS,
    chunk_length,
    largest_divisor,
    play_chunks,
    while_any,
)

NOISY = Distribution(
    num_outputs=1,
    constants=(),
    noise=lambda key, shape: jax.random.uniform(key, (*shape, 1)),
    sample=lambda outputs, noise: outputs + noise,
    mode=lambda outputs: outputs,
    log_prob=lambda outputs, action: jnp.zeros(action.shape[:-1]),
    entropy=lambda outputs: jnp.zeros(outputs.shape[:-1]),
)
HORIZON = 3 * CHUNK_STEPS


class Playing(NamedTuple):
    """Episodes that live for so many steps; ``alive`` [N]."""

    lives: jax.Array
    steps: jax.Array
    alive: jax.Array


def play(noise, progress):
    """Records the noise of each step in which an episode was alive."""
    times = progress.steps[0] + jnp.arange(len(noise))
    alive = times[:, None] < progress.lives
    records = jnp.where(alive, noise[..., 0], 0.0)
    steps = progress.steps + len(noise)
    return Playing(progress.lives, steps, steps < progress.lives), records


def played(lives, seed=0):
    lives = jnp.asarray(lives)
    keys = jax.random.split(jax.random.key(seed), len(lives))
    begun = Playing(lives, jnp.zeros_like(lives), lives > 0)
    return play_chunks(play, NOISY, keys, begun, jnp.zeros((HORIZON, len(lives))))


def test_the_largest_divisor_and_a_chunk_divides_the_horizon():
    cases = (1000, 50, 50), (12, 5, 4), (7, 6, 1), (7, 7, 7), (7, 100, 7), (1, 1, 1)
    for number, at_most, expected in cases:
        assert largest_divisor(number, at_most) == expected
    assert [chunk_length(horizon) for horizon in (1000, 37, 53, 200)] == [50, 37, 1, 50]


@pytest.mark.parametrize(("lives", "chunks"), [([0, 0], 0), ([3, 50], 1), ([1, 51], 2), ([999], 3)])
def test_chunks_are_played_until_every_episode_is_over_or_the_time_is_up(lives, chunks):
    progress, records, simulated = played(lives)
    assert simulated == chunks * CHUNK_STEPS * len(lives)
    assert progress.steps.tolist() == [chunks * CHUNK_STEPS] * len(lives)
    for episode, life in enumerate(lives):
        np.testing.assert_array_equal(records[:, episode] != 0, np.arange(HORIZON) < life)


def test_each_step_has_noise_of_its_own():
    _, records, _ = played([HORIZON, HORIZON])
    assert len(np.unique(records)) == 2 * HORIZON


def test_vmapped_seeds_play_as_long_as_one_of_them_needs():
    """And what each plays is what it would have played alone."""
    lives = jnp.array([[3, 9], [60, 2]])
    together = jax.vmap(played)(lives)
    assert together[2].tolist() == [2 * CHUNK_STEPS * 2] * 2
    for seed in range(2):
        np.testing.assert_array_equal(together[1][seed], played(lives[seed])[1])


def test_a_loop_runs_while_any_seed_needs_it():
    def count(limit):
        return while_any(lambda n: n < limit, lambda n: n + 1, jnp.zeros((), jnp.int32))

    assert count(3) == 3
    assert jax.vmap(count)(jnp.array([2, 5, 1])).tolist() == [5, 5, 5]  # the body's own affair
