"""A trained policy in three lines: which seed, which action, and every damage named."""

import re
import shutil
import sys

import gymnasium
import jax
import numpy as np
import pytest
from saved_runs import change, change_arrays, make_run, write

from mjx_reinforce import act, load, load_policy, watch
from mjx_reinforce.export import __main__ as export
from mjx_reinforce.reports.sources import read_directory
from mjx_reinforce.runs.command_line import parse

OBSERVATIONS = np.random.default_rng(0).normal(size=(5, 4))
KERNEL = "params__network__params__Dense_0__kernel"


@pytest.mark.parametrize("env", ["CartPole-v1", "InvertedPendulum-v5"])
def test_actions_are_the_mode_as_gymnasium_takes_it(tmp_path, env):
    player = load(make_run(tmp_path, env), 1)
    assert (player.env, player.seed, player.observation_size) == (env, 1, 4)
    policy, actor = load_policy(tmp_path / "policy", 1)
    expected = policy.distribution.mode(act(policy, actor, OBSERVATIONS.astype(np.float32)))
    batch = player.act(OBSERVATIONS)
    np.testing.assert_allclose(batch, expected, rtol=1e-6)
    space = gymnasium.make(env).action_space
    for observation, row in zip(OBSERVATIONS, batch, strict=True):
        action = player.act(observation)
        np.testing.assert_allclose(action, row, rtol=1e-6)
        if env == "CartPole-v1":
            assert space.contains(action)
        else:
            assert (action.shape, action.dtype) == (space.shape, space.dtype)


def test_the_action_may_be_changed_in_place(tmp_path):
    action = load(make_run(tmp_path, "InvertedPendulum-v5")).act(OBSERVATIONS[0])
    action *= 2.0


def test_a_generator_draws_actions(tmp_path):
    player = load(make_run(tmp_path, "InvertedPendulum-v5"), 0)
    many = np.tile(OBSERVATIONS[0], (4000, 1))
    actions = player.act(many, np.random.default_rng(1))
    np.testing.assert_array_equal(actions, player.act(many, np.random.default_rng(1)))
    std = np.exp(player.actor.params["constants"][0])
    noise = std * np.random.default_rng(3).standard_normal(100_000)
    clipped = np.clip(player.act(OBSERVATIONS[0])[0] + noise, -3, 3)  # the actuator's range
    assert np.std(actions) == pytest.approx(np.std(clipped), rel=0.05)
    assert np.mean(actions) == pytest.approx(np.mean(clipped), abs=5 * np.std(clipped) / 4000**0.5)
    rng = np.random.default_rng(2)
    assert np.any(player.act(many[:20], rng) != player.act(many[:20], rng))


@pytest.mark.parametrize(
    ("returns", "best", "worst", "median"),
    [
        ([2.0, 7.0, 5.0], 1, 0, 2),
        ([7.0, None, 5.0], 0, 1, 2),  # not finite is below all others
        ([5.0, 5.0, 5.0], 0, 0, 1),
        ([-3, -4, -5], 0, 2, 1),
    ],
)
def test_seeds_are_ranked_by_the_final_evaluation(tmp_path, returns, best, worst, median):
    make_run(tmp_path)
    write(tmp_path / "summary.json", {"final_returns": returns})
    assert load(tmp_path).seed == best
    assert load(tmp_path, "worst").seed == worst
    assert load(str(tmp_path), "median").seed == median
    expected = load_policy(tmp_path / "policy", best)[1]
    jax.tree.map(np.testing.assert_array_equal, load(tmp_path).actor, expected)


def test_the_best_policies_on_the_way_are_another_folder(tmp_path):
    make_run(tmp_path)
    with pytest.raises(ValueError, match="has no policy/best"):
        load(tmp_path, which="best")
    make_run(tmp_path, folder="policy/best", hidden_sizes=[3])
    change(tmp_path / "summary.json", best_test_returns=[9.0, 7.0, 5.0])
    assert load(tmp_path, which="last").seed == 1
    player = load(tmp_path, which="best")
    assert player.seed == 0
    assert player.actor.params["network"]["params"]["Dense_0"]["kernel"].shape == (4, 3)
    with pytest.raises(ValueError, match="which must be one of last, best, got 'first'"):
        load(tmp_path, which="first")


