"""Who plays in a film, from a run directory and from the package."""

import types
from pathlib import Path

import jax
import numpy as np
import pytest
from saved_runs import make_run

from mjx_reinforce.export import player as players
from mjx_reinforce.export.run_files import provenance_of
from mjx_reinforce.playing import cast


def settings(**changes):
    fields = {"seed": "best", "which": "last", "beside": None, "policy": None}
    return types.SimpleNamespace(**fields | changes)


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    """Returns of seeds 0, 1, 2 are 2, 7, 5."""
    return cast.read_source(make_run(tmp_path_factory.mktemp("run")))


@pytest.fixture
def packaged(monkeypatch):
    """The package's policy, which is not read."""
    player = types.SimpleNamespace(seed=3)
    monkeypatch.setattr(players, "load_pretrained", lambda env: (player, None))
    return cast.read_source(Path("Hopper-v5"))


def test_a_source_is_a_run_or_the_packages_policy(source, packaged):
    assert (source.env, source.horizon) == ("CartPole-v1", 60)
    assert source.run is not None
    made = provenance_of("Hopper-v5")
    assert packaged == ("Hopper-v5", made["horizon"], None)
    assert cast.main_seed(settings(), packaged) == made["seed"]


@pytest.mark.parametrize(("seed", "number"), [("best", 1), ("worst", 0), ("median", 2), (0, 0)])
def test_the_main_seed_is_that_of_the_run(source, seed, number):
    assert cast.main_seed(settings(seed=seed), source) == number


@pytest.mark.parametrize("changes", [{"seed": 1}, {"which": "best"}, {"beside": "worst"}])
def test_the_package_has_one_policy(packaged, changes):
    with pytest.raises(ValueError, match="the package has one policy for Hopper-v5; leave --seed"):
        cast.main_seed(settings(**changes), packaged)
    assert cast.main_seed(settings(beside="untrained"), packaged) >= 0


def test_one_policy_has_the_tasks_name(source, packaged):
    (alone,) = cast.cast(settings(seed=2), source)
    assert (alone.label, alone.name, alone.player.seed) == ("CartPole-v1", "seed 2", 2)
    (alone,) = cast.cast(settings(), packaged)
    assert (alone.label, alone.name) == ("Hopper-v5", "the package's policy")


def test_two_seeds_have_their_ranks(source):
    roles = cast.cast(settings(beside="worst"), source)
    assert [x.label for x in roles] == ["seed 0 (worst)", "seed 1 (best)"]
    assert [x.name for x in roles] == ["seed 0", "seed 1"]
    roles = cast.cast(settings(seed=2, beside=0), source)
    assert [x.label for x in roles] == ["seed 0", "seed 2"]


def test_before_training_the_parameters_are_random_and_nothing_is_scaled(source):
    before, after = cast.cast(settings(beside="untrained"), source)
    assert (before.label, before.name) == ("before training", "untrained")
    assert (after.label, after.name) == ("after training", "seed 1")
    first, last = before.player.actor, after.player.actor
    assert float(first.normalizer.count) == 0 < float(last.normalizer.count)
    drawn = after.player.policy.init(jax.random.key(1))
    jax.tree.map(np.testing.assert_array_equal, first.params, drawn)
    same = jax.tree.map(lambda x, y: bool(np.all(x == y)), first.params, last.params)
    assert not all(jax.tree.leaves(same))
