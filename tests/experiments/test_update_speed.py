"""What an update's learning takes, with and without sums in groups."""

import dataclasses
import sys

import pytest

from experiments.speed import updates
from mjx_reinforce.settings.defaults import of_task


@pytest.mark.slow
@pytest.mark.cpu
def test_each_way_of_learning_is_timed():
    config = of_task("HalfCheetah-v5", num_seeds=2, minutes=1.0)
    small = {"num_episodes": 4, "train_horizon": 10, "value_fits": 2, "value_batch_size": 8}
    seconds = updates.measure("HalfCheetah-v5", dataclasses.replace(config, **small))
    assert [*seconds] == ["as it is", "one group", "one group, exact baseline"]
    assert all(x > 0 for x in seconds.values())


@pytest.mark.cpu
def test_without_a_gpu_there_is_nothing_to_compare(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["updates", "HalfCheetah-v5"])
    with pytest.raises(SystemExit):
        updates.main()
    assert "JAX finds none here" in capsys.readouterr().err
