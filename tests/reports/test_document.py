"""The text of the report's page, without drawing it."""

import json

import pytest

from mjx_reinforce.reports import document


def test_json_cannot_end_its_script():
    text = document._json({"a": "</script>\u2028\u2029é"})
    assert "<" not in text
    assert "\u2028" not in text
    assert "\u2029" not in text
    assert json.loads(text) == {"a": "</script>\u2028\u2029é"}
    assert "é" in text
    with pytest.raises(ValueError, match="JSON"):
        document._json(float("nan"))


def test_paths_that_are_no_text_are_escaped():
    assert document.encoded("é\udcff") == b"\xc3\xa9\\udcff"
