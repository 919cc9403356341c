"""The native engine plays the same episodes as `rollouts.vmap_rollout`, in machine code."""

import functools
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from players import actor_and_act, assert_same_episodes, both, only_active, played
from toys import Drifting

from mjx_reinforce import Box
from mjx_reinforce.engine import objects, scalar
from mjx_reinforce.engine.base import Discrete
from mjx_reinforce.engine.cpu import machine
from mjx_reinforce.engine.gpu import cubin
from mjx_reinforce.engine.play import available, choice, native, program, rollouts
from mjx_reinforce.engine.scalar import scalarized, size
from mjx_reinforce.registry import DISTRIBUTIONS, load_definition

if reason := available.unavailable():
    pytest.skip(reason, allow_module_level=True)


#: In a newcomer's `pytest` too; tests/learning/test_distributions.py has how all are written out.
QUICK = ("categorical", "normal")


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[] if name in QUICK else pytest.mark.slow)
        for name in sorted(DISTRIBUTIONS)
    ],
)
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


@pytest.mark.cpu
def test_no_lane_waits():
    """Lengths from 4 to 84, a lane's next episode of any seed: nearly all that is played counts."""
    env = Drifting()
    got = played(native.native_rollout, env, actor_and_act(env, ()), num_seeds=64, num_episodes=32)
    lengths = got.mask.sum(axis=1)
    assert lengths.max() > 4 * lengths.min()
    assert lengths.sum() > 0.9 * got.simulated.sum()
    assert np.all(got.simulated > 0)


def test_only_active_episodes_are_played():
    """Of each seed as many as it has, some of which are modes."""
    chosen = np.arange(120).reshape(3, 40) % 3 == 1
    chosen[1] = False
    options = {"horizon": 60, "deterministic": np.arange(40) % 2 == 0}
    some = only_active(
        native.native_rollout, Drifting(), actor_and_act(Drifting(), (5,)), chosen, **options
    )
    assert (some.simulated > 0).tolist() == [True, False, True]


@pytest.mark.slow
def test_episodes_have_keys_of_their_own():
    env, keys = Drifting(), jax.random.split(jax.random.key(1), 9)
    actor, act, distribution = actor_and_act(env, (5,))
    size = {"num_episodes": 9, "horizon": 60}
    whole = native.native_rollout(env, act, actor, distribution, keys, **size)
    size["num_episodes"] = 4
    some = native.native_rollout(env, act, actor, distribution, keys[::-2][:4], **size)
    for name in ("observation", "action", "reward", "mask"):
        want = getattr(whole, name)[:, ::-2][:, :4]
        np.testing.assert_array_equal(getattr(some, name), want, err_msg=name)


@pytest.mark.cpu
def test_steps_are_counted_for_the_seed_that_a_lane_played():
    """A lane waits for the longest episode; lanes without any count nothing."""
    env = Drifting()
    got = played(native.native_rollout, env, actor_and_act(env, ()), num_seeds=2, num_episodes=2)
    lengths = got.mask.sum(axis=1)
    assert len(np.unique(lengths)) > 1
    np.testing.assert_array_equal(got.simulated, 2 * lengths.max())
    many = played(native.native_rollout, env, actor_and_act(env, ()), num_episodes=200, threads=1)
    assert many.simulated.sum() % machine.this_machine().lanes == 0
    assert np.all(many.simulated >= many.mask.sum((1, 2)))


def test_a_nan_stays_in_its_lane():
    """As an observation and as ``done``; the other episodes are as without it."""

    class Breaking(Drifting):
        def step(self, state, action):
            after = super().step(state, action)
            x = after.obs[0]
            return after.replace(
                obs=jnp.where(x > 0.75, jnp.nan, after.obs),
                done=jnp.where(x < -0.75, jnp.nan, after.done),
            )

    player = actor_and_act(Breaking(), (4,))
    got, want = both(Breaking(), player, num_episodes=20)
    assert_same_episodes(got, want, rounding=2e-5)
    alone = played(native.native_rollout, Drifting(), player, num_episodes=20)
    reached = alone.observation[:, 1:, :, 0]
    high, low = (reached > 0.75).any(axis=1), (reached < -0.75).any(axis=1)
    assert (low & ~high).any()
    assert high.any()
    assert got.nonfinite[low | high].all()
    kept = ~got.nonfinite
    assert kept.any()
    for name in ("observation", "action", "reward"):
        one, other = (np.moveaxis(getattr(x, name), 1, 2)[kept] for x in (got, alone))
        np.testing.assert_array_equal(one, other)


@pytest.mark.slow
@pytest.mark.cpu
def test_double_precision():
    """Networks have float32 parameters, whatever jax_enable_x64 says."""
    with jax.enable_x64(True):
        env = Drifting()
        player = actor_and_act(env, (4, 3))
        assert np.dtype(np.float32) in {x.dtype for x in jax.tree.leaves(player[0].params)}
        got, want = both(env, player, num_episodes=20)
        assert got.observation.dtype == np.float64
        assert_same_episodes(got, want, rounding=1e-12)
    jax.clear_caches()


