"""Films of policies of the package, side by side, in C MuJoCo."""

import io
import subprocess
import sys
import warnings

import mujoco
import numpy as np
import pytest
from PIL import Image
from saved_runs import SPACES, make_run

from mjx_reinforce import load, pretrained, watch
from mjx_reinforce.envs import models
from mjx_reinforce.export import films
from mjx_reinforce.export.run_files import FOLDER
from mjx_reinforce.export.term_charts import draw_terms


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


class Flat:
    """Draws the first position as a shade, and keeps its arrows."""

    arrows = ()

    def __init__(self, model, width, height):
        self.shape = height, width, 3

    def draw(self, qpos, arrows):
        Flat.arrows = arrows
        return np.full(self.shape, qpos[0], np.uint8)


def make_take(label, model, dt, qpos, commands=None, pushes=None):
    """Returns a take whose rewards are 1."""
    rewards = np.ones(len(qpos) - 1)
    return films.Take(label, model, dt, qpos, rewards, commands=commands, pushes=pushes)


def test_takes_stand_side_by_side(monkeypatch):
    monkeypatch.setattr(films, "Renderer", Flat)
    slow = make_take("slow", None, 0.1, np.arange(11.0)[:, None])
    quick = make_take("quick", None, 0.05, 50 + np.arange(9.0)[:, None])
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


BOX = mujoco.MjModel.from_xml_string(
    "<mujoco><worldbody><body><freejoint/><geom size='.1'/></body></worldbody></mujoco>"
)


def circle(steps, dt, speed, turning, start=0.0):
    """Returns positions of a box that goes along a circle, nose ahead."""
    heading = start + turning * dt * np.arange(steps + 1)
    radius = speed / turning
    place = radius * np.column_stack([np.sin(heading), -np.cos(heading), 0 * heading])
    zero = np.zeros_like(heading)
    quaternion = np.column_stack([np.cos(heading / 2), zero, zero, np.sin(heading / 2)])
    return np.column_stack([place, quaternion])


def test_a_velocity_is_that_in_the_robots_frame():
    """Also once the robot has turned by more than 180 degrees."""
    take = make_take("box", BOX, 0.02, circle(400, 0.02, speed=0.6, turning=0.8))
    speeds = films.velocities(take, films.robot_paths(take))
    np.testing.assert_allclose(speeds[0], 0)
    # A mean over 0.2 s lags by half of that.
    lag = 0.8 * 0.1
    expected = 0.6 * np.cos(lag), -0.6 * np.sin(lag), 0.8
    np.testing.assert_allclose(speeds[11:], np.tile(expected, (390, 1)), atol=2e-3)
    hinge = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><body><joint/><geom size='1'/></body></worldbody></mujoco>"
    )
    assert films.robot_paths(make_take("arm", hinge, 0.1, np.zeros((3, 1)))) is None


def inks(strip):
    """Returns which of the two colors some pixels of a strip have."""
    colors = {"command": films._COMMAND_INK, "robot": films._ROBOT_INK}
    return {name for name, ink in colors.items() if np.any(np.all(strip == ink, axis=-1))}


def test_a_commanded_velocity_is_an_arrow_beside_that_of_the_robot(monkeypatch):
    """In the world: the robot looks along y, and goes there at 0.5 m/s."""
    monkeypatch.setattr(films, "Renderer", Flat)
    qpos = np.zeros((41, 7))
    qpos[:, 1] = 0.5 * 0.05 * np.arange(41)
    qpos[:, [3, 6]] = np.sqrt(0.5)
    commands = np.tile([0.8, 0.3, -0.4], (41, 1))
    film = films.side_by_side([make_take("box", BOX, 0.05, qpos, commands)], 480, 360, seconds=9)
    frame = film.draw(20)
    robot, command = Flat.arrows
    np.testing.assert_allclose(robot.velocity, [0, 0.5, 0], atol=1e-9)
    np.testing.assert_allclose(command.velocity, [-0.3, 0.8, 0], atol=1e-9)
    assert (robot.color, command.color) == (films._ROBOT_INK, films._COMMAND_INK)
    plain = films.side_by_side([make_take("box", BOX, 0.05, qpos)], 480, 360, seconds=9).draw(20)
    assert len(Flat.arrows) == 0
    np.testing.assert_array_equal(frame[: len(plain)], plain)
    strip = frame[len(plain) :]
    assert inks(strip[:, :300]) == {"command"}
    assert inks(strip[:, 300:]) == {"robot"}
    assert inks(plain) == set()


@pytest.mark.parametrize(("model", "size"), [(BOX, 2), (None, 1)])
def test_a_command_of_another_kind_is_numbers(monkeypatch, model, size):
    monkeypatch.setattr(films, "Renderer", Flat)
    take = make_take("box", model, 0.05, np.zeros((5, 7)), np.ones((5, size)))
    frame = films.side_by_side([take], 480, 360, seconds=9).draw(2)
    assert len(Flat.arrows) == 0
    assert inks(frame[380:]) == {"command"}


