"""Single episodes of a policy, in our simulation and in C MuJoCo."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from bad_envs import Pole
from flax import struct
from saved_runs import make_run
from toys import Survive, ToyState

from mjx_reinforce import envs, load, playing, pretrained
from mjx_reinforce.envs.c_mujoco.in_mujoco import InMujoco
from mjx_reinforce.watch import untrained


def test_noise_and_other_starts_differ_and_share_a_program(tmp_path):
    """So that the compilation cache serves every later start."""
    env, events = envs.make("CartPole-v1"), []
    play = playing.simulator(env, load(make_run(tmp_path)), 60)
    plain, other, noisy = play(0, False), play(1, False), play(0, True)
    lengths = [[len(play(i, noise).rewards) for i in range(8)] for noise in (False, True)]
    assert np.any(plain.qpos[0] != other.qpos[0])
    np.testing.assert_array_equal(plain.qpos[0], noisy.qpos[0])
    assert lengths[0] != lengths[1]
    assert len(plain.qpos) == len(plain.rewards) + 1
    player = load(tmp_path, 2)
    jax.monitoring.register_event_listener(lambda event, **_: events.append(event))
    playing.simulator(env, player, 60)(5, True)
    assert "/jax/compilation_cache/cache_hits" in events
    assert "/jax/compilation_cache/cache_misses" not in events


@struct.dataclass
class Moving(ToyState):
    qpos: jax.Array | None = None

    @property
    def pipeline_state(self):
        return self


class Breaking(Survive):
    """Leaves the finite numbers in its third step."""

    def reset(self, rng):
        del rng
        return Moving(jnp.zeros(1), jnp.zeros(()), jnp.zeros(()), qpos=jnp.zeros(1))

    def step(self, state, action):
        del action
        obs = state.obs + 1.0
        obs = jnp.where(obs > 2.5, jnp.nan, obs)
        return state.replace(obs=obs, reward=jnp.ones(()), qpos=obs)


def test_a_return_that_is_not_finite_is_nan(tmp_path):
    run = make_run(tmp_path, "InvertedPendulum-v5", observation_size=1)
    episode = playing.simulator(Breaking(), load(run), 20)(0, False)
    np.testing.assert_array_equal(episode.rewards, [1.0, 1.0, np.nan])
    np.testing.assert_array_equal(episode.qpos, [[0.0], [1.0], [2.0]])
    assert math.isnan(episode.total)


@pytest.mark.slow
def test_c_mujoco_plays_the_same_episode():
    """Until rounding shows: float32 there, float64 here."""
    player, env = load("InvertedPendulum-v5"), envs.make("InvertedPendulum-v5")
    ours = playing.simulator(env, player, 20)(3, False)
    theirs = playing.mujoco_simulator(env, player, 20)(3, False)
    np.testing.assert_allclose(theirs.qpos, ours.qpos, atol=1e-4)
    np.testing.assert_allclose(theirs.rewards, ours.rewards, atol=1e-4)
    key = jax.random.key(5)
    np.testing.assert_allclose(InMujoco(env).reset(key), env.reset(key).obs, atol=1e-6)


def test_an_episode_in_c_mujoco_ends_as_the_task_says():
    """A trained policy stands until the time limit, an untrained one falls."""
    player, env = load("InvertedPendulum-v5"), envs.make("InvertedPendulum-v5")
    standing = playing.mujoco_simulator(env, player, 30)(0, False)
    falling = playing.mujoco_simulator(env, untrained(player), 1000)(0, False)
    assert len(standing.rewards) == 30 == len(standing.qpos) - 1
    assert 2 < len(falling.rewards) < 200
    assert falling.rewards[-1] == 0


class Told(Pole):
    """Has a command that changes, and is pushed where it does."""

    def memory(self, rng, data):
        return {"command": jnp.zeros(3), "step": 0}

    def remember(self, rng, data, action):
        step = data.memory["step"] + 1
        command = jnp.where(step % 4 == 0, jax.random.uniform(rng, (3,)), data.memory["command"])
        return {"command": command, "step": step}

    def push(self, before):
        is_due = before.memory["step"] % 4 == 3
        return jnp.zeros(self.mj_model.nv).at[0].set(jnp.where(is_due, 0.1, 0.0))

    def outcome(self, before, data, action):
        terms = {"reward_speed": data.qvel[0], "reward_alive": 1.0, "height": 5.0}
        return data.qvel[0] + 1.0, False, terms


@pytest.mark.slow
def test_an_episode_has_its_terms_its_commands_and_its_pushes(tmp_path):
    env = Told()
    size = env.observation_size
    player = load(make_run(tmp_path, "InvertedPendulum-v5", observation_size=size))
    ours = playing.simulator(env, player, 10)(3, False)
    theirs = playing.mujoco_simulator(env, player, 10)(3, False)
    for episode in (ours, theirs):
        assert [*episode.terms] == ["reward_speed", "reward_alive"]
        np.testing.assert_allclose(sum(episode.terms.values()), episode.rewards, rtol=1e-5)
        assert episode.commands.shape == (11, 3)
        changes = np.any(np.diff(episode.commands, axis=0) != 0, axis=1)
        assert np.flatnonzero(changes).tolist() == [3, 7]
    np.testing.assert_allclose(ours.commands, theirs.commands)
    assert np.flatnonzero(theirs.pushes).tolist() == [3, 7]
    assert ours.pushes is None


def test_a_command_may_be_that_of_the_episode(tmp_path):
    class Sent(Pole):
        def randomize(self, rng):
            return {"command": jax.random.uniform(rng)}

    env = Sent()
    size = env.observation_size
    player = load(make_run(tmp_path, "InvertedPendulum-v5", observation_size=size))
    commands = playing.mujoco_simulator(env, player, 5)(3, False).commands
    assert commands.shape == (6, 1)
    assert np.unique(commands).size == 1
    assert commands[0] > 0


def test_the_package_says_what_its_policies_earn():
    """Of one episode, in another simulation than the one that measured it."""
    facts, player = pretrained()["HalfCheetah-v5"], load("HalfCheetah-v5")
    play = playing.mujoco_simulator(envs.make("HalfCheetah-v5"), player, facts["horizon"])
    assert play(0, False).total == pytest.approx(facts["return"], rel=0.1)


class Contacts(Pole):
    """Reads what C MuJoCo keeps in an array whose size changes."""

    def outcome(self, before, data, action):
        return jnp.sum(data.efc_force), False, {}


class Stepping(Pole):
    """Has a step of its own."""

    def step(self, state, action):
        return state


def test_what_c_mujoco_cannot_play_is_named():
    for env, said in (
        (Contacts(), "reads efc_force, which is not an array of mjData of a fixed size"),
        (Stepping(), "Stepping has steps of its own"),
        (envs.make("CartPole-v1"), "CartPole has steps of its own"),
    ):
        with pytest.raises(ValueError, match=said):
            InMujoco(env)
