"""The sweep that a command line asks for."""

import dataclasses

import pytest

from mjx_reinforce.sweeps import command_line
from mjx_reinforce.sweeps.design import Design

FLAGS = ["--env", "CartPole-v1", "--over", "learning-rate", "0.1", "0.2", "--discount", "0.5"]


def test_flags_make_a_design():
    design = command_line.parse_design([*FLAGS, "--exact", "--chunk-runs", "4"])
    assert list(design.over["learning_rate"]) == [0.1, 0.2]
    assert (design.base.env, design.base.discount) == ("CartPole-v1", 0.5)
    assert (design.exact, design.chunk_runs, design.resume) == (True, 4, None)
    assert set(design.given) == {"discount"}


@pytest.fixture
def resumed(monkeypatch, tmp_path):
    """Parses flags beside --resume; the directory has the sweep of ``FLAGS``."""
    design = command_line.parse_design(FLAGS)
    monkeypatch.setattr(command_line, "read_design", lambda directory: design)
    monkeypatch.setattr(command_line, "check_named", lambda *given: None)

    def parse(*flags) -> tuple[Design, Design]:
        return design, command_line.parse_design([*flags, "--resume", str(tmp_path)])

    return parse


def test_a_sweep_goes_on_as_it_was(resumed, tmp_path):
    design, found = resumed()
    assert found == dataclasses.replace(design, resume=tmp_path)


@pytest.mark.parametrize("flags", [["--discount", "0.4"], ["--exact"]])
def test_a_sweep_that_goes_on_has_no_other_settings(resumed, flags):
    with pytest.raises(ValueError, match="goes on as it is: give --resume alone"):
        resumed(*flags)


def test_a_run_that_goes_on_is_no_sweep(tmp_path):
    (tmp_path / "config.json").write_text("{}")
    with pytest.raises(ValueError, match="is a run: "):
        command_line.parse_design(["--resume", str(tmp_path)])
