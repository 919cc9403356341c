"""Tables by columns, and what of them a spreadsheet reads."""

import numpy as np

from mjx_reinforce.reports import charts

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
    assert [type(x) for x in charts.short([2.0, 2.5])] == [int, float]


def test_tables_stand_below_each_other():
    """What is no list is the same in all rows of its table."""
    table = charts.stacked([TABLE, {"configuration": 3, "value": [4, 5]}])
    assert table == {"configuration": [1, 0, 3, 3], "value": [2.5, None, 4, 5]}
