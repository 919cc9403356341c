"""The sweep that a command line asks for."""

import dataclasses

import pytest

from mjx_reinforce.runs import command_line
from mjx_reinforce.runs.design import Design

FLAGS = ["--env", "CartPole-v1", "--over", "learning-rate", "0.1", "0.2", "--discount", "0.5"]


def test_flags_make_a_design():
    design = command_line.parse([*FLAGS, "--exact", "--chunk-runs", "4"], "sweep")
    assert list(design.over["learning_rate"]) == [0.1, 0.2]
    assert (design.base.env, design.base.discount) == ("CartPole-v1", 0.5)
    assert (design.exact, design.chunk_runs, design.base.resume) == (True, 4, None)
    assert set(design.chosen_names) == {"discount"}


@pytest.fixture
def resumed(monkeypatch, tmp_path):
    """Parses flags beside --resume; the directory has the sweep of ``FLAGS``."""
    design = dataclasses.replace(command_line.parse(FLAGS, "sweep"), default=None)
    base = dataclasses.replace(design.base, resume=tmp_path)
    design = dataclasses.replace(design, base=base)
    monkeypatch.setattr(command_line, "read_design", lambda directory: design)
    monkeypatch.setattr(command_line, "check_named", lambda *given: None)

    def parse(*flags, name="sweep") -> tuple[Design, Design]:
        return design, command_line.parse([*flags, "--resume", str(tmp_path)], name)

    return parse


def test_a_sweep_goes_on_as_it_was(resumed):
    """By either command."""
    for name in ("train", "sweep"):
        design, found = resumed(name=name)
        assert found == dataclasses.replace(design, default=design.base)


@pytest.mark.parametrize("flags", [["--discount", "0.4"], ["--exact"]])
def test_a_sweep_that_goes_on_has_no_other_settings(resumed, flags):
    with pytest.raises(ValueError, match="goes on as it is: give --resume alone"):
        resumed(*flags)