def test_unbounded_actions_survive_json(tmp_path):
    run = make_run(
        tmp_path, "InvertedPendulum-v5", action_low=[-np.inf, -1.0], action_high=[np.inf, 3.0]
    )
    policy, actor = load_policy(run / "policy", 0)
    outputs = act(policy, actor, OBSERVATIONS[0].astype(np.float32))
    expected = np.array(outputs[:2]) * [1.0, 2.0] + [0.0, 1.0]
    assert expected[1] > 3.0
    expected[1] = 3.0  # the first entry has no bounds
    np.testing.assert_allclose(load(run, 0).act(OBSERVATIONS[0]), expected, rtol=1e-6)


@pytest.mark.parametrize("shape", [(3,), (), (2, 3), (1, 2, 4), (4, 1)])
def test_another_observation_is_named(tmp_path, shape):
    with pytest.raises(ValueError, match=r"takes observations \[4\] or \[N, 4\], got one of shape"):
        load(make_run(tmp_path)).act(np.zeros(shape))


def remove(name):
    return lambda run: shutil.rmtree(run / name) if (run / name).is_dir() else (run / name).unlink()


def entries(name, **values):
    return lambda run: change(run / name, **values)


def arrays(**changes):
    return lambda run: change_arrays(run, **changes)


def signed(**entries):
    """Settings that were saved so, and that make no policy."""

    def spoil(run):
        change(run / JSON, **entries)
        change_arrays(run)

    return spoil


def content(name, value):
    return lambda run: (run / name).write_bytes(value)


def without(name):
    """An archive that lacks an array, with a checksum of what is left."""

    def spoil(run):
        with np.load(run / NPZ) as archive:
            kept = {x: archive[x] for x in archive if x not in (name, "checksum")}
        np.savez(run / NPZ, checksum="", **kept)
        change_arrays(run)

    return spoil


