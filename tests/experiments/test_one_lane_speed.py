"""The device code with one lane beside C MuJoCo, as ``experiments.speed.one_lane`` times them."""

from pathlib import Path

import pytest
from command_lines import run_command

from experiments.examples import quadruped
from experiments.kit.device_code import COMPILER
from experiments.speed import one_lane


def test_help(capsys):
    assert run_command("--help", command=one_lane.main) == 0
    assert "--threads" in capsys.readouterr().out


@pytest.mark.skipif(COMPILER is None, reason="there is no C++ compiler")
def test_all_play_the_same_episodes(tmp_path):
    folder = Path(quadruped.__file__).parent
    settings = one_lane.Settings(folder, episodes=3, env_steps=4, repeats=1, options=("-O0",))
    measured = one_lane.measure(folder / "quadruped.xml", settings, tmp_path)
    batch, double, single = measured.errors
    assert batch == 0
    assert double < 1e-6  # C stops at its tolerance
    assert single < 1e-3
    assert min(measured.rate, *measured.ratios) > 0


def test_what_touches_nothing_is_left_out(tmp_path):
    path = tmp_path / "scene.xml"
    path.write_text(
        """<mujoco>
          <asset><mesh name="shell" file="absent.obj"/></asset>
          <worldbody><body>
            <inertial mass="1" pos="0 0 0" diaginertia="1 1 1"/><freejoint/>
            <geom type="mesh" mesh="shell" contype="0" conaffinity="0"/>
            <geom size=".1"/>
          </body></worldbody>
        </mujoco>"""
    )
    model = one_lane.load(path)
    assert (model.ngeom, model.nmesh) == (1, 0)
