"""Films of trained policies."""

import functools
import io
import subprocess
import sys

import jax
import numpy as np
import pytest
from bad_envs import Pole
from PIL import Image
from saved_runs import change_env, make_run
from toys import Survive

from mjx_reinforce import act, envs, load, load_policy, watch
from mjx_reinforce.engine.play.rollouts import vmap_rollout
from mjx_reinforce.export import films


def watch_run(monkeypatch, *arguments):
    monkeypatch.setattr(sys, "argv", ["watch", *map(str, arguments)])
    monkeypatch.setattr(watch, "check_drawing", lambda: None)  # none of these needs OpenGL
    watch.main()


def test_before_training_the_parameters_are_random_and_nothing_is_scaled(tmp_path):
    player = load(make_run(tmp_path))
    first, last = watch.untrained(player).actor, player.actor
    assert float(first.normalizer.count) == 0 < float(last.normalizer.count)
    drawn = player.policy.init(jax.random.key(1))
    jax.tree.map(np.testing.assert_array_equal, first.params, drawn)
    same = jax.tree.map(lambda x, y: bool(np.all(x == y)), first.params, last.params)
    assert not all(jax.tree.leaves(same))


def test_the_package_has_one_policy_of_a_task(monkeypatch, capsys):
    monkeypatch.setattr(envs, "make", lambda *_: pytest.fail("an environment was built"))
    for options in (["--seed", "worst"], ["--which", "best"]):
        with pytest.raises(SystemExit, match="2"):
            watch_run(monkeypatch, "HalfCheetah-v5", *options)
        assert "the package has one policy for HalfCheetah-v5" in capsys.readouterr().err


class Stiff(Pole):
    """Asks of the simulation what MJX alone has."""

    def outcome(self, before, data, action):
        return data.qpos.at[0].get(), data._impl is None, {}


@pytest.mark.parametrize(
    ("env", "name", "why"),
    [
        (Survive, "JAX", "ValueError: Survive has steps of its own"),
        (Pole, "C MuJoCo", ""),
        (Stiff, "JAX", "ValueError: the task reads _impl"),
    ],
)
def test_c_mujoco_plays_what_it_can(tmp_path, capsys, env, name, why):
    player = load(make_run(tmp_path))._replace(env="own:Task")
    assert watch.simulator(env(), player, 9)[0] == name
    assert (f"C MuJoCo cannot play this task ({why}" in capsys.readouterr().err) == bool(why)


@pytest.mark.slow
def test_the_film_is_the_episode(tmp_path):
    """In a process of its own: the way MuJoCo draws is settled when it is imported."""
    env = envs.make("CartPole-v1")
    make_run(tmp_path)
    options = ["--width", "96", "--height", "64"]
    command = [sys.executable, "-m", "mjx_reinforce.watch", str(tmp_path), *options]
    said = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    policy, actor = load_policy(tmp_path / "policy", 1)  # the best by summary.json

    played = vmap_rollout(
        env,
        functools.partial(act, policy),
        actor,
        policy.distribution,
        jax.random.key(0),
        num_episodes=1,
        horizon=60,
        deterministic=True,
    )
    length = int(played.mask.sum())
    assert f"return {float(played.reward.sum()):.1f} in {length} steps" in said
    with Image.open(tmp_path / "seed-1.gif") as film:
        assert film.size == (96, 64 + 12)
        pictures = []
        for i in range(film.n_frames):
            film.seek(i)
            pictures.append(np.asarray(film.convert("RGB"), float))
            assert film.info["duration"] == pytest.approx(1000 * 2 * env.dt)  # every second step
    assert len(pictures) == -(-(length + 1) // 2)
    assert np.abs(pictures[0] - pictures[-1]).max() > 50  # something moves
    assert np.ptp(pictures[0]) > 100  # and is to be seen


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--seed", 3], "has no seed 3: its seeds are 0 to 2"),
        (["--which", "best"], "has no policy/best"),
        (["--width", 5000], "--width must be in [1, 4096], got 5000"),
        (["--output", "nowhere/film.gif"], "cannot write to nowhere"),
        (["--output", "policy.gif", "--overwrite"], "policy.gif exists"),
        (["--output", "film.mp4"], "--output must end in .gif, got film.mp4"),
    ],
)
def test_bad_input_is_named(tmp_path, monkeypatch, capsys, arguments, message):
    make_run(tmp_path)
    (tmp_path / "policy.gif").mkdir()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(envs, "make", lambda *_: pytest.fail("an environment was built"))
    with pytest.raises(SystemExit, match="2"):
        watch_run(monkeypatch, tmp_path, *arguments)
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


