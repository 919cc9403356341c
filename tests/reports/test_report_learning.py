"""What a report says of the speed of learning, and what lies beside the page."""

import re
import types

import numpy as np
import pytest
from fake_sweeps import make_sweep
from measured_runs import make_measured_run
from pages import change_curves, findings_of, visible

from mjx_reinforce import report
from mjx_reinforce.reports import findings, listings, words
from mjx_reinforce.statistics.comparisons import holm
from mjx_reinforce.statistics.survival import log_rank

RATES = {"learning_rate": [1e-3, 3e-3, 1e-2]}


def all_solve(directory, first):
    """Lets all seeds end alike, those of configuration i having solved it at ``first[i]``."""

    def change(arrays):
        returns = arrays["eval_return"]
        returns[:] = 20.0
        for i, evaluation in enumerate(first):
            returns[evaluation:, arrays["configuration"] == i] = 1000.0

    change_curves(directory, change)


@pytest.fixture(scope="module")
def crossed(tmp_path_factory):
    """A sweep over two settings, and its figures."""
    directory = make_sweep(
        tmp_path_factory.mktemp("sweeps") / "sweep",
        num_seeds=30,
        over={"learning_rate": [1e-3, 3e-3], "discount": [0.98, 0.99, 0.995]},
    )
    report.write_report([directory], directory / "report.html")
    return directory, findings_of(directory)


def test_seeds_that_all_solve_are_told_apart_by_their_speed(tmp_path):
    directory = make_sweep(tmp_path / "sweep", num_seeds=24, over=RATES)
    all_solve(directory, [6, 2, 9])
    found = findings_of(directory)
    said = words.headline(found)
    assert said[0] == "The fastest is learning rate 0.003. The final returns are a tie."
    rows = listings.listings(found)["speed"]["rows"]
    assert [row["label"][-5:] for row in rows] == ["0.003", "0.001", " 0.01"]
    assert rows[0]["cells"][2][0] == "fastest"
    assert rows[1]["cells"][2][0] == "< 0.001"


def test_equal_speeds_are_not_told_apart(tmp_path):
    directory = make_sweep(tmp_path / "sweep", num_seeds=24, over=RATES)
    all_solve(directory, [4, 4, 4])
    found = findings_of(directory)
    assert not re.search("faster|fastest", " ".join(words.headline(found)))
    assert {*found.speeds.values()} == {1.0}


def test_what_is_surely_slower_is_named_where_two_are_equally_fast(tmp_path):
    directory = make_sweep(tmp_path / "sweep", num_seeds=24, over=RATES)
    all_solve(directory, [6, 2, 2])
    said = words.headline(findings_of(directory))
    faster = "learning rate 0.01 is surely faster than learning rate 0.001"
    assert said[0] == f"{faster}. The final returns are a tie."


def test_nobody_solves_it_is_no_race(tmp_path):
    directory = make_sweep(tmp_path / "sweep", num_seeds=12, over=RATES)
    change_curves(directory, lambda x: np.minimum(x["eval_return"], 500, out=x["eval_return"]))
    found = findings_of(directory)
    assert not re.search("faster|fastest", " ".join(words.headline(found)))
    table = listings.listings(found)["speed"]
    assert table["header"][2:] == ["return while training"]
    areas = sorted((each.area.value for each in found.results), reverse=True)
    assert [float(row["cells"][0][0]) for row in table["rows"]] == pytest.approx(areas, abs=0.05)


@pytest.mark.slow
def test_every_figure_is_a_vector_and_every_table_has_a_number(crossed):
    beside, page = crossed[0] / "report", crossed[0] / "report.html"
    buttons = set(re.findall(r'data-png="([^"]+)"', page.read_text(encoding="utf-8")))
    assert buttons == {path.stem for path in beside.glob("*.png")}
    names = ("final", "curves", "solved", "distribution")
    assert buttons == {*names, "sensitivity-0", "sensitivity-1"}
    for path in beside.glob("*.png"):
        assert path.read_bytes().startswith(b"\x89PNG")
        svg = path.with_suffix(".svg").read_text(encoding="utf-8")
        assert svg.startswith("<svg")
        assert "var(--" not in svg
    assert {path.suffix for path in beside.iterdir()} == {".png", ".svg", ".csv"}
    numbers = re.findall(r"Table (\d)\.", visible(crossed[0] / "report.html"))
    assert numbers == ["1", "2", "3", "4", "5"]


def test_a_run_is_told_in_plain_words(tmp_path):
    directory = make_measured_run(tmp_path / "run", num_seeds=3, offset=150.0)
    said = words.headline(findings_of(directory))
    assert said[0].startswith("3 seeds of CartPole-v1 ended with a mean return of ")
    assert " before training." in said[0]


def result(steps=None, *, solved=None, mean=None):
    if steps is None:
        return types.SimpleNamespace(solving=None)
    solved = np.full(len(steps), True) if solved is None else np.asarray(solved)
    value = types.SimpleNamespace(value=steps.mean() if mean is None else mean)
    solving = types.SimpleNamespace(steps=steps, solved=solved, ever=solved.sum(), mean=value)
    return types.SimpleNamespace(solving=solving)


QUICK, SLOW = np.arange(100, 160, 10), np.arange(400, 1000, 100)


def test_speeds_are_log_rank_tests_of_all_pairs():
    solved = [True, True, False, True, True, True]
    results = [result(QUICK), result(SLOW, solved=solved), result(SLOW)]
    speeds = findings.compare_speeds(results)
    assert [*speeds] == [(0, 1), (0, 2), (1, 2)]
    exact = [
        log_rank(*(x for k in pair for x in (results[k].solving.steps, results[k].solving.solved)))
        for pair in ((0, 1), (0, 2), (1, 2))
    ]
    np.testing.assert_allclose([*speeds.values()], holm([x.p_value for x in exact]))
    assert speeds[0, 1] < 0.01 < speeds[1, 2]
    assert findings.compare_speeds([result(), result()]) == {}
    assert findings.compare_speeds([result(QUICK, solved=[False] * 6)] * 2) == {}


def test_the_fastest_has_the_fewest_mean_steps():
    results = [result(SLOW), result(SLOW, mean=1), result(QUICK)]
    assert findings.by_speed(results) == [1, 2, 0]