def test_a_push_is_said_for_half_a_second(monkeypatch):
    monkeypatch.setattr(films, "Renderer", Flat)
    pushes = np.arange(60) == 20
    options = {"width": 480, "height": 360, "seconds": 9}
    pushed, quiet = (
        films.side_by_side([make_take("box", BOX, 0.05, np.zeros((61, 7)), pushes=x)], **options)
        for x in (pushes, None)
    )
    differ = [np.any(pushed.draw(i) != quiet.draw(i)) for i in range(pushed.length)]
    times = np.flatnonzero(differ) / pushed.rate
    assert (times[0], times[-1]) == (pytest.approx(1.05), pytest.approx(1.5))
    assert np.sum(differ) == 10


def test_arrows_lie_above_the_robot(monkeypatch):
    class Geoms(Undrawn):
        def render(self):
            arrow = mujoco.mjtGeom.mjGEOM_ARROW
            return [x for x in self.scene.geoms[: self.scene.ngeom] if x.type == arrow]

    monkeypatch.setattr(mujoco, "Renderer", Geoms)
    qpos = np.array([5.0, 6, 7, 1, 0, 0, 0])
    arrows = [
        films.Arrow(np.array([0, 0.8, 0]), (255, 0, 0)),
        films.Arrow(np.array([-0.4, 0, 0]), (0, 0, 255)),
        films.Arrow(np.array([0.01, 0, 0]), (0, 0, 255)),  # it stands
    ]
    robot, command = films.Renderer(BOX, 8, 8).draw(qpos, arrows)
    np.testing.assert_allclose(robot.mat[:, 2], [0, 1, 0], atol=1e-6)
    np.testing.assert_allclose(command.mat[:, 2], [-1, 0, 0], atol=1e-6)
    assert robot.size[2] == pytest.approx(2 * command.size[2])
    assert 7.1 < robot.pos[2] < command.pos[2] < 7.5
    np.testing.assert_allclose([robot.pos[:2], command.pos[:2]], [[5, 6]] * 2, atol=0.2)
    np.testing.assert_allclose(robot.rgba, [1, 0, 0, 1])


def test_a_chart_shows_terms_and_command_over_time():
    qpos = circle(100, 0.02, speed=0.6, turning=0.8)
    plain = make_take("box", BOX, 0.02, qpos)
    pushes = np.arange(100) == 50
    terms = {"reward_a": np.sin(np.arange(100.0)), "reward_b": np.ones(100)}
    commands = np.tile([0.5, 0.0, 0.8], (101, 1))
    full = plain._replace(terms=terms, commands=commands, pushes=pushes)
    shapes, charts = [], []
    for take in (plain, full, full._replace(terms={}), full._replace(commands=commands[:, :2])):
        charts.append(draw_terms(take))
        with Image.open(io.BytesIO(charts[-1])) as image:
            shapes.append(np.asarray(image).shape[:2])
    assert shapes == [(450, 1200), *[(900, 1200)] * 3]
    assert len(set(charts)) == 4


WALKER = '''
import jax.numpy as jnp
from mujoco import MjSpec
from mjx_reinforce.envs.base import MujocoEnv

XML = """<mujoco><worldbody><geom type="plane" size="0 0 1"/><body pos="0 0 .1">
  <freejoint/><geom size=".1" rgba=".5 .5 .5 1"/>
  <body><joint name="arm" axis="0 0 1" damping="1"/><geom size=".02" pos=".1 0 0"/></body></body>
</worldbody><actuator><motor joint="arm"/></actuator></mujoco>"""


class Task(MujocoEnv):
    def __init__(self):
        super().__init__(
            xml_file=MjSpec.from_string(XML),
            frame_skip=20,
            max_episode_steps=30,
            reward_threshold=None,
        )

    def initial(self, rng):
        return jnp.asarray(self.mj_model.qpos0), jnp.zeros(7)

    def memory(self, rng, data):
        return {"command": jnp.array([0.0, 0.9, 0.0])}

    def observe(self, data):
        return jnp.concatenate([data.qvel[:1], data.memory["command"]])

    def outcome(self, before, data, action):
        terms = {"reward_x": data.qvel[0], "reward_alive": 1.0}
        return sum(terms.values()), False, terms
'''


@pytest.mark.slow
def test_watch_shows_the_command_of_a_task(tmp_path, monkeypatch):
    """An arrow in the scene, numbers and a legend below, and a chart; in a process of its own."""
    (tmp_path / "own_walker.py").write_text(WALKER)
    monkeypatch.setitem(SPACES, "own_walker:Task", SPACES["InvertedPendulum-v5"])
    make_run(tmp_path / "run", "own_walker:Task", observation_size=4)
    options = ["run", "--env", "own_walker:Task", "--chart", "terms.png"]
    command = [sys.executable, "-m", "mjx_reinforce.watch", *options]
    ran = subprocess.run(command, check=True, capture_output=True, text=True, cwd=tmp_path)
    assert "the terms of the reward in terms.png" in ran.stdout
    with Image.open(tmp_path / "terms.png") as image:
        assert image.size == (1200, 900)
    (film,) = (tmp_path / "run").glob("*.gif")
    frame = [*pictures(film)][10]
    assert len(frame) > 360 + 28
    red, green, blue = np.moveaxis(frame[:360], -1, 0)
    is_orange = (red > 150) & (green > 0.4 * red) & (green < 0.9 * red) & (blue < 0.4 * red)
    assert is_orange.sum() > 50
    again = subprocess.run(command, check=False, capture_output=True, text=True, cwd=tmp_path)
    assert again.returncode == 2
    assert "exists" in again.stderr


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
