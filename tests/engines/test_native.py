"""The native engine plays the same episodes as `rollouts.rollout`, in machine code."""

import functools
import itertools
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from players import actor_and_act, assert_same_episodes, both, played
from toys import Bytes, Drifting, categorical

from mjx_reinforce import Box, envs, fused, reinforce
from mjx_reinforce.engines import choice, rollouts
from mjx_reinforce.engines.native import available, objects, outlook, program, rollout
from mjx_reinforce.engines.native.cpu import lanes, machine
from mjx_reinforce.engines.native.gpu import ptx
from mjx_reinforce.registry import DISTRIBUTIONS, load_definition
from mjx_reinforce.types import Discrete

if reason := available.unavailable():
    pytest.skip(reason, allow_module_level=True)


@pytest.mark.parametrize("name", sorted(DISTRIBUTIONS))
def test_every_distribution_draws_the_same_noise(name):
    """Over three chunks, in lanes that are at different steps."""
    space = Box(np.array([-3.0]), np.array([1.0]))
    try:
        distribution = load_definition(DISTRIBUTIONS[name])(space)
    except ValueError:
        space = Discrete(3)
        distribution = load_definition(DISTRIBUTIONS[name])(space)
    env = Drifting(space)
    player = actor_and_act(env, (4,), distribution=distribution)
    got, want = both(env, player, deterministic=jnp.arange(5) % 2 == 0)
    assert len(np.unique(want.mask.sum(axis=1))) > 5
    assert_same_episodes(got, want, rounding=2e-5)
    assert np.all(got.observation[~got.mask] == 0)
    assert np.all(got.action[~got.mask] == 0)


def in_scalars(env):
    """Plays as ``vmap``, with the step written out."""
    step = fused.vmap(env.step, in_axes=-1, out_axes=-1)
    return functools.partial(rollouts.rollout, env_step=step)


@pytest.mark.parametrize("hidden_sizes", [(), (7, 5, 6), (8, 6, 5)])
def test_the_pendulum(hidden_sizes):
    env = envs.make("InvertedPendulum-v5")
    options = {"horizon": 50, "num_episodes": 20}
    got, want = both(env, actor_and_act(env, hidden_sizes), in_scalars(env), **options)
    assert not want.mask[:, -1].all()
    assert_same_episodes(got, want, rounding=2e-5)


def test_a_limit_for_each_episode():
    """Also one beyond the horizon, and one of no step; some take the mode."""
    env = Drifting()
    limit, modes = jnp.array([60, 3, 0, 200, 51]), jnp.arange(5) % 2 == 1
    options = {"deterministic": modes, "horizon": 100, "limit": limit}
    got, want = both(env, actor_and_act(env, (4,)), **options)
    assert_same_episodes(got, want, rounding=2e-5)
    lengths = got.mask.sum(axis=1)
    assert (lengths <= np.array(limit)).all()
    assert {3, 0, 51} & set(lengths.ravel().tolist()) >= {3, 0}
    whole, _ = both(env, actor_and_act(env, (4,)), **options | {"limit": None})
    np.testing.assert_array_equal(got.reward, np.where(got.mask, whole.reward, 0))


@pytest.mark.parametrize("id", ["CartPole-v1", "Reacher-v5"])
def test_tasks_without_contacts(id):
    env = envs.make(id)
    distribution = categorical(env.action_space.num_actions) if id == "CartPole-v1" else None
    player = actor_and_act(env, (4,), distribution=distribution)
    got, want = both(env, player, in_scalars(env), horizon=20, num_seeds=2)
    assert_same_episodes(got, want, rounding=1e-4)


@pytest.mark.cpu
def test_no_lane_waits():
    """Lengths from 4 to 84, a lane's next episode of any seed: nearly all that is played counts."""
    env = Drifting()
    got = played(rollout.rollout, env, actor_and_act(env, ()), num_seeds=64, num_episodes=32)
    lengths = got.mask.sum(axis=1)
    assert lengths.max() > 4 * lengths.min()
    assert lengths.sum() > 0.9 * got.simulated.sum()
    assert np.all(got.simulated > 0)


def test_a_seed_that_stands_still_plays_nothing():
    env = Drifting()
    actor, act, distribution = actor_and_act(env, ())

    @jax.jit
    def play(active):
        def one(active, key):
            size = {"num_episodes": 4, "horizon": 60}
            return rollout.rollout(env, act, actor, distribution, key, active=active, **size)

        return jax.vmap(one)(active, jax.random.split(jax.random.key(1), 3))

    every, some, none = (play(jnp.array(x)) for x in ([1, 1, 1], [1, 0, 1], [0, 0, 0]))
    for leaf, whole in zip(jax.tree.leaves(some), jax.tree.leaves(every), strict=True):
        assert not np.any(leaf[1])
        if leaf.ndim > 1:
            np.testing.assert_array_equal(leaf[::2], whole[::2])
    assert not any(np.any(x) for x in jax.tree.leaves(none))


