"""Rollouts against a loop by hand, on a task that counts its steps."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from players import only_active
from toys import Chain, Toy, ToyState, categorical

from mjx_reinforce.engine import episode
from mjx_reinforce.engine.play import counter, rollouts


class Plain:
    """Two entries of an action, noise added; the mode is what the network says."""

    noise = staticmethod(lambda key, shape: jax.random.normal(key, (*shape, 2)))
    sample = staticmethod(lambda outputs, noise: outputs + noise)
    mode = staticmethod(lambda outputs: outputs)


class Counter(Toy):
    """Shows (steps made, drawn start); earns its action's sum; ends after ``length`` steps.

    ``spoil(state)`` may change what a step returns.
    """

    action_size = 2

    def __init__(self, length=10**9, spoil=lambda state: state):
        self.length, self.spoil = length, spoil

    def reset(self, rng):
        start = jax.random.uniform(rng)
        return ToyState(jnp.stack([0.0, start]), jnp.zeros(()), jnp.zeros(()), start)

    def step(self, state, action):
        obs = state.obs + jnp.array([1.0, 0.0])
        limit = jnp.floor(1 + self.length * state.info)
        done = (obs[0] >= limit).astype(jnp.float32)
        return self.spoil(state.replace(obs=obs, reward=jnp.sum(action), done=done))


def act(actor, observation):
    """Outputs [N, 2] that tell the episodes and the steps apart."""
    return actor * observation


def play(env, key=None, *, num_episodes=4, horizon=6, distribution=Plain, act=act, **options):
    options = {"num_episodes": num_episodes, "horizon": horizon} | options
    key = jax.random.key(0) if key is None else key
    roll = jax.jit(functools.partial(rollouts.vmap_rollout, env, act, **options), static_argnums=1)
    return jax.tree.map(np.asarray, roll(jnp.array([0.1, 2.0]), distribution, key))


def by_hand(env, key, num_episodes, horizon, chunk, deterministic=False, limit=None):
    """The episodes one by one; an episode's keys come from its own index and the chunk."""
    shape = horizon, num_episodes
    deterministic = np.broadcast_to(deterministic, num_episodes)
    limit = np.broadcast_to(horizon if limit is None else limit, num_episodes)
    observation, action = np.zeros((2, *shape, 2), np.float32)
    reward, mask = np.zeros(shape, np.float32), np.zeros(shape, bool)
    for n in range(num_episodes):
        reset_key, noise_key = jax.random.split(jax.random.fold_in(key, n))
        state = env.reset(reset_key)
        for t in range(limit[n]):
            if t % chunk == 0:
                noise_key, draw_key = jax.random.split(noise_key)
                noise = Plain.noise(draw_key, (chunk,))
            outputs = act(jnp.array([0.1, 2.0]), state.obs)
            chosen = outputs if deterministic[n] else outputs + noise[t % chunk]
            observation[t, n], action[t, n], mask[t, n] = state.obs, chosen, True
            state = env.step(state, chosen)
            reward[t, n] = state.reward
            if state.done:
                break
    return observation, action, reward, mask


