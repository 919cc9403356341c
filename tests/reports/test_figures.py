"""The report's figures: which there are, their numbers, captions and data."""

import json

import pytest
from fake_sweeps import make_sweep

from mjx_reinforce.reports import findings, sources
from mjx_reinforce.reports.page import figures, words


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    """Of four configurations of two settings."""
    over = {"learning_rate": [1e-3, 1e-2], "discount": [0.98, 0.99]}
    directory = make_sweep(tmp_path_factory.mktemp("sweep"), num_seeds=4, evaluations=5, over=over)
    return findings.compute_findings(sources.read_experiment([directory]))


@pytest.fixture(scope="module")
def drawn(found):
    return figures.figures(found)


def without_threshold(found):
    return found._replace(experiment=found.experiment._replace(threshold=None))


def of(made, name):
    (figure,) = [each for each in made if each.name == name]
    return figure


def test_settings_share_a_number_and_others_count_up(drawn):
    numbers = {each.name: each.number for each in drawn}
    assert numbers == {
        "final": 1,
        "curves": 2,
        "solved": 3,
        "distribution": 4,
        "profile": 5,
        "sensitivity-0": 6,
        "sensitivity-1": 6,
        "worst": 7,
    }


def test_without_a_threshold_nothing_is_solved(found):
    numbers = {each.name: each.number for each in figures.figures(without_threshold(found))}
    assert "solved" not in numbers
    assert (numbers["curves"], numbers["distribution"]) == (2, 3)


def test_a_threshold_far_above_all_returns_squeezes_no_figure(found, drawn):
    far = findings.compute_findings(found.experiment._replace(threshold=123_456.0))
    made = figures.figures(far)
    assert "solved" not in [each.name for each in made]
    assert "123456" not in json.dumps([each.spec for each in made])
    assert "123,456.0, lies above the figure" in of(made, "curves").caption
    assert "lies above" not in of(drawn, "curves").caption


def test_defaults_are_named_where_settings_are_compared(found):
    """What a reviewer asks first; of a task without settings of its own there is nothing to say."""
    said = "chosen with one value of learning rate and discount"
    assert any(said in one for one in words.caveats(found))
    own = found._replace(experiment=found.experiment._replace(env="own:Task"))
    assert not any(said in one for one in words.caveats(own))


def test_one_configuration_has_no_ranks_and_no_settings(found):
    alone = found._replace(results=found.results[:1])
    numbers = {each.name: each.number for each in figures.figures(alone)}
    assert list(numbers) == ["curves", "solved", "distribution", "profile", "worst"]
    assert [*numbers.values()] == [1, 2, 3, 4, 5]


def test_captions_have_the_numbers_of_the_findings(found, drawn):
    made = drawn
    best = found.results[0]
    final = of(made, "final")
    assert final.alt.startswith(f"4 rows, best first. The best, {best.configuration.label}, is at ")
    assert "reached 950.0 at" in of(made, "solved").caption
    assert of(made, "worst").title == f"The worst seed of {best.configuration.label}"
    assert [of(made, f"sensitivity-{n}").title for n in range(2)] == ["learning rate", "discount"]
    assert "over discount;" in of(made, "sensitivity-1").alt


def test_several_worst_seeds_are_counted(found, monkeypatch):
    monkeypatch.setattr(figures.tables, "worst_seeds", lambda best: [3, 1, 2])
    (figure,) = figures._worst_figure(found, 1)
    assert figure.title == f"The worst 3 seeds of {found.labels[0]}"


def test_a_chart_draws_what_its_figure_names(found, drawn):
    """Data under these names alone, and of the configurations shown at first."""
    known = {"one"}
    for figure in drawn:
        data = set(named(figure.spec))
        assert data - known <= {*figure.tables, *figure.hidden}, figure.name
        assert {*figure.tables, *figure.hidden} - {"band"} <= data, figure.name
        assert figure.listed is None or figure.listed in figure.tables
        assert figure.spec["description"] == figure.alt
        shown = [x["value"] for x in figure.spec["params"] if x["name"] == "shown"]
        assert shown == [found.labels[: figures.SHOWN]]


def named(spec):
    """The names of all data of a specification."""
    if isinstance(spec, dict):
        if isinstance(spec.get("data"), dict) and "name" in spec["data"]:
            yield spec["data"]["name"]
        for value in spec.values():
            yield from named(value)
    elif isinstance(spec, list):
        for value in spec:
            yield from named(value)


def test_no_more_are_shown_at_first_than_the_best(found, monkeypatch):
    monkeypatch.setattr(figures, "SHOWN", 2)
    for figure in figures._final_figure(found, 1):
        (shown,) = [x["value"] for x in figure.spec["params"] if x["name"] == "shown"]
        assert shown == found.labels[:2]