@pytest.mark.parametrize("threads", [1, 2])
def test_only_active_episodes_are_played(threads):
    """They are, to the bit, what the same episodes are alone, by their own keys; some are modes."""
    env = Drifting()
    actor, act, distribution = actor_and_act(env, (5,))
    keys = jax.random.split(jax.random.key(1), (3, 40))
    chosen = np.arange(120).reshape(3, 40) % 3 == 1
    chosen[1] = False
    modes = np.arange(40) % 2 == 0

    def one(keys, active, modes):
        options = {"horizon": 60, "active": active, "deterministic": modes, "threads": threads}
        size = {"num_episodes": len(keys)}
        return rollout.rollout(env, act, actor, distribution, keys, **size, **options)

    some = jax.jit(jax.vmap(one, in_axes=(0, 0, None)))(keys, jnp.array(chosen), modes)
    assert some.mask.any()
    for s in range(3):
        got = jax.tree.map(lambda x, s=s: np.asarray(x)[s], some)
        rest = got.replace(
            observation=got.observation[:, ~chosen[s]], action=got.action[:, ~chosen[s]]
        )
        assert not any(x.any() for x in (rest.observation, rest.action, got.mask[:, ~chosen[s]]))
        assert not got.reward[:, ~chosen[s]].any()
        assert bool(got.simulated) == chosen[s].any()
        if chosen[s].any():
            alone = jax.jit(one)(keys[s][chosen[s]], True, modes[chosen[s]])
            for name in ("observation", "action", "reward", "mask"):
                part = getattr(got, name)[:, chosen[s]]
                np.testing.assert_array_equal(part, getattr(alone, name), err_msg=name)


@pytest.mark.cpu
def test_steps_are_counted_for_the_seed_that_a_lane_played():
    """A lane waits for the longest episode; lanes without any count nothing."""
    env = Drifting()
    got = played(rollout.rollout, env, actor_and_act(env, ()), num_seeds=2, num_episodes=2)
    lengths = got.mask.sum(axis=1)
    assert len(np.unique(lengths)) > 1
    np.testing.assert_array_equal(got.simulated, 2 * lengths.max())
    many = played(rollout.rollout, env, actor_and_act(env, ()), num_episodes=200)
    assert many.simulated.sum() % machine.this_machine().lanes == 0
    assert np.all(many.simulated >= many.mask.sum((1, 2)))


def assert_identical(got, want):
    for name in ("observation", "action", "reward", "mask", "nonfinite"):
        np.testing.assert_array_equal(getattr(got, name), getattr(want, name), err_msg=name)


@pytest.mark.parametrize("threads", [1, 2])
def test_the_number_of_threads_changes_nothing(threads):
    env = Drifting()
    player = actor_and_act(env, (5,))
    options = {"num_episodes": 40, "horizon": 60}
    want = played(rollout.rollout, env, player, **options)
    some = played(functools.partial(rollout.rollout, threads=threads), env, player, **options)
    assert_identical(some, want)
    assert_identical(played(rollout.rollout, env, player, **options), want)


@pytest.mark.cpu
@pytest.mark.parametrize("level", ["x86-64", "x86-64-v3"])
def test_older_cpus(level, monkeypatch):
    """Fewer lanes, no fused products: the same episodes up to rounding."""
    env = Drifting()
    player = actor_and_act(env, (5,))
    want = played(rollout.rollout, env, player, horizon=30)
    monkeypatch.setenv(machine.VARIABLE, level)
    try:
        machine.this_machine()
    except ValueError as error:
        pytest.skip(str(error))
    jax.clear_caches()
    assert_same_episodes(played(rollout.rollout, env, player, horizon=30), want, rounding=2e-5)


def test_an_end_that_is_nan_is_no_end():
    class Lost(Drifting):
        def step(self, state, action):
            after = super().step(state, action)
            return after.replace(done=jnp.where(after.obs[0] > 0.75, jnp.nan, after.done))

    env = Lost()
    got, want = both(env, actor_and_act(env, (4,)), num_episodes=20)
    assert 0 < want.nonfinite.mean() < 1
    assert_same_episodes(got, want, rounding=2e-5)


def test_a_nan_stays_in_its_lane():
    class Breaking(Drifting):
        def step(self, state, action):
            after = super().step(state, action)
            broken = after.obs[0] > 0.75
            return after.replace(obs=jnp.where(broken, jnp.nan, after.obs))

    calm, env = Drifting(), Breaking()
    player = actor_and_act(env, (4,))
    got, want = both(env, player, num_episodes=20)
    assert 0 < want.nonfinite.mean() < 1
    assert_same_episodes(got, want, rounding=2e-5)
    sound = ~got.nonfinite
    alone = played(rollout.rollout, calm, player, num_episodes=20)
    kept = sound & (alone.observation[..., 0].max(axis=1) < 0.75)
    assert kept.any()
    for name in ("observation", "action", "reward"):
        one, other = (np.moveaxis(getattr(x, name), 1, 2)[kept] for x in (got, alone))
        np.testing.assert_array_equal(one, other)


