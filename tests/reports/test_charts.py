"""The report's charts: which there are, what is said of each, and what they say to Vega-Lite."""

import json

import numpy as np
import pytest
from fake_sweeps import make_sweep
from measured_runs import ONE, make_measured_run
from pages import findings_of

from mjx_reinforce.reports import charts, findings, words
from mjx_reinforce.reports.document import draw_charts


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    """Of six configurations of two settings."""
    over = {"learning_rate": [1e-3, 1e-2], "discount": [0.98, 0.99, 0.995]}
    directory = make_sweep(tmp_path_factory.mktemp("sweep"), num_seeds=4, evaluations=5, over=over)
    return findings_of(directory)


@pytest.fixture(scope="module")
def drawn(found):
    return {each.name: each for each in draw_charts(found)}


def parts(spec, key):
    """All values of a key, wherever it stands."""
    if isinstance(spec, dict):
        for name, value in spec.items():
            if name == key:
                yield value
            yield from parts(value, key)
    elif isinstance(spec, list):
        for value in spec:
            yield from parts(value, key)


def numbers(found):
    return [(each.number, each.name) for each in draw_charts(found)]


@pytest.mark.slow
def test_settings_share_a_number_and_others_count_up(found):
    names = ("final", "curves", "solved", "distribution")
    settings = [(5, "sensitivity-0"), (5, "sensitivity-1")]
    assert numbers(found) == [*enumerate(names, start=1), *settings]
    alone = found._replace(results=found.results[:1])  # has no ranks and no settings
    assert numbers(alone) == [*enumerate(names[1:], start=1)]


@pytest.mark.slow
def test_without_a_threshold_nothing_is_solved(found):
    experiment = found.experiment._replace(threshold=None)
    without = findings.compute_findings(experiment)
    assert [name for _, name in numbers(without)][:3] == ["final", "curves", "distribution"]
    assert all("solved" not in json.dumps(each.spec) for each in draw_charts(without))
    assert charts.threshold_line(without, "x", np.arange(2000)) == []


def test_terms_of_the_reward_have_a_line_each(tmp_path):
    """The mean over seeds; a term that is 0 throughout too. Of several runs the best one's."""
    terms = ("reward_forward", "reward_ctrl")
    worse, best = (
        make_measured_run(tmp_path / name, offset=offset, terms=terms)
        for name, offset in (("worse", 0.0), ("best", 50.0))
    )
    made = {each.name: each for each in draw_charts(findings_of(worse, best))}
    table = made["terms"].data["terms"]
    ends = dict(zip(table["term"], table["sum"], strict=True))  # the last of each
    assert ends == {"reward_forward": 0, "reward_ctrl": 100 + 30 + 50}
    assert [*ends] == [*terms]
    assert "of best alone" in made["terms"].caption
    assert [each.name for each in made.values()].index("terms") < [*made].index("distribution")
    without = make_measured_run(tmp_path / "without")
    assert "terms" not in {each.name for each in draw_charts(findings_of(without))}


def test_axes_end_where_the_data_do(found, drawn):
    """A threshold beyond what a figure shows is not drawn."""
    finals = np.concatenate([each.final for each in found.results])
    for threshold, inside in ((-1e9, False), (np.nanmedian(finals), True), (1e9, False)):
        experiment = found.experiment._replace(threshold=float(threshold))
        other = found._replace(experiment=experiment)
        assert bool(charts.threshold_line(other, "x", finals)) == inside
    far = findings.compute_findings(found.experiment._replace(threshold=123_456.0))
    made = {each.name: each for each in draw_charts(far)}
    assert "solved" not in made
    assert "123456" not in json.dumps([each.spec for each in made.values()])
    assert "123,456.0, lies beyond the figure" in made["curves"].caption
    assert "lies beyond" not in drawn["curves"].caption


def test_defaults_are_named_where_settings_are_compared(found):
    """What a reviewer asks first; of a task without settings of its own there is nothing to say."""
    said = "tuned for one value of learning rate and discount"
    assert any(said in one for one in words.caveats(found))
    own = found._replace(experiment=found.experiment._replace(env="own:Task"))
    assert not any(said in one for one in words.caveats(own))


@pytest.mark.parametrize(
    ("num_seeds", "covered"), [(6, "88.2%"), (8, "94.2%"), (9, None), (5, None)]
)
def test_the_page_says_what_few_seeds_may_not_show(tmp_path, num_seeds, covered):
    """That is, one group of two; with fewer than six seeds there is no interval."""
    found = findings_of(make_sweep(tmp_path, num_seeds=num_seeds, evaluations=3, over=ONE))
    said = [one for one in words.caveats(found) if "two groups far apart" in one]
    assert len(said) == (covered is not None)
    assert all(f"at most {covered} of the time" in one for one in said)


def test_captions_have_the_numbers_of_the_findings(found, drawn):
    label = found.labels[0]
    assert drawn["final"].alt.startswith(f"6 rows, best first. The best, {label}, is at ")
    assert "reached 950.0 at" in drawn["solved"].caption
    assert [drawn[f"sensitivity-{n}"].title for n in range(2)] == ["learning rate", "discount"]
    assert "over discount;" in drawn["sensitivity-1"].alt


def test_a_chart_draws_what_it_names(found, drawn):
    """Data under these names alone, and of the configurations shown at first, the best four."""
    for each in drawn.values():
        named = {x["name"] for x in parts(each.spec, "data") if "name" in x}
        assert named == {*each.data}, each.name
        assert each.listed is None or each.listed in each.data
        assert each.spec["description"] == each.alt
        assert each.spec["config"] == charts.CONFIG
        assert each.spec["width"] == "container"
        assert {x["name"]: x["value"] for x in each.spec["params"] if "value" in x} == {
            "shown": found.labels[:4],
            "at": found.grid[-1],
            "moment": len(charts.slider_stops(found)) - 1,
            "logarithmic": False,
        }


def test_a_chart_becomes_a_file_of_each_kind(found, drawn):
    files = charts.render_chart(drawn["final"], found.labels, "Final returns")
    assert files["png"].startswith(b"\x89PNG")
    assert files.keys() == {"png", "svg"}
    assert b"Final returns" in files["svg"]
    assert b"var(--" not in files["svg"]  # the page's colors, by their values in light


TABLE = {"configuration": [1, 0], "value": [2.5, None]}


def test_rows_have_the_labels_of_their_configurations():
    assert charts.rows(TABLE, ["first", "second"]) == [
        {"configuration": "second", "value": 2.5},
        {"configuration": "first", "value": None},
    ]
    assert charts.rows({"value": [1]}, []) == [{"value": 1}]


def test_numbers_have_a_few_digits_and_what_is_not_finite_is_none():
    assert charts.short([1234567.0, 0.123456789, np.nan, np.inf, 3.0]) == [
        1234600,
        0.12346,
        None,
        None,
        3,
    ]
    assert charts.short(0.123456789, 2) == [0.12]
    assert [type(x) for x in charts.short([2.0, 2.5, 1e20])] == [int, float, float]


def test_tables_stand_below_each_other():
    """What is no list is the same in all rows of its table."""
    table = charts.stacked([TABLE, {"configuration": 3, "value": [4, 5]}])
    assert table == {"configuration": [1, 0, 3, 3], "value": [2.5, None, 4, 5]}
