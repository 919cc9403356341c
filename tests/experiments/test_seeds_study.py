"""The seeds study: its statistics, and its page from made-up numbers with a known answer."""

import numpy as np
import pytest
from scipy import stats

from experiments.studies.seeds import __main__ as seeds
from experiments.studies.seeds import few as seeds_few
from experiments.studies.seeds import runs as seeds_runs
from experiments.studies.seeds.answers import (
    CONTRASTS,
    HALVES,
    at_best,
    best_rates,
    effects,
    paired_iqm_difference,
)
from experiments.studies.seeds.few import few_seeds
from experiments.studies.seeds.runs import Task, load, measure, save

#: With a rate more than in the study, so that two are below its best and two are not.
FACTORS = seeds_runs.FACTORS | {
    "estimator": ["reward-to-go", "leave-one-out", "value-baseline"],
    "learning_rate": [3e-3, 1e-2, 3e-2, 1e-1],
}
SHAPE = tuple(len(values) for values in FACTORS.values())
SEEDS, BUDGET, COUNTS = 200, 1000, seeds_few.COUNTS
LEARNED, _, _, GAMMA, _ = CONTRASTS


def made_up(name, baseline, normalize):
    """A task whose runs differ by known amounts.

    A learned baseline adds ``baseline`` to every return; normalizing adds ``normalize`` at the two
    lower learning rates and takes it away at the two higher ones; nothing else matters. The third
    learning rate is the best without normalizing, the second one with it.
    """
    random = np.random.default_rng(0)
    returns = 50 + random.normal(size=(*SHAPE, SEEDS))
    returns[FACTORS["estimator"].index("value-baseline")] += baseline
    returns += np.array([-10.0, -1.0, 0.0, -10.0])[:, None]
    sign = np.array([1.0, 1.0, -1.0, -1.0])[:, None]
    returns[:, :, FACTORS["standardize"].index(True)] += normalize * sign
    return Task(
        name=name,
        factors=FACTORS,
        threshold=50.0,
        budget=BUDGET,
        untrained=0.0,
        final_return=returns,
        average_return=returns - 10,
        steps_to_solve=np.where(returns >= 50, 500.0, BUDGET),
        env_steps=np.full(returns.shape, BUDGET),
        record={
            "env": name,
            "num_seeds": SEEDS,
            "settings": {
                "hidden_sizes": [32, 32],
                "value_hidden_sizes": [32, 32],
                "value_fits": 10,
                "max_updates": 150,
            },
            "nonfinite_runs": 0,
            "compile_seconds": 1.0,
            "run_seconds": 2.0,
            "engine": "vmap",
            "num_devices": 1,
            "device": "a GPU",
            "git_commit": "abc",
            "packages": {"jax": "1"},
        },
    )


@pytest.fixture(scope="module")
def tasks():
    return [made_up("Up-v0", baseline=5.0, normalize=3.0), made_up("Down-v0", -5.0, 0.0)]


@pytest.fixture(scope="module")
def found(tasks):
    return effects(tasks)


def only(found, task, contrast, measure, where):
    wanted = (task, contrast.name, measure, where)
    (effect,) = [e for e in found if (e.task, e.contrast, e.measure, e.where) == wanted]
    return effect


@pytest.mark.parametrize(("task", "sign"), [("Up-v0", 1), ("Down-v0", -1)])
@pytest.mark.parametrize("where", ["best", "all", "0.003"])
def test_a_known_difference_is_found(found, task, sign, where):
    effect = only(found, task, LEARNED, "average return", where)
    assert effect.difference.value == pytest.approx(5 * sign, abs=0.4)
    assert effect.difference.low < effect.difference.value < effect.difference.high
    assert effect.direction == sign
    assert effect.adjusted > effect.difference.p_value


def test_the_rates_are_not_chosen_on_the_seeds_that_are_reported(tasks):
    task = tasks[1]
    returns = task.average_return.copy()
    returns[..., 0, 1::2] += 1000  # the worst rate, on the other half
    changed = task._replace(average_return=returns)
    assert [best_rates(changed, GAMMA, half)[0] for half in HALVES] == [3e-2, 3e-3]
    for values in at_best(changed, "average return", GAMMA):
        assert values.max() < 60
        assert values[HALVES[1]].mean() == pytest.approx(40, abs=0.5)  # less what the rate takes
        assert values[HALVES[0]].mean() == pytest.approx(30, abs=0.5)
    (effect, *_) = (e for e in effects([changed]) if e.contrast == GAMMA.name)
    assert effect.rates == ((3e-3, 3e-2), (3e-3, 3e-2))