def assert_is(trajectory, expected):
    names = ("observation", "action", "reward", "mask")
    for name, values in zip(names, expected, strict=True):
        np.testing.assert_allclose(getattr(trajectory, name), values, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("deterministic", [False, (False, True, True, False), True])
def test_episodes_are_those_of_a_loop(deterministic):
    """The last step is in the mask, everything behind it is zero, those chosen take the mode."""
    env, key = Counter(length=8), jax.random.key(3)
    chosen = deterministic if isinstance(deterministic, bool) else jnp.array(deterministic)
    trajectory = play(env, key, deterministic=chosen)
    expected = by_hand(env, key, 4, 6, 6, deterministic)
    lengths = expected[-1].sum(axis=0)
    assert lengths.min() < 6  # some end by themselves,
    assert lengths.max() == 6  # some at the horizon
    assert_is(trajectory, expected)
    assert not trajectory.nonfinite.any()


@pytest.mark.parametrize("limit", [2, (6, 1, 0, 3)])
def test_episodes_have_no_more_steps_than_their_limit(limit):
    env, key = Counter(length=8), jax.random.key(3)
    trajectory = play(env, key, limit=jnp.array(limit))
    assert_is(trajectory, by_hand(env, key, 4, 6, 6, limit=limit))
    assert (trajectory.mask.sum(axis=0) <= np.array(limit)).all()
    with pytest.raises(ValueError, match=r"limit must be \[\] or \[4\], got the shape \[3\]"):
        play(env, key, limit=jnp.arange(3))


def test_episodes_of_given_keys():
    env, keys = Counter(length=8), jax.random.split(jax.random.key(3), 4)
    trajectory = play(env, keys)
    folded = episode.episode_keys(keys[1], 3)
    one = play(env, folded[2:], num_episodes=1)
    np.testing.assert_array_equal(one.observation[:, 0], play(env, keys[1]).observation[:, 2])
    alone = play(env, keys[1:2], num_episodes=1)
    assert_is(trajectory.episodes(slice(1, 2)), list(jax.tree.leaves(alone))[:4])
    with pytest.raises(ValueError, match=r"key must be \[\] or \[5\], got the shape \[4\]"):
        play(env, keys, num_episodes=5)


def test_only_active_episodes_are_played():
    """Seeds side by side, each with a choice of its own."""
    chosen = np.array([[True, False, True, False], [False] * 4, [True] * 4])
    player = jnp.array([0.1, 2.0]), act, Plain
    only_active(rollouts.vmap_rollout, Counter(length=8), player, chosen, horizon=100)
    none = play(Counter(length=8), active=False)
    assert not any(np.any(x) for x in jax.tree.leaves(none))


@pytest.mark.parametrize(("length", "steps"), [(1, 50), (50, 50), (101, 150)])
def test_the_simulation_stops_when_all_episodes_are_over(length, steps):
    """And ``simulated`` says how many were made: whole chunks of 50 here."""
    made = []

    class Fixed(Counter):
        def reset(self, rng):
            return super().reset(rng).replace(info=(length - 0.5) / 200)

    env = Fixed(length=200)
    batch = jax.vmap(env.step, in_axes=-1, out_axes=-1)

    def counted(state, action):
        jax.debug.callback(lambda: made.append(1))
        return batch(state, action)

    trajectory = play(env, horizon=200, env_step=counted)
    jax.effects_barrier()
    assert rollouts.episode_lengths(trajectory).tolist() == [length] * 4
    assert len(made) == steps
    assert int(trajectory.simulated) == 4 * steps


@pytest.mark.parametrize(
    ("entry", "value"),
    [("observation", np.nan), ("observation", np.inf), ("reward", -np.inf), ("done", np.nan)],
)
def test_what_is_not_finite_ends_its_episode(entry, value):
    """The third step breaks in those episodes that start high; its reward is 0."""

    def spoil(state):
        broken = (state.obs[0] == 3) & (state.info > 0.5)
        if entry != "observation":
            return state.replace(**{entry: jnp.where(broken, value, getattr(state, entry))})
        return state.replace(obs=state.obs.at[1].set(jnp.where(broken, value, state.obs[1])))

    key = jax.random.key(1)
    trajectory = play(Counter(spoil=spoil), key)
    healthy = play(Counter(), key)
    broken = healthy.observation[0, :, 1] > 0.5
    assert 0 < broken.sum() < 4
    np.testing.assert_array_equal(trajectory.nonfinite, broken)
    np.testing.assert_array_equal(trajectory.mask.sum(axis=0), np.where(broken, 3, 6))
    kept = trajectory.mask & ~(broken & (np.arange(6)[:, None] == 2))
    np.testing.assert_array_equal(trajectory.reward, np.where(kept, healthy.reward, 0.0))
    assert all(np.all(np.isfinite(x)) for x in (trajectory.observation, trajectory.action))


def test_a_finished_episode_stands_still():
    """What the simulation would do behind the end is not counted as broken, nor as played."""

    def spoil(state):
        return state.replace(obs=jnp.where(state.obs[0] > 2, jnp.nan, state.obs))

    class Two(Counter):
        def step(self, state, action):
            after = super().step(state, action)
            return after.replace(done=jnp.where(after.obs[0] == 2, 1.0, 0.0))

    trajectory = play(Two(spoil=spoil))
    assert not trajectory.nonfinite.any()
    assert trajectory.mask.sum(axis=0).tolist() == [2] * 4


def test_an_end_that_breaks_is_both():
    def spoil(state):
        return state.replace(reward=jnp.where(state.obs[0] == 1, jnp.nan, 1.0), done=jnp.ones(()))

    trajectory = play(Counter(spoil=spoil))
    assert trajectory.nonfinite.all()
    assert trajectory.mask.sum(axis=0).tolist() == [1] * 4
    assert np.all(trajectory.reward == 0)


def test_seeds_side_by_side_are_each_its_own():
    """One of them stands still, and the others' episodes end at different times."""
    env, keys = Counter(length=8), jax.random.split(jax.random.key(0), 3)
    actor = jnp.array([0.1, 2.0])

    def roll(key, active):
        return rollouts.vmap_rollout(
            env, act, actor, Plain, key, num_episodes=2, horizon=100, active=active
        )

    together = jax.vmap(roll)(keys, jnp.array([True, False, True]))
    for s in (0, 2):
        alone = jax.tree.map(lambda x, s=s: x[s], together)
        assert_is(alone, by_hand(env, keys[s], 2, 100, 50))
    assert not together.mask[1].any()


def test_discrete_actions_have_no_last_axis():
    trajectory = play(
        Chain(),
        num_episodes=5,
        horizon=3,
        distribution=categorical(2),
        act=lambda actor, observation: jnp.stack([observation[:, 0], 2 * observation[:, 1]], -1),
        deterministic=True,
    )
    # Arm 0 first, then arm 1, and where both are equal arm 0.
    assert trajectory.action.shape == (3, 5)
    np.testing.assert_array_equal(trajectory.action, np.array([[0], [1], [0]]).repeat(5, axis=1))
    earned = Chain.rewards[[0, 1, 2], [0, 1, 0]]
    np.testing.assert_allclose(trajectory.reward, earned[:, None].repeat(5, axis=1), rtol=1e-6)


# -------------------------------------------------------------------------------------------------
# JAX's random numbers from any count on: Threefry's known answers, and JAX's own numbers.

KEY = jax.random.key(7)
WORDS = jax.random.key_data(KEY)


def test_numbers_from_a_count_on_are_those_of_a_longer_draw():
    whole = jax.random.normal(KEY, (12,))
    for first in (0, 3, 10):
        from_there = counter.at_counter(WORDS, jnp.uint32(first))
        np.testing.assert_array_equal(jax.random.normal(from_there, (2,)), whole[first : first + 2])


def test_bits_of_any_width_and_shape_and_doubles():
    for dtype in (np.uint8, np.uint16, np.uint32):
        ours = jax.random.bits(counter.key_of_words(WORDS), (2, 3), dtype)
        np.testing.assert_array_equal(ours, jax.random.bits(KEY, (2, 3), dtype))
        assert ours.dtype == dtype
    with jax.enable_x64(True):
        ours = jax.random.normal(counter.key_of_words(WORDS), (4,), np.float64)
        np.testing.assert_array_equal(ours, jax.random.normal(KEY, (4,), np.float64))


def test_keys_made_of_keys():
    ours, theirs = counter.key_of_words(WORDS), KEY
    for _ in range(2):
        ours, theirs = jax.random.split(ours, 3)[2], jax.random.split(theirs, 3)[2]
        ours, theirs = jax.random.fold_in(ours, 5), jax.random.fold_in(theirs, 5)
    np.testing.assert_array_equal(jax.random.key_data(ours), jax.random.key_data(theirs))


def test_a_key_that_skips_numbers_is_not_split():
    with pytest.raises(NotImplementedError, match="more than one key"):
        jax.random.split(counter.at_counter(WORDS, jnp.uint32(1)))