def test_integers_divide_as_everywhere():
    """By zero, and the least one by -1, for both of which a processor stops the program."""
    edges = jnp.int32([-(2**31), -7, -1, 0, 1, 5, 2**31 - 1])

    class Divides(Drifting):
        def reset(self, rng):
            state = super().reset(rng)
            numbers = jax.random.choice(rng, edges, (2,))
            return state.replace(info=(*state.info, numbers))

        def step(self, state, action):
            *info, (x, y) = state.info
            after = super().step(state.replace(info=tuple(info)), action)
            parts = jnp.float32([jax.lax.div(x, y), jax.lax.rem(x, y)])
            info = (*after.info, jnp.stack([x, y]))
            return after.replace(info=info, reward=parts[0] + 3 * parts[1])

    env = Divides()
    got, want = both(env, actor_and_act(env, ()), num_episodes=100, horizon=1)
    np.testing.assert_array_equal(got.reward, want.reward)
    assert len(np.unique(want.reward)) > 20


@pytest.mark.parametrize("count", [1, 4, 8, 16])
def test_vectors_begin_at_multiples_of_their_size(count):
    """As LLVM takes for granted, also of 16 numbers of 8 bytes."""
    leaves = [jax.ShapeDtypeStruct((3,), x) for x in (np.float32, np.float64, np.int32, np.int64)]
    places = lanes.layout(leaves, 1, 1, count)
    fields = [*places.inputs, places.broken, places.seed, places.episode]
    for field, after in itertools.pairwise(fields):
        assert after.offset >= field.offset + field.count * field.dtype.itemsize * count
    for field in fields:
        vector = field.dtype.itemsize * count
        assert field.offset % vector == lanes.ALIGNMENT % vector == 0


@pytest.mark.cpu
def test_double_precision():
    with jax.enable_x64(True):
        env = Drifting()
        got, want = both(env, actor_and_act(env, (4, 3)), num_episodes=20)
        assert got.observation.dtype == np.float64
        assert_same_episodes(got, want, rounding=1e-12)
    jax.clear_caches()


@pytest.mark.cpu
def test_a_policy_in_single_precision_plays_in_double_precision():
    """Networks have float32 parameters, whatever jax_enable_x64 says."""
    with jax.enable_x64(True):
        learners = [
            reinforce(Drifting(), num_episodes=4, horizon=20, engine=engine)
            for engine in ("native", "vmap")
        ]
        returns = []
        for learner in learners:
            state = learner.init(jax.random.key(0))
            trajectory = jax.jit(learner.play)(state, jax.random.key(1))
            returns.append(np.asarray(trajectory.reward))
    assert returns[0].dtype == np.float64
    np.testing.assert_allclose(*returns, rtol=1e-6, atol=1e-6)
    jax.clear_caches()


def test_no_code_is_made_twice(tmp_path, monkeypatch):
    """Not in a process, and not in the next, which reads it from the disk."""
    env = envs.make("CartPole-v1")
    actor, act, distribution = actor_and_act(
        env, (), distribution=categorical(env.action_space.num_actions)
    )
    monkeypatch.setattr(objects, "folder", lambda: tmp_path)
    first = program.build_program(env, act, actor, distribution, 17)
    assert first.code.compiled
    assert program.build_program(env, act, actor, distribution, 17).code is first.code
    assert program.build_program(env, act, actor, distribution, 19).code is not first.code
    monkeypatch.setattr(machine, "_LOADED", {})
    monkeypatch.setattr(ptx, "_LOADED", {})
    monkeypatch.setattr(program.scalarized, "build", None)
    assert not program.build_program(env, act, actor, distribution, 17).code.compiled


def test_constants_are_part_of_the_code():
    class Pays(Drifting):
        def step(self, state, action):
            after = super().step(state, action)
            return after.replace(reward=after.reward * self.prices[0])

    actor, act, distribution = actor_and_act(Drifting(), ())
    keys = set()
    for price in (2.0, 3.0, 3.0):
        env = Pays()
        env.prices = jnp.array([price])
        keys.add(program.build_program(env, act, actor, distribution, 10).code.key)
    assert len(keys) == 2


