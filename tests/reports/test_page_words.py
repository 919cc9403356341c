"""What the page says beside its numbers: which test, which two, what is drawn, what a run is."""

import html
import re

import numpy as np
import pytest
import vl_convert
from fake_sweeps import make_sweep
from measured_runs import ONE, make_measured_run
from pages import change_curves, findings_of, visible

from mjx_reinforce import report
from mjx_reinforce.reports import words
from mjx_reinforce.reports.document import draw_charts


@pytest.fixture(autouse=True)
def text_alone(monkeypatch):
    """Leaves out what takes seconds: the pictures beside the page, and Vega in it."""
    monkeypatch.setattr(report, "render_chart", lambda *_: {})
    monkeypatch.setattr(vl_convert, "javascript_bundle", lambda code: code)


def page_of(*directories):
    page = directories[0].parent / "page.html"
    report.write_report(directories, page)
    return page


def captions(page):
    """The captions of the figures, by their names."""
    found = re.findall(r'<figcaption id="caption-(\w+)">(.*?)</figcaption>', page.read_text(), re.S)
    return {name: html.unescape(re.sub("<[^>]+>", "", text)) for name, text in found}


@pytest.fixture
def two_groups(tmp_path):
    """The best: 16 of 40 seeds at 1,000, the others at 200; the next: all near 450."""
    directory = make_sweep(tmp_path / "sweep", num_seeds=40, over=ONE)

    def change(arrays):
        last, first = arrays["eval_return"][-1], arrays["configuration"] == 0
        last[first] = np.where(np.arange(40) < 16, 1000, 200) + np.arange(40)
        last[~first] = 450 + np.arange(40)

    change_curves(directory, change)
    return directory


def test_the_best_that_seldom_wins_is_explained(two_groups, tmp_path):
    """Its mean is 70 above, and it wins 40% of the pairs: 16 x 40 of 40 x 40."""
    (pair,) = words.of_best(findings_of(two_groups))
    assert (pair.difference.value, pair.improvement.value) == (pytest.approx(70), 0.4)
    said = "better in less than half of the pairs of seeds: it wins by more than it loses by"
    assert f"The best has a higher mean than learning rate 0.003, but is {said}" in visible(
        page_of(two_groups)
    )
    agree = make_sweep(tmp_path / "agree", num_seeds=40, over=ONE)
    assert said not in visible(page_of(agree))


def test_the_tests_are_named(two_groups):
    """The p values are of pairs of seeds, the seeds needed of seeds that are not paired."""
    said = visible(page_of(two_groups))
    assert re.search(
        r"p = \d\.\d+ by the paired t-test, after Holm's correction for 1 pair\)", said
    )
    assert "p values of the paired t-test, which compares seed by seed" in said
    assert re.search(r"find the difference four times out of five, by Welch's test,", said)
    assert "the wrong one of these two would have won" in said


def test_captions_name_what_is_drawn(tmp_path):
    """Four seeds have no intervals, and one configuration no rows."""
    few = captions(page_of(make_measured_run(tmp_path / "few", num_seeds=4)))
    many = captions(page_of(make_sweep(tmp_path / "many", num_seeds=12, over=ONE)))
    four = captions(page_of(make_sweep(tmp_path / "four", num_seeds=4, over=ONE)))
    assert "its 95% bootstrap interval" in many["curves"]
    assert "With one configuration shown, thin lines are single seeds" in many["curves"]
    assert "Thin lines are single seeds" in few["curves"]
    for drawn in (few, four):
        assert "interval" not in drawn["curves"]
    assert "thick lines their 95% intervals" in many["final"]
    assert "95%" not in four["final"] + four["sensitivity"]
    assert "its 95% interval" in many["sensitivity"]
    assert "each row" in many["distribution"]
    assert "row" not in few["distribution"]
    for drawn in (few, many):
        assert "a dotted line marks that time in the curves" in drawn["distribution"]
        assert "dotted" not in drawn["curves"]


def test_without_a_slider_none_is_named(tmp_path):
    """A run that was stopped at its first evaluation has one moment."""
    page = page_of(make_measured_run(tmp_path / "run", evaluations=1))
    assert "slider" not in captions(page)["distribution"]
    assert "dotted" not in captions(page)["distribution"]
    assert '<div class="controls slider" hidden>' in page.read_text()


def test_intervals_of_shares_are_named_where_they_are_drawn(tmp_path):
    """Where all seeds solve it at once there is no band."""
    directory = make_sweep(tmp_path / "sweep", num_seeds=12, over=ONE)
    (solved,) = (x for x in draw_charts(findings_of(directory)) if x.name == "solved")
    assert "pointwise 95% interval" in solved.caption
    change_curves(directory, lambda arrays: arrays["eval_return"].fill(1000.0))
    (solved,) = (x for x in draw_charts(findings_of(directory)) if x.name == "solved")
    assert "interval" not in solved.caption


