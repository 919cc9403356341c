"""The report's charts: which there are, what is said of each, and what they say to Vega-Lite."""

import json

import numpy as np
import pytest
from fake_sweeps import make_sweep
from pages import findings_of

from mjx_reinforce.reports import charts, findings, words
from mjx_reinforce.reports.charts import distribution
from mjx_reinforce.reports.curves import drawn_threshold
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


def marks(spec):
    return [x if isinstance(x, str) else x["type"] for x in parts(spec, "mark")]


def numbers(found):
    return [(each.number, each.name) for each in draw_charts(found)]


@pytest.mark.slow
def test_settings_share_a_number_and_others_count_up(found):
    names = ("final", "curves", "solved", "distribution", "profile")
    settings = [(6, "sensitivity-0"), (6, "sensitivity-1")]
    assert numbers(found) == [*enumerate(names, start=1), *settings]
    alone = found._replace(results=found.results[:1])  # has no ranks and no settings
    assert numbers(alone) == [*enumerate(names[1:], start=1)]


@pytest.mark.slow
def test_without_a_threshold_nothing_is_solved(found):
    experiment = found.experiment._replace(threshold=None)
    without = findings.compute_findings(experiment)
    assert [name for _, name in numbers(without)][:3] == ["final", "curves", "distribution"]
    assert all("solved" not in json.dumps(each.spec) for each in draw_charts(without))
    assert charts.threshold_line(without, "x") == []


def test_a_threshold_far_above_all_returns_squeezes_no_figure(found, drawn):
    far = findings.compute_findings(found.experiment._replace(threshold=123_456.0))
    made = {each.name: each for each in draw_charts(far)}
    assert "solved" not in made
    assert "123456" not in json.dumps([each.spec for each in made.values()])
    assert "123,456.0, lies above the figure" in made["curves"].caption
    assert "lies above" not in drawn["curves"].caption


@pytest.mark.parametrize(
    ("threshold", "drawn"), [(-9.0, -9.0), (150.0, 150.0), (151.0, None), (None, None)]
)
def test_a_threshold_is_drawn_where_it_leaves_returns_two_thirds_of_the_height(threshold, drawn):
    returns = np.array([0.0, np.nan, 100.0])
    assert drawn_threshold(threshold, returns) == drawn
    assert drawn_threshold(threshold, returns[1:2]) is None


def test_defaults_are_named_where_settings_are_compared(found):
    """What a reviewer asks first; of a task without settings of its own there is nothing to say."""
    said = "chosen with one value of learning rate and discount"
    assert any(said in one for one in words.caveats(found))
    own = found._replace(experiment=found.experiment._replace(env="own:Task"))
    assert not any(said in one for one in words.caveats(own))


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


def test_curves_have_a_band_a_line_and_the_seeds_of_one(drawn):
    spec = drawn["curves"].spec
    assert marks(spec)[:3] == ["line", "area", "line"]
    seeds, mean = spec["layer"][0]["layer"]
    assert {"filter": "length(shown) == 1"} in seeds["transform"]
    assert seeds["encoding"]["detail"]["field"] == "seed"
    band = mean["layer"][0]
    assert [band["encoding"][axis]["field"] for axis in ("y", "y2")] == ["low", "high"]


def test_the_threshold_is_a_line_with_its_name(drawn):
    for name in ("curves", "final", "profile"):
        assert 950.0 in list(parts(drawn[name].spec, "datum"))
        assert {"value": "solved"} in list(parts(drawn[name].spec, "text"))


def test_configurations_keep_their_colours_and_dashes(found, drawn):
    """Whichever are shown, in every chart; one alone needs no legend."""
    colours = [charts.colour(place) for place in range(6)]
    for name in ("curves", "final", "solved", "distribution", "profile"):
        scales = [x["scale"] for x in parts(drawn[name].spec, "color") if "scale" in x]
        assert scales, name
        assert all(x["domain"] == found.labels and x["range"] == colours for x in scales), name
    (dashes,) = [x["scale"] for x in parts(drawn["curves"].spec, "strokeDash") if "scale" in x]
    assert dashes["range"] == [charts.dash(place) for place in range(6)]
    assert charts.series(["a"])["legend"] is None


def test_the_final_returns_are_rows_from_the_best_down(drawn):
    spec = drawn["final"].spec
    assert spec["height"] == 42 * 6 + 10
    assert marks(spec)[:4] == ["rule", "rule", "point", "text"]
    high, low = next(x["scale"]["domain"] for x in parts(spec, "y") if "scale" in x)
    assert high > 5 > 0 > low  # place 0 on top
    bars = spec["layer"][0]["layer"][0]["layer"][:2]
    fields = [[layer["encoding"][x]["field"] for x in ("x", "x2")] for layer in bars]
    assert fields == [["tenth", "ninetieth"], ["low", "high"]]


def test_a_distribution_is_of_the_moment_and_within_its_ends(found, drawn):
    spec = drawn["distribution"].spec
    filters = [x["filter"] for x in parts(spec, "transform") for x in x if "filter" in x]
    assert filters.count("datum.moment == moment") >= 2
    ends = distribution._borders(found)[[0, -1]].tolist()
    assert ends in [x.get("domain") for x in parts(spec, "scale")]


def test_a_chart_becomes_a_file_of_each_kind(found, drawn):
    files = charts.render_chart(drawn["final"], found.labels, "Final returns")
    assert files["png"].startswith(b"\x89PNG")
    assert files.keys() == {"png", "svg"}
    assert b"Final returns" in files["svg"]
    assert b"var(--" not in files["svg"]  # the page's colours, by their values in light
