"""Films of policies of the package, side by side, in C MuJoCo."""

import subprocess
import sys
import warnings

import mujoco
import numpy as np
import pytest
from PIL import Image
from saved_runs import make_run

from mjx_reinforce import load, pretrained, watch
from mjx_reinforce.envs import models
from mjx_reinforce.export import films
from mjx_reinforce.export.run_files import FOLDER


def pictures(path):
    with Image.open(path) as film:
        for i in range(film.n_frames):
            film.seek(i)
            yield np.asarray(film.convert("RGB"), float)


def test_every_policy_of_the_package_is_of_its_task():
    known = pretrained()
    assert "HalfCheetah-v5" in known
    for name, facts in known.items():
        player = load(name)
        assert player.env == facts["task"] == name
        assert player.seed == facts["seed"]
        action = player.act(np.zeros(player.observation_size))
        assert np.isfinite(action).all()
        low, high = facts["interval"]
        assert low <= facts["return"] <= high
        assert facts["command"].startswith(f"python -m mjx_reinforce.train --env {name} ")
        assert facts["env_steps"] > 0 < facts["seconds"]
        assert len(facts["git_commit"]) >= 40
    files = [path for path in FOLDER.rglob("*") if path.is_file()]
    assert {path.suffix for path in files} == {".json", ".npz"}
    assert sum(path.stat().st_size for path in files) < 400_000


