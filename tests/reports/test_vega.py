"""What the report's charts say to Vega-Lite."""

import json

import pytest

from mjx_reinforce.reports.page import charts, vega
from mjx_reinforce.reports.page.vega import colour, dash

LABELS = ["a", "b", "c"]


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


def spec_of(chart, labels=LABELS, shown=LABELS[:2]):
    return vega.specification(chart, labels, shown, 5e4, 9)


def marks(spec):
    return [x if isinstance(x, str) else x["type"] for x in parts(spec, "mark")]


def test_parameters_are_where_the_page_sets_them():
    spec = spec_of(charts.curves(LABELS, 900.0, 5e4))
    assert {x["name"]: x["value"] for x in spec["params"] if "value" in x} == {
        "shown": ["a", "b"],
        "at": 5e4,
        "moment": 9,
        "logarithmic": False,
    }
    assert spec["width"] == "container"
    assert spec["config"] == vega.config()


def test_curves_have_a_band_a_line_and_the_seeds_of_one():
    spec = spec_of(charts.curves(LABELS, None, 5e4))
    assert marks(spec)[:3] == ["line", "area", "line"]
    seeds, band = spec["layer"][:2]
    assert {"filter": "length(shown) == 1"} in seeds["transform"]
    assert seeds["encoding"]["detail"]["field"] == "seed"
    assert [band["encoding"][axis]["field"] for axis in ("y", "y2")] == ["low", "high"]
    assert {x["name"] for x in parts(spec, "data")} == {"curves", "seeds", "one"}


@pytest.mark.parametrize("chart", [charts.curves(LABELS, 900.0, 5e4), charts.final(LABELS, 900.0)])
def test_the_threshold_is_a_line_with_its_name(chart):
    spec = spec_of(chart)
    assert 900.0 in list(parts(spec, "datum"))
    assert {"value": "solved"} in list(parts(spec, "text"))


def test_without_a_threshold_there_is_no_line():
    assert "solved" not in json.dumps(spec_of(charts.final(LABELS, None)))
    assert vega.threshold_line(None, "x") == []


def test_configurations_keep_their_colours_and_dashes():
    """Whichever are shown; one alone needs no legend."""
    spec = spec_of(charts.curves(LABELS, None, 5e4))
    scales = [x["scale"] for x in parts(spec, "color") if isinstance(x, dict)]
    assert all(x["domain"] == LABELS and x["range"] == [*map(colour, range(3))] for x in scales)
    (dashes,) = [x["scale"] for x in parts(spec, "strokeDash") if isinstance(x, dict)]
    assert dashes["range"] == [*map(list, map(dash, range(3)))]
    alone = vega.series(["a"]).to_dict(context={"data": None})
    assert alone["legend"] is None


def test_the_final_returns_are_rows_from_the_best_down():
    spec = spec_of(charts.final(LABELS, None))
    assert spec["height"] == 42 * 3 + 10
    assert marks(spec)[:4] == ["rule", "rule", "point", "text"]
    high, low = next(x["scale"]["domain"] for x in parts(spec, "y") if "scale" in x)
    assert high > 2 > 0 > low  # place 0 on top
    fields = [[layer["encoding"][x]["field"] for x in ("x", "x2")] for layer in spec["layer"][:2]]
    assert fields == [["tenth", "ninetieth"], ["low", "high"]]


def test_a_distribution_is_of_the_moment_and_within_its_ends():
    spec = spec_of(charts.distribution(LABELS, -5.0, 1000.0))
    filters = [x["filter"] for x in parts(spec, "transform") for x in x if "filter" in x]
    assert filters.count("datum.moment == moment") >= 2
    assert [-5.0, 1000.0] in [x.get("domain") for x in parts(spec, "scale")]
    assert {x["name"] for x in parts(spec, "data")} == {"histogram", "moments"}


def test_a_chart_becomes_a_file_of_each_kind():
    rows = {"final": {"configuration": ["a"], "place": [0], "value": [3.0]}}
    rows["final"] |= {name: [3.0] for name in ("low", "high", "tenth", "ninetieth")}
    spec = spec_of(charts.final(["a"], None), ["a"], ["a"])
    table = [
        dict(zip(rows["final"], x, strict=True)) for x in zip(*rows["final"].values(), strict=True)
    ]
    files = vega.render_chart(spec, {"final": table, "one": [{"row": 0}]}, "Final returns")
    assert files["png"].startswith(b"\x89PNG")
    assert files.keys() == {"png", "svg"}
    assert b"Final returns" in files["svg"]
    assert b"var(--" not in files["svg"]  # the page's colours, by their values in light