def flip_a_bit(run):
    path = run / "policy" / "actor.npz"
    damaged = bytearray(path.read_bytes())
    damaged[len(damaged) // 2] ^= 1
    path.write_bytes(damaged)


def cut(run):
    path = run / "policy" / "actor.npz"
    path.write_bytes(path.read_bytes()[:1000])


def as_objects(x):
    return x.astype(object)


def pack(run):
    with np.load(run / NPZ) as archive:
        np.savez_compressed(run / NPZ, **archive)


JSON, NPZ = "policy/policy.json", "policy/actor.npz"
#: What is done to a run, the file that the message names, and what it says besides.
DAMAGE = {
    "no run": (remove("config.json"), "config.json", "is not a run directory"),
    "config is no JSON": (content("config.json", b"["), "config.json", "is damaged"),
    "huge horizon": (entries("config.json", horizon=10**12), "config.json", "from 1 to 2^31 - 1"),
    "env is no text": (entries("config.json", env=None), "config.json", "env must be text"),
    "no policy": (remove("policy"), "", "still running, or was killed"),
    "no summary": (remove("summary.json"), "", "no final evaluation: its training is still"),
    "running": (entries("summary.json", status="running"), "", "no final evaluation"),
    "nothing finite": (entries("summary.json", final_returns=[None] * 3), "summary.json", "none"),
    "another env": (entries("config.json", env="Reacher-v5"), "config.json", "different runs"),
    "no settings": (remove(JSON), "policy.json", "cannot read"),
    "no family": (signed(policy=...), JSON, "policy is missing"),
    "deep settings": (content(JSON, b"[" * 100_000), "policy.json", "damaged"),
    "unknown family": (signed(policy="categoric"), JSON, "Did you mean"),
    "family of another space": (signed(policy="normal"), JSON, "is discrete"),
    "no sizes": (signed(hidden_sizes=...), JSON, "hidden_sizes is missing"),
    "another scaling": (entries(JSON, rescale=False), "policy.json", "checksum"),
    "no arrays": (remove(NPZ), NPZ, "cannot read"),
    "half an archive": (cut, NPZ, "not a whole NumPy archive"),
    "objects": (
        arrays(sign=False, normalizer__mean=as_objects),
        NPZ,
        "not a whole NumPy archive",
    ),
    "nan": (arrays(**{KERNEL: lambda x: x * np.nan}), NPZ, "seed 1 has numbers that are not"),
    "other numbers": (
        arrays(sign=False, normalizer__mean=lambda x: x + 1),
        "policy.json",
        "checksum",
    ),
    "a bit": (flip_a_bit, NPZ, "damaged"),
    "no kernel": (without(KERNEL.replace("__", "/")), NPZ, "Dense_0/kernel is missing"),
    "a row less": (arrays(**{KERNEL: lambda x: x[:, 1:]}), NPZ, "float32[3, 3, 8], and the set"),
    "a seed less": (arrays(**{KERNEL: lambda x: x[1:]}), NPZ, "make it float32[3, 4, 8]"),
    "one seed's counts": (arrays(normalizer__count=lambda x: x[:1]), NPZ, "make it float32[1"),
    "no seed": (arrays(normalizer__count=lambda x: x[:0]), NPZ, "normalizer/count is float32[0]"),
    "no axis of seeds": (arrays(normalizer__count=lambda x: x[0]), NPZ, "make it float32[1"),
    "complex": (arrays(**{KERNEL: lambda x: x + 0j}), NPZ, "kernel is complex64[3, 4, 8], and"),
    "whole numbers": (arrays(**{KERNEL: lambda x: x.astype(int)}), NPZ, "is int64[3, 4, 8], and"),
    "another byte order": (arrays(**{KERNEL: lambda x: x.astype(">f4")}), NPZ, "is >f4[3, 4, 8]"),
    "long numbers": (arrays(**{KERNEL: lambda x: x.astype("longdouble")}), NPZ, "is float128[3"),
    "text": (arrays(**{KERNEL: lambda x: x.astype("U9")}), NPZ, "is <U9[3, 4, 8], and"),
    "beyond float32": (
        arrays(**{KERNEL: lambda x: np.full(x.shape, 1e300)}),
        NPZ,
        "seed 1 has numbers that are not",
    ),
    "other layers": (
        signed(hidden_sizes=[9, 8]),
        NPZ,
        "Dense_0/bias is float32[3, 8], and",
    ),
    "huge layers": (signed(hidden_sizes=[10**9, 10**9]), "policy", "is damaged"),
    "deeper": (signed(hidden_sizes=[8, 8, 8]), NPZ, "Dense_3/bias is missing"),
    "fewer layers": (signed(hidden_sizes=[8]), NPZ, "Dense_2/bias is in no policy of these"),
    "another observation": (signed(observation_size=5), NPZ, "m2 is float32[3, 4], and"),
    "three actions": (signed(num_actions=3), NPZ, "and the settings of the policy make"),
    "many actions": (signed(num_actions=10**12), "policy", "is damaged"),
    "less than no action": (signed(num_actions=-2), JSON, "is damaged"),
    "half an observation": (signed(observation_size=4.5), JSON, "observation_size"),
    "compressed arrays": (pack, NPZ, "is compressed"),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", DAMAGE)
def test_damage_is_named_in_one_line(tmp_path, monkeypatch, capsys, name):
    """By ``load`` and both command lines, before anything is compiled."""
    damage, file, message = DAMAGE[name]
    damage(make_run(tmp_path))
    monkeypatch.setattr(watch, "check_drawing", lambda: None)
    with pytest.raises(ValueError, match=re.escape(message)) as caught:
        load(tmp_path)
    said = str(caught.value)
    assert file in said
    assert "\n" not in said
    for main in (watch.main, export.main):
        monkeypatch.setattr(sys, "argv", ["program", str(tmp_path)])
        with pytest.raises(SystemExit, match="2"):
            main()
        assert capsys.readouterr().err == f"error: {said}\n"


def test_the_damage_of_one_seed_leaves_the_others(tmp_path):
    make_run(tmp_path)

    def spoil(x):
        x[0] = np.inf
        return x

    change_arrays(tmp_path, **{KERNEL: spoil})
    assert load(tmp_path).seed == 1
    with pytest.raises(ValueError, match="of seed 0 has numbers that are not finite"):
        load(tmp_path, 0)
    with pytest.raises(ValueError, match="of seed 0 has numbers that are not finite"):
        load_policy(tmp_path / "policy")


@pytest.mark.parametrize(
    ("seed", "message"),
    [
        (3, "has no seed 3: its seeds are 0 to 2"),
        (-1, "has no seed -1: its seeds are 0 to 2"),
        ("first", "seed must be best, worst, median or a number, got 'first'"),
        (1.5, "got 1.5"),
    ],
)
def test_a_seed_that_is_none_is_named(tmp_path, seed, message):
    with pytest.raises(ValueError, match=message):
        load(make_run(tmp_path), seed)


def test_a_seed_by_its_number_needs_no_summary(tmp_path):
    make_run(tmp_path)
    (tmp_path / "summary.json").unlink()
    assert load(tmp_path, 2).seed == 2


def test_what_somebody_meant_is_named(tmp_path):
    with pytest.raises(
        ValueError, match=r"Did you mean 'Hopper-v5'\? Policies of the package: Ant"
    ):
        load("Hoper-v5")
    (tmp_path / "sweep.json").write_text("{}")
    with pytest.raises(ValueError, match="is a sweep: name the run of one of its configurations"):
        load(tmp_path)


def test_a_run_is_not_the_folder_of_its_policies(tmp_path, monkeypatch):
    """Whoever names the run, a sweep or a task hears of the folder; whoever has that, of no run."""
    run = make_run(tmp_path / "run")
    folder = re.escape(f"the folder of its policies is {run / 'policy'}: name that, or give {run} ")
    with pytest.raises(ValueError, match=f"{re.escape(str(run))} stands for a run, and {folder}"):
        load_policy(run)
    monkeypatch.setenv("HOME", str(tmp_path))
    with pytest.raises(ValueError, match=folder):
        load_policy("~/run")
    assert load_policy("~/run/policy", 0)
    with pytest.raises(ValueError, match="trained/CartPole-v1: name that, or give CartPole-v1 to"):
        load_policy("CartPole-v1")
    (tmp_path / "sweep.json").write_text("{}")
    with pytest.raises(ValueError, match="is a sweep: name the run of one of its configurations"):
        load_policy(tmp_path)
    # One's own policies, beside another program's config.json.
    write(run / "policy" / "config.json", {})
    assert load_policy(run / "policy", 0)
    (run / "policy.json").write_text("{}")
    with pytest.raises(ValueError, match=r"cannot read .*actor\.npz"):
        load_policy(run)
    with pytest.raises(ValueError, match=r"cannot read nowhere/policy\.json"):
        load_policy("nowhere")
    with pytest.raises(ValueError, match=r"cannot read .*policy\.json \(File name too long\)"):
        load_policy("x" * 300)


@pytest.mark.parametrize("place", ["policy", "policy/best"])
def test_the_run_around_a_folder_is_named(tmp_path, place):
    run = make_run(tmp_path, folder="policy/best")
    hint = f"; it is in the run {run}, so name that"
    for call in (
        lambda: load(run / place),
        lambda: read_directory(run / place),
        lambda: parse(["--resume", str(run / place)]),
        lambda: parse(["--like", str(run / place)]),
    ):
        with pytest.raises(ValueError, match=r"run|sweep") as caught:
            call()
        assert str(caught.value).endswith(hint)
    with pytest.raises(ValueError, match=r"there is no .*config.json$"):
        load(tmp_path.parent)