def test_a_directory_of_a_tasks_name_goes_first(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    make_run(tmp_path / "CartPole-v1")
    assert load("CartPole-v1").seed == 1
    monkeypatch.chdir(tmp_path.parent)
    assert load("CartPole-v1").seed == pretrained()["CartPole-v1"]["seed"]


def test_there_is_one_policy_of_a_task_by_its_name():
    for options in ({"seed": 1}, {"seed": "worst"}, {"which": "best"}):
        with pytest.raises(ValueError, match="one policy for HalfCheetah-v5"):
            load("HalfCheetah-v5", **options)
    with pytest.raises(ValueError, match=r"HalfCheeta-v5 is not a run .* mean 'HalfCheetah-v5'"):
        load("HalfCheeta-v5")


def test_a_renderer_that_is_not_here_is_answered_before_the_policy_is_read(monkeypatch, tmp_path):
    def fail(*arguments):
        warnings.warn("GLFW is not initialized", UserWarning, stacklevel=1)
        raise RuntimeError("an OpenGL platform library has not been loaded")

    monkeypatch.setenv("MUJOCO_GL", "osmesa")
    monkeypatch.setattr(mujoco, "Renderer", fail)
    monkeypatch.setattr(watch, "configure_jax", lambda: pytest.fail("it went on"))
    settings = watch.WatchSettings(make_run(tmp_path))
    with pytest.raises(ValueError, match=r"=osmesa \(an OpenGL.* set MUJOCO_GL=egl,"):
        watch.film(settings)


class Undrawn:
    """MuJoCo's renderer up to where it needs OpenGL."""

    def __init__(self, model, height, width):
        self.model, self.scene = model, mujoco.MjvScene(model, 1000)

    def update_scene(self, data, camera):
        options, every = mujoco.MjvOption(), mujoco.mjtCatBit.mjCAT_ALL
        mujoco.mjv_updateScene(self.model, data, options, None, camera, every, self.scene)

    def render(self):
        floor = next(x for x in self.scene.geoms if x.type == mujoco.mjtGeom.mjGEOM_PLANE)
        return self.scene.camera[0].pos.copy(), floor.pos.copy()

    def close(self):
        pass


@pytest.mark.parametrize(
    ("joint", "rest", "goes"),
    [
        ("<freejoint/>", "", True),
        ('<joint type="slide" axis="1 0 0"/><joint/>', "", True),
        ('<joint type="slide" axis="1 0 0" limited="true" range="-1 1"/>', "", False),
        ("<joint/>", '<body><freejoint/><geom size="1"/></body>', False),  # an arm and its ball
        ("<freejoint/>", '<camera name="track" pos="0 0 9"/>', False),
    ],
)
def test_pictures_go_with_the_robot_and_have_their_floor(monkeypatch, joint, rest, goes):
    monkeypatch.setattr(mujoco, "Renderer", Undrawn)
    xml = f"""<mujoco><worldbody><geom type="plane" size="0 0 .1"/>
      <body>{joint}<geom size=".1"/></body>{rest}</worldbody></mujoco>"""
    model = mujoco.MjModel.from_xml_string(xml)
    renderer = films.Renderer(model, 8, 8)
    for x in (0.0, 500.0, -500.0):
        qpos = model.qpos0.copy()
        qpos[0] = x
        camera, floor = renderer.draw(qpos)
        assert abs(camera[0] - x * goes) < 10
        assert abs(floor[0] - camera[0]) < 10


def test_what_is_drawn_has_a_sky_and_moves_alike():
    """That of the model, where it has one; Ant has one, Reacher none."""
    for name in ("ant.xml", "reacher.xml"):
        plain, drawn = models.load_model(name), films.with_sky(models.spec(name))
        places = []
        for model in (plain, drawn):
            data = mujoco.MjData(model)
            data.qpos[:] = plain.qpos0 + 0.1
            mujoco.mj_forward(model, data)
            places.append(np.concatenate([data.xpos, data.xquat], axis=1))
        np.testing.assert_array_equal(*places)
        assert list(drawn.tex_type).count(mujoco.mjtTexture.mjTEXTURE_SKYBOX) == 1


def test_takes_stand_side_by_side(monkeypatch):
    class Flat:
        """Draws the first position as a shade."""

        def __init__(self, model, width, height):
            self.shape = height, width, 3

        def draw(self, qpos):
            return np.full(self.shape, qpos[0], np.uint8)

    monkeypatch.setattr(films, "Renderer", Flat)
    slow = films.Take("slow", None, 0.1, np.arange(11.0)[:, None], np.ones(10))
    quick = films.Take("quick", None, 0.05, 50 + np.arange(9.0)[:, None], np.ones(8))
    film = films.side_by_side([slow, quick], 40, 30, seconds=5.0)
    assert (film.rate, film.length) == (pytest.approx(10.0), 11)
    shades = [[film.draw(i)[0, x] for x in (0, 40)] for i in range(film.length)]
    assert [int(left[0]) for left, _ in shades] == [*range(11)]
    # It ends after 0.4 s, and then stands still.
    assert [int(right[0]) for _, right in shades] == [50, 52, 54, 56, *[58] * 7]
    assert film.draw(0).shape == (30 + 12, 80, 3)  # with their words below
    assert films.side_by_side([slow], 40, 30, seconds=0.5).length == 5
    assert set(film.samples) >= {0, 3}
    with pytest.raises(ValueError, match="at least one take"):
        films.side_by_side([], 40, 30, seconds=1.0)


@pytest.mark.slow
def test_watch_plays_a_policy_of_the_package(tmp_path):
    """From its name to a film of it before and after training; it draws, so in its own process."""
    options = ["--beside", "untrained", "--seconds", "3"]
    options += ["--width", "120", "--height", "90"]
    command = [sys.executable, "-m", "mjx_reinforce.watch", "InvertedPendulum-v5", *options]
    ran = subprocess.run(command, check=True, capture_output=True, text=True, cwd=tmp_path)
    before, after, frames = (line for line in ran.stdout.splitlines() if line.strip())
    assert before.startswith("before training: return ")
    assert after == "after training: return 1000.0 in 1000 steps in C MuJoCo"
    assert frames == "75 frames in InvertedPendulum-v5.gif: 3 of 40 s; --seconds 40 shows all"
    shown = [*pictures(tmp_path / "InvertedPendulum-v5.gif")]
    assert shown[0].shape == (102, 240, 3)
    sky = shown[0][2]
    assert np.all(sky[:, 2] > sky[:, 0] + 10)