def test_auto_takes_it_and_says_what_it_cannot_play(monkeypatch):
    env = envs.make("CartPole-v1")
    actor, act, distribution = actor_and_act(
        env, (), distribution=categorical(env.action_space.num_actions)
    )
    player = choice.ActingPolicy(act, actor, distribution)
    assert choice.choose("auto", env, player, 500).name == "native"
    assert choice.choose("auto", env).name == "vmap"

    class Gamma(Drifting):
        def step(self, state, action):
            after = super().step(state, action)
            return after.replace(reward=jax.lax.lgamma(after.reward + 5.0))

    gamma = Gamma()
    actor, act, distribution = actor_and_act(gamma, ())
    player = choice.ActingPolicy(act, actor, distribution)
    assert choice.choose("auto", gamma, player, 500).name == "vmap"
    with pytest.raises(ValueError, match=r"native engine cannot play this: .*lgamma.*choose auto"):
        choice.choose("native", gamma, player, 500)
    monkeypatch.setattr(available, "unavailable", lambda: "llvmlite is not installed")
    with pytest.raises(ValueError, match="llvmlite is not installed; choose auto"):
        choice.choose("native", env, player, 500)


@pytest.mark.cpu
def test_lanes_have_no_numbers_of_8_bits():
    env = Bytes()
    actor, act, distribution = actor_and_act(env, ())
    chosen = choice.choose("auto", env, choice.ActingPolicy(act, actor, distribution), 500)
    assert chosen.name == "vmap"
    assert "machine code cannot play this: its state has numbers of int8" in chosen.why


@pytest.mark.parametrize("implementation", ["rbg", "unsafe_rbg"])
def test_keys_of_another_generator(implementation):
    """Their noise is not drawn here; auto plays them as ``vmap`` does, and says so."""
    env = Drifting()
    actor, act, distribution = actor_and_act(env, (4,))
    key = jax.random.key(1, impl=implementation)
    engine = choice.choose("auto", env, choice.ActingPolicy(act, actor, distribution), 20)
    assert engine.name == "native"

    def play(engine):
        return engine(env, act, actor, distribution, key, num_episodes=6, horizon=20)

    with pytest.warns(UserWarning, match=f"the key is of {implementation}; vmap plays it"):
        got = play(engine.rollout)
    assert_same_episodes(got, play(rollouts.rollout), rounding=0)
    with pytest.raises(ValueError, match=rf'of {implementation}; make .*impl="threefry2x32"'):
        play(rollout.rollout)


def chosen(env, name="auto"):
    actor, act, distribution = actor_and_act(env, (4,))
    return choice.choose(name, env, choice.ActingPolicy(act, actor, distribution), 20)


@pytest.mark.cpu
@pytest.mark.parametrize(
    "error", [KeyError("lost"), ValueError("cannot reshape"), RecursionError("deep")]
)
def test_auto_falls_back_whatever_the_writer_raises(error, monkeypatch):
    def write(*_):
        raise error

    monkeypatch.setattr(program, "_write_cpu", write)
    monkeypatch.setattr(objects, "folder", lambda: None)

    class Unseen(Drifting):
        def step(self, state, action):
            after = super().step(state, action)
            return after.replace(reward=after.reward + len(type(error).__name__))

    engine = chosen(Unseen())
    assert engine.name == "vmap"
    assert f"it cannot be written out ({type(error).__name__}" in engine.why
    with pytest.raises(ValueError, match="native engine cannot play this: it cannot be written"):
        chosen(Unseen(), "native")


class Panorama(Drifting):
    """Sees 2,000 numbers."""

    def reset(self, rng):
        state = super().reset(rng)
        return state.replace(obs=jnp.tile(state.obs, 1_000))

    def step(self, state, action):
        return state.replace(obs=0.9 * state.obs, reward=jnp.sum(state.obs))


def test_wide_observations_are_not_for_machine_code():
    engine = chosen(Panorama())
    assert engine.name == "vmap"
    assert "because of an observation of 2,000 entries" in engine.why
    assert "109 s, more than 80 s, because of an observation of 2,000 entries" in engine.why
    assert outlook.announcement(Panorama()) is None
    assert outlook.announcement(Drifting()) is None


@pytest.mark.cpu
def test_large_models_are_not_for_machine_code(monkeypatch):
    """The reason says which bodies meet most, and people who wait are told of it beforehand."""
    env = envs.make("Walker2d-v5")
    assert outlook.seconds(env) == pytest.approx(5, abs=3)
    monkeypatch.setattr(outlook, "_WORTH_SAYING", 1)
    monkeypatch.setattr(objects, "folder", lambda: None)
    assert "with up to 14 contacts, and compiling" in str(outlook.announcement(env))
    monkeypatch.setattr(outlook, "MAX_SECONDS", 1)
    engine = chosen(env)
    assert engine.name == "vmap"
    assert "more than 1 s, because of its size; its geoms can meet in" in engine.why
    assert re.search(r"bodies 'world' \(\d+\), .* the feet alone, by contype", engine.why)