def test_no_code_is_made_twice(tmp_path, monkeypatch):
    """Not in a process, and not in the next, which reads it from the disk."""
    env = Drifting()
    actor, act, distribution = actor_and_act(env, ())
    monkeypatch.setattr(objects, "folder", lambda: tmp_path)
    first = program.build_program(env, act, actor, distribution, 17)
    assert first.code.compiled
    assert program.build_program(env, act, actor, distribution, 17).code is first.code
    assert program.build_program(env, act, actor, distribution, 19).code is not first.code
    monkeypatch.setattr(machine, "_CACHE", {})
    monkeypatch.setattr(cubin, "_CACHE", {})
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


def chosen(env, name="auto"):
    actor, act, distribution = actor_and_act(env, (4,))
    return choice.choose(name, env, choice.ActingPolicy(act, actor, distribution), 20)


def test_auto_takes_it_and_says_what_it_cannot_play(monkeypatch):
    class Gamma(Drifting):
        def step(self, state, action):
            after = super().step(state, action)
            return after.replace(reward=jax.lax.lgamma(after.reward + 5.0))

    assert chosen(Drifting()).name == "native"
    assert chosen(Gamma()).name == "vmap"
    assert "every episode has a policy of its own" in choice.choose("auto", Drifting()).why
    with pytest.raises(ValueError, match=r"a policy of its own.*choose auto"):
        choice.choose("native", Drifting())
    with pytest.raises(ValueError, match=r"native engine cannot play this: .*lgamma.*choose auto"):
        chosen(Gamma(), "native")
    monkeypatch.setattr(available, "unavailable", lambda: "llvmlite is not installed")
    with pytest.raises(ValueError, match="llvmlite is not installed; choose auto"):
        chosen(Drifting(), "native")


def test_keys_of_another_generator():
    """Their noise is not drawn here; auto plays them as ``vmap`` does, and says so."""
    env = Drifting()
    actor, act, distribution = actor_and_act(env, (4,))
    key = jax.random.key(1, impl="rbg")
    engine = chosen(env)
    assert engine.name == "native"

    def play(engine):
        return engine(env, act, actor, distribution, key, num_episodes=6, horizon=20)

    with pytest.warns(UserWarning, match="the key is of rbg; vmap plays it"):
        got = play(engine.rollout)
    assert_same_episodes(got, play(rollouts.vmap_rollout), rounding=0)
    with pytest.raises(ValueError, match=r'of rbg; make .*impl="threefry2x32"'):
        play(native.native_rollout)


@pytest.mark.cpu
def test_auto_falls_back_whatever_the_writer_raises(monkeypatch):
    def write(*_):
        raise error

    monkeypatch.setattr(program.kernel, "kernel_text", write)
    monkeypatch.setattr(machine, "_CACHE", {})
    monkeypatch.setattr(objects, "folder", lambda: None)
    for error in (KeyError("lost"), ValueError("cannot reshape"), RecursionError("deep")):
        engine = chosen(Drifting())
        assert engine.name == "vmap"
        assert f"it cannot be written out ({type(error).__name__}" in engine.why
        with pytest.raises(ValueError, match="native engine cannot play this: it cannot be writ"):
            chosen(Drifting(), "native")


@pytest.mark.cpu
def test_large_models_are_not_for_machine_code(monkeypatch):
    monkeypatch.setattr(objects, "folder", lambda: None)
    monkeypatch.setattr(machine, "_CACHE", {})
    monkeypatch.setattr(size, "MAX_SCALARS", 9)
    engine = chosen(Drifting())
    assert engine.name == "vmap"
    assert re.search("about .* scalar operations, more than 9; let fewer geoms", engine.why)


def test_long_observations_are_not_for_machine_code():
    with pytest.raises(
        scalar.TooLarge,
        match="let it observe fewer than 1,800 numbers",
    ):
        size.check_size(scalarized.trace(jnp.sin, 1.0)[0], 1_800)


# -------------------------------------------------------------------------------------------------
# The program of a CPU's threads: its text, and that an episode is the same in any lane.


@pytest.mark.cpu
def test_the_number_of_lanes_and_threads_changes_nothing(monkeypatch):
    """More episodes than lanes, and fewer; they end at different steps."""
    env, here = Drifting(), machine.this_machine()
    player, options = actor_and_act(env, ()), {"num_episodes": 7, "horizon": 40}
    want = played(native.native_rollout, env, player, **options)
    assert len(np.unique(want.mask.sum(axis=1))) > 3
    for lanes, threads in ((here.lanes, 1), (here.lanes, 2), (2, 0)):
        monkeypatch.setattr(machine, "this_machine", lambda lanes=lanes: here._replace(lanes=lanes))
        play = functools.partial(native.native_rollout, threads=threads)
        got = played(play, env, player, **options)
        for name in ("observation", "action", "reward", "mask", "nonfinite"):
            np.testing.assert_array_equal(getattr(got, name), getattr(want, name), err_msg=name)
    assert got.simulated.sum() < want.simulated.sum() or here.lanes <= 2
