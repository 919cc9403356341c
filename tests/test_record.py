"""What a run measures: counts, numbers that are not finite, and going on where it was."""

import numpy as np

from mjx_reinforce.runs.config import Config
from mjx_reinforce.runs.record import Record


def block(random, num_updates, num_seeds, first):
    """Metrics of a block in which the last seed stands still after its first update."""
    active = np.ones((num_updates, num_seeds), bool)
    active[1:, -1] = False
    made = first + np.cumsum(active, axis=0)
    names = ("episode_return", "episode_length", "entropy", "gradient_norm")
    floats = {name: random.normal(size=active.shape).astype(np.float32) for name in names}
    return floats | {
        "active": active,
        "updates_total": made.astype(np.int32),
        "env_steps_total": (10 * made).astype(np.int32),
        "simulated_steps": random.integers(1, 99, active.shape, np.int32),
        "nonfinite_episodes": random.integers(0, 2, active.shape, np.int32),
        "skipped_update": random.integers(0, 2, active.shape, np.int32),
    }


def evaluation(*returns):
    values = np.array(returns, np.float32)
    whole = {"eval_return": values, "eval_return_stochastic": values / 2, "eval_length": values}
    return whole | {"simulated_steps": np.full(len(values), 7, np.int32)}


def filled():
    """A record of three seeds, two blocks and three evaluations."""
    record, random = Record(Config(num_seeds=3, max_updates=100), 2.0), np.random.default_rng(0)
    record.add_evaluation(evaluation(1, 2, 3), 0.1)
    for i in range(2):
        record.add_updates(block(random, 4, 3, record.updates))
        record.add_evaluation(evaluation(i, np.nan, -3.5), 1.0 + i / 3)
    return record


def same(one, other):
    assert list(one) == list(other)
    for name in one:
        assert one[name].dtype == other[name].dtype
        np.testing.assert_array_equal(one[name], other[name], err_msg=name)


def test_a_record_is_restored_exactly(tmp_path):
    """It goes through an archive; what the copy measures after that is the same too."""
    record = filled()
    np.savez(tmp_path / "record.npz", allow_pickle=False, **record.arrays())
    copy = Record(Config(num_seeds=3, max_updates=100), 2.0)
    with np.load(tmp_path / "record.npz", allow_pickle=False) as archive:
        copy.restore(dict(archive))
    for i in range(2):
        same(record.arrays(), copy.arrays())
        same(record.history(), copy.history())
        same(record.training(), copy.training())
        assert repr(record.summary("fused", 1.0, 2.0)) == repr(copy.summary("fused", 1.0, 2.0))
        assert repr(record.progress()) == repr(copy.progress())
        both = []
        for x in (record, copy):
            x.add_updates(block(np.random.default_rng(i), 5, 3, x.updates))
            both.append(x.add_evaluation(evaluation(5, 6, i), 3.0))
        assert repr(both[0]) == repr(both[1])


def test_a_record_of_nothing_is_restored():
    record, copy = (Record(Config(num_seeds=2), None) for _ in range(2))
    copy.restore(record.arrays())
    same(record.arrays(), copy.arrays())
    assert copy.add_evaluation(evaluation(1, 2), 0.5)[0]["train_return"] == ""