def test_a_run_is_called_by_its_task(tmp_path):
    """Its directory has the time in its name; several runs are told apart by theirs."""
    directory = make_measured_run(tmp_path / "CartPole-v1-20261128-185530-074", num_seeds=4)
    assert findings_of(directory).labels == ["CartPole-v1"]
    said = visible(page_of(directory))
    assert "The worst seeds of CartPole-v1." in said
    other = make_measured_run(tmp_path / "CartPole-v1-20261128-185530-075", num_seeds=4)
    assert sorted(findings_of(directory, other).labels) == [directory.name, other.name]


def test_what_is_solved_is_said_where_it_is_counted(tmp_path):
    directory = make_measured_run(
        tmp_path / "run", num_seeds=4, env="Hopper-v5", summary={"threshold": 3800.0}
    )
    page = page_of(directory)
    assert "Solved: a return of 3,800.0, the threshold of Hopper-v5, or more." in visible(page)
    assert "(no interval below six seeds)" in visible(page)


def test_the_page_says_when_a_sweep_stopped_and_why(tmp_path):
    """The excluded come last, also with a higher mean on their fewer seeds."""
    decision = {
        "contenders": [1],
        "num_seeds": [8, 16, 16],
        "looks": [8, 16],
        "budget": 64,
        "is_over": True,
    }
    over = {"learning_rate": [1e-3, 3e-3, 1e-2]}
    directory = make_sweep(tmp_path / "sweep", num_seeds=16, over=over, decision=decision)

    def change(arrays):
        is_kept = (arrays["configuration"] > 0) | (arrays["seed"] < 8)
        for name, array in arrays.items():
            arrays[name] = array[..., is_kept]
        for member, mean in enumerate((900, 800, 300)):
            is_own = arrays["configuration"] == member
            arrays["eval_return"][-1, is_own] = mean + arrays["seed"][is_own]

    change_curves(directory, change)
    findings = findings_of(directory)
    assert findings.order == [1, 0, 2]
    said = visible(page_of(directory))
    assert "stopped after 16 of at most 64 seeds: learning rate 0.003 is surely the best." in said
    excluded = "Surely below another: learning rate 0.001 after 8 seeds, learning rate 0.01 after"
    assert f"{excluded} 16 seeds (sequential test, 2 looks;" in said
    assert "The returns decided how many seeds there are" in said
    # Of the seeds that both have, also where a third has fewer.
    seeds = [findings.results[pair.first].configuration.seed for pair in findings.comparisons]
    assert len(findings.comparisons) == 3
    assert max(map(len, seeds)) == 16

    open_decision = decision | {"contenders": [1, 2], "looks": [8], "is_over": False}
    make_sweep(tmp_path / "open", num_seeds=16, over=over, decision=open_decision)
    said = visible(page_of(tmp_path / "open"))
    assert "has not decided yet, after 8 of at most 64 seeds." in said
    assert "Any of these may be the best: learning rate 0.003, learning rate 0.01." in said


def test_a_decision_about_other_configurations_is_damage(tmp_path):
    decision = {"contenders": [0], "num_seeds": [8], "looks": [8], "budget": 64, "is_over": True}
    directory = make_sweep(tmp_path / "sweep", over=ONE, decision=decision)
    with pytest.raises(ValueError, match=r"sweep.json is damaged.*not about 2 configurations"):
        findings_of(directory)


def test_reliability_by_hand(tmp_path):
    """Of 40 seeds the lowest is the bound, and a drop is from the highest evaluation."""
    directory = make_sweep(tmp_path / "sweep", num_seeds=40, over=ONE)

    def change(arrays):
        arrays["eval_return"][:] = 100.0
        arrays["eval_return"][0] = 0.0
        arrays["eval_return"][-1] = 60.0 + arrays["seed"]
        arrays["eval_return"][-1, arrays["configuration"] == 1] /= 2

    change_curves(directory, change)
    findings = findings_of(directory)
    assert [result.floor for result in findings.results] == [60, 30]
    assert findings.results[0].drops.tolist() == [100 - (60 + seed) for seed in range(40)]
    said = visible(page_of(directory))
    assert re.search(r"90% of runs return at least drop after the peak .* 60\.0 20\.5", said)
    # The means are 79.5 and half of that, from 0: one by lot has three quarters.
    assert "one drawn by lot lacks 25% of the best's gain" in said
    assert "needs 29 seeds" in visible(page_of(make_sweep(tmp_path / "few", num_seeds=12)))
