"""The environments under brax's interface, beside the engine and beside brax's own wrappers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.envs.wrappers.training import EvalWrapper, wrap
from brax.training.agents.ppo import train as ppo
from toys import Drifting

from mjx_reinforce import Box, envs, make_vec

CART = "ContinuousCartPole-v0"
#: What covers it from -1 to 1 has sums and products without rounding.
SPACE = Box(np.array([-3.0]), np.array([1.0]))
STEPS = 25
NUM_ENVS = 5
KEYS = jax.random.split(jax.random.PRNGKey(3), NUM_ENVS)  # brax knows no other keys
ACTIONS = jax.random.randint(jax.random.key(4), (STEPS, NUM_ENVS, 1), -1, 2).astype(float)


def play(env, state, actions):
    """The states [steps, ...] behind a first one."""

    @jax.jit
    def all_steps(state, actions):
        def step(state, action):
            state = env.step(state, action)
            return state, state

        return jax.lax.scan(step, state, actions)[1]

    return all_steps(state, actions)


@pytest.fixture(scope="module")
def played():
    """An environment, what it played, and what the engine plays from the same keys."""
    task = Drifting(SPACE, length=5.0)
    env = envs.for_brax(task, episode_length=7)
    vec = make_vec(task, NUM_ENVS, autoreset="same_step", max_episode_steps=7)
    begin = vec.reset(jax.random.wrap_key_data(KEYS))
    return env, play(env, env.reset(KEYS), ACTIONS), play(vec, begin, ACTIONS * 2 - 1)


def test_it_plays_what_the_engine_plays(played):
    """Bit by bit, through ends of both kinds and the starts behind them."""
    _, brax, vec = played
    for x, y in zip(jax.tree.leaves(brax.pipeline_state), jax.tree.leaves(vec), strict=True):
        np.testing.assert_array_equal(x, y)
    np.testing.assert_array_equal(brax.obs, vec.obs)
    np.testing.assert_array_equal(brax.reward, vec.reward)
    np.testing.assert_array_equal(brax.done, vec.done)
    np.testing.assert_array_equal(brax.info["truncation"], vec.truncated & ~vec.terminated)
    np.testing.assert_array_equal(brax.info["time_out"], brax.info["truncation"])
    np.testing.assert_array_equal(brax.info["steps"], vec.episode_length)
    np.testing.assert_array_equal(brax.info["episode_metrics"]["sum_reward"], vec.episode_return)
    # Both kinds of ends are there, and new starts are seen where they are.
    assert vec.truncated.any()
    assert vec.terminated.any()
    assert np.all(np.any(vec.obs != vec.final_obs, axis=-1) == vec.done)


def test_one_environment_plays_as_in_a_batch(played):
    """Without resets, to the end of the first episode, as rejax takes them."""
    _, brax, _ = played
    env = envs.for_brax(Drifting(SPACE, length=5.0), episode_length=7, autoreset="disabled")
    for i in range(NUM_ENVS):
        one = play(env, env.reset(KEYS[i]), ACTIONS[:, i])
        length = int(np.argmax(brax.done[:, i])) + 1
        for field in ("done", "reward"):
            np.testing.assert_array_equal(
                getattr(one, field)[:length], getattr(brax, field)[:length, i]
            )
        last = brax.pipeline_state.final_obs[:length, i]
        np.testing.assert_array_equal(one.obs[:length], last)
        np.testing.assert_array_equal(
            one.info["truncation"][:length], brax.info["truncation"][:length, i]
        )


def test_wrappers_around_wrappers_are_refused(played):
    """Those of brax would take our time limit for an end by the task; ours would reset twice."""
    env, *_ = played
    with pytest.raises(ValueError, match=r"wrap_env_fn=envs\.for_brax"):
        wrap(env, episode_length=7).reset(KEYS)
    with pytest.raises(ValueError, match="BraxVectorWrapper does what is done here"):
        envs.for_brax(env)


def test_entries_of_wrappers_stay(played):
    """The evaluation of brax counts the first episode of each environment."""
    env, brax, _ = played
    state = EvalWrapper(env).reset(KEYS)
    state.info["mark"] = jnp.arange(3)
    state = jax.tree.map(lambda x: x[-1], play(EvalWrapper(env), state, ACTIONS))
    np.testing.assert_array_equal(state.info["mark"], [0, 1, 2])
    metrics = state.info["eval_metrics"]
    ends = np.argmax(brax.done, axis=0)
    np.testing.assert_array_equal(metrics.episode_steps, ends + 1)
    sums = [brax.reward[: end + 1, i].sum() for i, end in enumerate(ends)]
    np.testing.assert_allclose(metrics.episode_metrics["reward"], sums, rtol=1e-6)


def test_entries_without_bounds_are_as_they_are():
    space = Box(np.array([-np.inf]), np.array([np.inf]))
    env, vec = envs.for_brax(Drifting(space)), make_vec(Drifting(space), 1, autoreset="same_step")
    action = jnp.array([[0.3]])
    state = env.step(env.reset(KEYS[:1]), action)
    expected = vec.step(vec.reset(jax.random.wrap_key_data(KEYS[:1])), action)
    np.testing.assert_array_equal(state.obs, expected.obs)


@pytest.mark.slow
def test_a_task_of_ours():
    """It has the attributes of the task, and the terms of the reward are summed by episode."""
    env = envs.for_brax("InvertedPendulum-v5")
    assert (env.observation_size, env.action_size, env.episode_length) == (4, 1, 1000)
    assert (env.mj_model.nq, env.backend) == (2, "mjx")
    states = play(env, env.reset(KEYS), jnp.ones((STEPS, NUM_ENVS, 1)))
    terms = states.info["episode_metrics"]["reward_survive"]
    np.testing.assert_array_equal(terms, states.info["episode_metrics"]["sum_reward"])
    assert np.all(np.sum(states.done, axis=0) > 1)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"env": "CartPole-v1"}, "CartPole has 2 discrete ones"),
        ({"action_repeat": 4}, "must be 1, got 4; set frame_skip"),
        ({"randomization_fn": print}, "randomize of a MujocoEnv"),
        ({"autoreset": "next_step"}, "Known: disabled, same_step"),
        ({"autoreset": None}, "unknown autoreset 'None'"),
        ({"episode_length": 0}, "must be at least 1"),
    ],
)
def test_bad_arguments(arguments, message):
    with pytest.raises(ValueError, match=message):
        envs.for_brax(**({"env": CART} | arguments))


def test_what_is_no_key():
    with pytest.raises(ValueError, match="must be a random key"):
        envs.for_brax(Drifting(SPACE)).reset(3)


@pytest.mark.parametrize(
    ("actions", "message"),
    [
        (jnp.zeros((3, 1)), r"must be \[5, 1\], got the shape \[3, 1\]"),
        (jnp.zeros(5), r"must be \[5, 1\], got the shape \[5\]"),
        (jnp.zeros((5, 2)), r"must be \[5, 1\], got the shape \[5, 2\]"),
        ([[0.0]] * 5, r"must be \[5, 1\], got a list"),
    ],
)
def test_wrong_actions(played, actions, message):
    """A short line, which names our arguments and no function within."""
    env, *_ = played
    with pytest.raises(ValueError, match=message) as raised:
        env.step(env.reset(KEYS), actions)
    assert len(str(raised.value)) < 80


def test_wrong_states_and_keys(played):
    env, *_ = played
    with pytest.raises(ValueError, match="must be of reset or step, got None"):
        env.step(None, ACTIONS[0])
    with pytest.raises(ValueError, match=r"the keys must be \[\] or \[N\], got the shape \[1, 5\]"):
        env.reset(KEYS[None])


def test_integer_actions_reach_bounds_that_are_none():
    """The bounds are not rounded to the type of the actions."""
    env = envs.for_brax(Drifting(Box(np.array([-0.5]), np.array([0.5]))), autoreset="disabled")
    state = env.reset(KEYS[0])
    ones = jnp.ones(1)
    np.testing.assert_array_equal(env.step(state, ones.astype(int)).obs, env.step(state, ones).obs)


@pytest.mark.slow
def test_brax_sees_the_environments_as_its_wrappers_show_them():
    """The same starts and actions: its rewards, ends and observations, until an episode ends."""
    ours = envs.for_brax(CART, episode_length=15)
    theirs = wrap(envs.make(CART), episode_length=15)
    keys = KEYS[:4]
    mine = ours.reset(keys)
    other = theirs.reset(jax.vmap(lambda key: jax.random.split(key)[1])(keys))
    np.testing.assert_allclose(mine.obs, other.obs, atol=1e-6)
    action = jnp.array([[0.0], [0.01], [-0.01], [1.0]])
    step, their_step = jax.jit(ours.step), jax.jit(theirs.step)
    running = np.ones(4, bool)
    cut = 0
    for _ in range(15):
        mine, other = step(mine, action), their_step(other, action * ours.action_space.high)
        for name in ("reward", "done"):
            left, right = getattr(mine, name), getattr(other, name)
            np.testing.assert_allclose(left[running], right[running], atol=1e-5)
        for name in ("steps", "truncation", "episode_done"):
            np.testing.assert_array_equal(mine.info[name][running], other.info[name][running])
        left, right = (x.info["episode_metrics"] for x in (mine, other))
        assert set(left) == set(right)
        for name in right:
            np.testing.assert_allclose(left[name][running], right[name][running], atol=1e-4)
        cut += int(mine.info["truncation"][running].sum())
        running &= np.asarray(mine.done) == 0
        np.testing.assert_allclose(mine.obs[running], other.obs[running], atol=1e-4)
    assert 0 < cut < 4


@pytest.mark.slow
def test_its_ppo_trains(monkeypatch):
    """With the function that brax 0.14.2 calls and JAX 0.10 has no more (docs/vector.md)."""
    monkeypatch.setattr(
        jax,
        "device_put_replicated",
        lambda tree, devices: jax.tree.map(lambda x: jnp.stack([x] * len(devices)), tree),
        raising=False,
    )
    told = []
    ppo.train(
        envs.make(CART),
        wrap_env_fn=envs.for_brax,
        num_timesteps=4_000,
        num_evals=2,
        num_envs=16,
        num_eval_envs=8,
        episode_length=100,
        unroll_length=5,
        batch_size=16,
        num_minibatches=2,
        bootstrap_on_timeout=True,
        progress_fn=lambda steps, metrics: told.append((steps, metrics["eval/episode_reward"])),
    )
    assert [steps >= 4_000 for steps, _ in told] == [False, True]
    assert all(8 < reward <= 100 for _, reward in told)
