"""The page on failing seeds: its numbers from made-up runs with known answers, and its files."""

import numpy as np
import pytest

from experiments.studies.failures import __main__ as failures
from experiments.studies.failures import answers, measures, page
from experiments.studies.failures.runs import Measured, Setting, train

UPDATES = {
    # seed 0 solves and stays, 1 never solves, 2 falls in an update without a gradient, 3 with one
    "eval_return": [
        [20, 20, 20, 20],
        [1000, 30, 1000, 1000],
        [1000, 40, 500, 600],
        [1000, np.nan, 1000, 400],
    ],
    "gradient_norm": [[5, 5, 5, 5], [5, 5, 5, 5], [0, 5, 0, 5], [0, np.nan, 5, 5]],
    "env_steps": [[100] * 4, [200] * 4, [300] * 4, [400, np.nan, 400, 400]],
    "kl": [[1, 1, 1, 1], [1, 1, 1, 1], [1, 1, 2, 3], [1, np.nan, 4, 5]],
    "falls": [[4] * 4, [4] * 4, [0, 4, 1, 2], [0, np.nan, 2, 4]],
    "falls_at_rail_end": [[0] * 4, [0] * 4, [0, 0, 1, 0], [0, np.nan, 2, 1]],
    "saturated_units": np.full((4, 4), 0.25),
}


@pytest.fixture
def run():
    updates = {name: np.array(x, float) for name, x in UPDATES.items()}
    return Measured(updates, np.array([1000.0, 40.0, 1000.0, 400.0]), np.zeros(4))


def test_outcomes_of_seeds_that_stay_fail_and_fall(run):
    found = measures.outcomes(run)
    np.testing.assert_array_equal(found["steps_to_solve"], [300, np.nan, 300, 300])
    np.testing.assert_array_equal(found["evaluations"], [2, 0, 2, 2])
    np.testing.assert_array_equal(found["fallen"], [0, 0, 1, 2])


def test_falls_are_told_apart_by_their_gradient(run):
    found = measures.falls(run)
    assert (found["began"], found["began_without_gradient"]) == (2, 1)
    assert (found["updates_after"], found["quiet_updates"]) == (6, 3)
    assert found["kl_after"] == 1 + 1 + 2 + 4 + 3 + 5
    assert found["kl_without_gradient"] == 1 + 1 + 2
    assert found["saturated"] == 0.25
    assert (found["falls_next"], found["falls_next_at_rail_end"]) == (2 + 4, 2 + 1)


def test_joined_runs_keep_their_seeds_apart(run):
    short = run._replace(updates={name: x[:2] for name, x in run.updates.items()})
    both = measures.joined([run, short])
    assert both.updates["kl"].shape == (4, 8)
    assert np.isnan(both.updates["kl"][2:, 4:]).all()
    assert both.final_return.tolist() == run.final_return.tolist() * 2


def test_arms_are_compared_on_the_same_seeds():
    def seeds(failing, count):
        bad = np.arange(count) < failing
        steps = np.where(bad, np.nan, 100.0)
        returns = np.where(bad, 40.0, 1000.0)
        ones = np.ones(count)
        return {
            "final_return": returns,
            "final_sampled": np.where(np.arange(count) < 3, 1000.0, 40.0),
            "steps_to_solve": steps,
            "evaluations": ones,
            "fallen": 0 * ones,
        }

    kept = measures.Kept({"base": seeds(8, 100), "max-kl": seeds(0, 50)}, {}, [], [], {})
    base, other = answers.arms(kept)
    assert (base.failures, base.never, base.failing.value) == (8, 8, 0.08)
    assert (base.stand, other.stand) == (3, 0)
    assert (base.slowest, other.slowest) == (np.inf, 100)
    assert other.p_failing == pytest.approx(2 * 0.5**8)  # eight seeds apart, all the same way
    assert other.p_fallen == 1


def test_bounded_scale_and_budget_hold_in_a_training():
    setting = Setting(
        num_episodes=2,
        hidden_sizes=(4,),
        env_steps=60,
        max_updates=3,
        least_position_scale=0.2,
    )
    found = train(setting, range(2))
    made = np.isfinite(found.updates["kl"])
    before = np.nancumsum(found.updates["env_steps"], axis=0) - found.updates["env_steps"]
    assert made[0].all()
    assert (before[made] < 60).all()
    np.testing.assert_allclose(found.updates["scale_position"][1], 0.2, rtol=1e-6)
    assert found.final_return.shape == (2,)


def test_the_page_is_what_the_script_writes():
    kept = measures.load(failures.DATA)
    written = (failures.DOCS / "failures.md").read_text("utf-8")
    assert page.page(kept, answers.arms(kept)) == written
