"""Policies that a run begins with: the last policies of another run."""

import dataclasses

import jax
import numpy as np
import pytest
from flax import struct
from saved_runs import SPACES, make_run

from mjx_reinforce.export.policy_files import read_policy
from mjx_reinforce.settings.config import Config
from mjx_reinforce.training.state import begin_with, last_actors

POLICY = {"hidden_sizes": [8, 8], "initial_std": 0.5} | SPACES["InvertedPendulum-v5"]


@pytest.fixture
def config(tmp_path):
    """Settings of five seeds that begin with a run of three."""
    make_run(tmp_path / "old", "InvertedPendulum-v5")
    return Config(env="InvertedPendulum-v5", num_seeds=5, init_from=str(tmp_path / "old"))


def test_seeds_begin_with_those_of_the_other_run_in_turn(config):
    actors = last_actors(config, POLICY)
    old = read_policy(f"{config.init_from}/policy").actor
    for new, saved in zip(jax.tree.leaves(actors), jax.tree.leaves(old), strict=True):
        np.testing.assert_array_equal(new, np.asarray(saved)[[0, 1, 2, 0, 1]])


def test_how_the_first_parameters_were_drawn_does_not_matter(config):
    last_actors(config, POLICY | {"initial_std": 2.0, "initializer": "torch"})


def test_another_network_is_named(config):
    with pytest.raises(ValueError, match=r"have hidden_sizes .8, 8., and this run .4."):
        last_actors(config, POLICY | {"hidden_sizes": [4]})


def test_another_task_is_named(config):
    with pytest.raises(ValueError, match="v5, have observation_size 4, and this run 11; make them"):
        last_actors(config, POLICY | {"observation_size": 11})


def test_a_run_that_is_not_there(config, tmp_path):
    with pytest.raises(ValueError, match="nothing"):
        last_actors(dataclasses.replace(config, init_from=str(tmp_path / "nothing")), POLICY)


@struct.dataclass
class Part:
    actor: object = None
    train_states: object = None
    kept: int = 0


def test_a_state_begins_with_other_actors_in_its_own_dtypes():
    state = Part(train_states=Part(actor={"w": np.zeros(2, np.float32)}, kept=3), kept=4)
    begun = begin_with(state, {"w": np.array([1.0, 2.0])})
    assert begun.train_states.actor["w"].tolist() == [1, 2]
    assert begun.train_states.actor["w"].dtype == np.float32
    assert (begun.kept, begun.train_states.kept) == (4, 3)
    assert state.train_states.actor["w"].tolist() == [0, 0]