@pytest.mark.slow
def test_the_tables_say_what_the_numbers_are(tasks, tmp_path, monkeypatch):
    monkeypatch.setattr(seeds_few, "_DRAWS", 20)
    for task in tasks:
        (tmp_path / task.name).mkdir()
        save(task, tmp_path / task.name)
        assert load(tmp_path / task.name).record == task.record
    page = tmp_path / "seeds.md"
    marks = ("tasks", "effects", "few", "pairs")
    page.write_text("".join(f"<!-- {name} -->\nbefore\n<!-- end -->\n" for name in marks))
    seeds.write([tmp_path / task.name for task in tasks], page)
    text = page.read_text()
    assert "before" not in text
    assert "| Up-v0 | 0 | 50 | 32 and 32 | 1,000 | 0.0% | 0 | vmap | 1 s, 2 s |" in text
    row = next(x for x in text.splitlines() if x.startswith(f"| {LEARNED.name} | Up-v0 |"))
    assert "**+5." in row
    assert row.endswith("| 100 |")
    assert f"| final return | Up-v0 | {LEARNED.name} | yes |" in text
    assert text.count("| average return | Down-v0 |") == len(CONTRASTS) + 1


def test_few_seeds_against_the_normal_distribution(tasks):
    """Two arms 1 apart, of standard deviation 1: the means of n differ by 1 +- sqrt(2 / n)."""
    task = tasks[1]
    returns = task.final_return.copy()
    one, other = (FACTORS["discount_weights"].index(x) for x in (True, False))
    noise = stats.norm.ppf((np.arange(SEEDS) + 0.5) / SEEDS)
    returns[:, one], returns[:, other] = 1 + noise, noise
    found = few_seeds([task._replace(final_return=returns)], ["final return"], COUNTS)
    (few,) = [few for few in found if few.contrast == GAMMA.name]
    assert few.sure
    for count in (3, 10):
        expected = stats.norm.sf(np.sqrt(count / 2))
        assert few.wrong[count] == pytest.approx(expected, abs=0.02)
    assert few.needed == pytest.approx(17, abs=2)  # of Student's t-test, from tables


def test_iqm_difference_by_simulation():
    """Its interval covers, and its test decides as its interval does."""
    random = np.random.default_rng(0)
    covered = 0
    for _ in range(400):
        shared = random.normal(size=64)
        x, y = shared + 0.5 * random.standard_t(3, 64), shared + 0.5 * random.standard_t(3, 64) + 1
        difference = paired_iqm_difference(x, y)
        covered += difference.low <= -1 <= difference.high
        assert (difference.p_value < 0.05) == (difference.high < 0 or difference.low > 0)
    assert 0.92 < covered / 400 < 0.98


def test_iqm_difference_by_hand():
    """Of eight seeds the middle four count; y is x in reverse order, less 1."""
    x, y = np.arange(8.0), np.arange(8.0)[::-1] - 1
    difference = paired_iqm_difference(x, y)
    assert difference.value == 1
    winsorised = np.array([2.0, 2, 2, 3, 4, 5, 5, 5])
    error = np.sqrt(8 * np.var(2 * winsorised) / 12)
    assert difference.p_value == pytest.approx(2 * stats.t.sf(1 / error, 3))
    assert difference.high - 1 == pytest.approx(stats.t.ppf(0.975, 3) * error)


def test_runs_are_measured(tmp_path):
    """Two seeds of two configurations, by hand; one return is not finite."""
    from mjx_reinforce.files import write_arrays, write_json

    runs = {
        "configuration": np.array([0, 0, 1, 1]),
        "seed": np.array([0, 1, 0, 1]),
        "eval_return": np.array([[0, 0, 0, 0], [10, 2, np.nan, 10], [10, 4, 6, 8]], np.float32),
        "env_steps": np.array([[0, 0, 0, 0], [50, 50, 50, 120], [100, 100, 90, 150]], np.int32),
    }
    write_arrays(tmp_path / "curves.npz", runs)
    over = {"learning_rate": [0.1, 0.2]}
    facts = {"env": "X", "threshold": 5, "over": over, "settings": {"env_steps": 100}}
    write_json(tmp_path / "sweep.json", facts)
    task = measure(tmp_path)
    np.testing.assert_allclose(task.final_return, [[10, 4], [6, 8]])
    np.testing.assert_allclose(task.steps_to_solve, [[50, 100], [90, 100]])
    np.testing.assert_allclose(task.average_return[0], [7.5, 2.0], atol=0.01)
    assert task.record["nonfinite_runs"] == 1
