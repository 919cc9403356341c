"""The counters that ``experiments.speed.phases`` writes into the device code."""

import mujoco
import pytest

from experiments.examples import quadruped
from experiments.speed import phases
from mjx_reinforce.engine.gpu import loops
from mjx_reinforce.engine.team import tables


def kernel_text():
    """Returns the device code of a robot, with the loop that plays."""
    path = quadruped.__file__.replace(".py", ".xml")
    return tables.physics_text(mujoco.MjModel.from_xml_path(path)) + loops._PLAY_LOOP


def test_each_place_is_in_the_device_code():
    text = kernel_text()
    counting = phases.counting(text)
    for name in ("[", "{"):
        assert sum(template.count(name) for _, template in phases._EDITS) > 5
    assert counting.count("phase_end(") > 20
    assert counting.count("phase_event(") > 10
    with pytest.raises(ValueError, match="mend _EDITS"):
        phases.counting(text.replace("collide(t, M, s);", "collide_all(t, M, s);"))


def test_a_report_has_shares_of_all_cycles():
    cycles = dict.fromkeys(phases.PHASES, 0) | {"EPA, ellipsoid-box": 250, "task": 750}
    events = dict.fromkeys(phases.EVENTS, 0) | {"physics steps": 10, "Newton steps": 35}
    report = phases.report(cycles, events)
    assert "| EPA, all | 25.0% | 25 |" in report
    assert "| task | 75.0% | 75 |" in report
    assert "| Newton steps | 3.5000 |" in report