def test_a_gif_has_the_colors_of_the_samples():
    """They are more than 256, the second half of them in the later samples alone."""
    ramp = np.arange(256, dtype=np.uint8)
    frames = np.zeros((6, 8, 256, 3), np.uint8)
    frames[:3, :, :, 0], frames[3:, :, :, 1] = ramp, ramp
    for i, frame in enumerate(frames):
        frame[:4, 40 * i : 40 * i + 40] = 255  # moves: equal pictures would become one
    film = io.BytesIO(films.gif(iter(frames), 25.0, [*frames[::2]]))
    with Image.open(film) as film:
        assert film.n_frames == 6
        for i, frame in enumerate(frames):
            film.seek(i)
            shown = np.asarray(film.convert("RGB"), float)
            assert np.abs(shown - frame).mean() < 1


WRAPPERS = """
from brax.envs.base import Wrapper
from mjx_reinforce import envs


class Plain:
    "A wrapper with what training needs, and no more."

    def __init__(self):
        self.env = env = envs.make("CartPole-v1")
        self.observation_size, self.action_size = env.observation_size, env.action_size
        self.action_space, self.max_episode_steps = env.action_space, env.max_episode_steps
        self.reset = env.reset

    def step(self, state, action):
        return self.env.step(state, action)


class Twice(Plain):
    "Plays each action twice."

    def __init__(self):
        super().__init__()
        self.dt = 2 * self.env.dt

    def step(self, state, action):
        return self.env.step(self.env.step(state, action), action)


class OfBrax(Wrapper):
    def __init__(self):
        super().__init__(envs.make("CartPole-v1"))
"""


class Blank:
    """Draws pictures of one shade, each another."""

    def __init__(self, model, width, height):
        self.shape, self.drawn = (height, width, 3), 0

    def draw(self, qpos, arrows=()):
        self.drawn += 1
        return np.full(self.shape, self.drawn, np.uint8)


def test_wrapped_environments_are_filmed(tmp_path, monkeypatch):
    """By a wrapper of brax's, which hands on all attributes, and by one's own, which has few."""
    (tmp_path / "wraps.py").write_text(WRAPPERS)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(films, "Renderer", Blank)
    run = make_run(tmp_path)
    frames = {}
    for name in ("CartPole-v1", "wraps:Plain", "wraps:OfBrax", "wraps:Twice"):
        change_env(run, name)
        size = ["--width", "48", "--height", "32"]
        watch_run(monkeypatch, run, "--env", name, "--overwrite", *size)
        with Image.open(run / "seed-1.gif") as film:
            frames[name] = film.n_frames, film.info["duration"]
    assert frames["CartPole-v1"] == frames["wraps:Plain"] == frames["wraps:OfBrax"]
    # Every second step of the one, every step of the other.
    assert frames["CartPole-v1"][1] == 1000 * 2 * envs.make("CartPole-v1").dt
    assert frames["wraps:Twice"][1] == frames["CartPole-v1"][1]


def test_an_environment_without_a_model_is_refused(register, tmp_path, monkeypatch, capsys):
    """Survive has what training needs, and no more."""
    make_run(tmp_path, "InvertedPendulum-v5", observation_size=1)
    change_env(tmp_path, "Survive-v0")
    with pytest.raises(SystemExit, match="2"):
        watch_run(monkeypatch, tmp_path)
    error = capsys.readouterr().err
    assert "Survive has no mj_model, so there is nothing to draw" in error
    assert "in a wrapper, set self.env to what it wraps" in error
    assert error.count("\n") == 1
