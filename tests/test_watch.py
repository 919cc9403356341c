"""Films of trained policies."""

import json
import subprocess
import sys

import imageio_ffmpeg
import jax
import numpy as np
import pytest
from PIL import Image

from mjx_reinforce import envs, load_policy, watch
from mjx_reinforce.engines.rollouts import rollout
from mjx_reinforce.export.policy_files import save_policy
from mjx_reinforce.learners.reinforce import reinforce
from mjx_reinforce.policies import normalize

SETTINGS = {
    "InvertedPendulum-v5": {
        "policy": "normal",
        "observation_size": 4,
        "action_low": [-3.0],
        "action_high": [3.0],
    },
    "CartPole-v1": {"policy": "categorical", "observation_size": 4, "num_actions": 2},
}


def make_run(directory, env_id):
    """What two seeds of training leave, as far as watching needs it."""
    env = envs.make(env_id)
    settings = SETTINGS[env_id] | {"hidden_sizes": [32, 32], "initial_std": 0.5}
    learner = reinforce(env)
    states = jax.vmap(learner.init)(jax.random.split(jax.random.key(3), 2))
    save_policy(directory / "policy", states.actor, settings)
    (directory / "config.json").write_text(json.dumps({"env": env_id, "horizon": 60}))
    return env


def watch_run(monkeypatch, *arguments):
    monkeypatch.setattr(sys, "argv", ["watch", *map(str, arguments)])
    watch.main()


@pytest.mark.parametrize("env_id", SETTINGS)
def test_the_film_is_the_episode(tmp_path, env_id):
    """In a process of its own: the way MuJoCo draws is settled when it is imported."""
    env = make_run(tmp_path, env_id)
    options = ["--seed", "1", "--width", "96", "--height", "64"]
    command = [sys.executable, "-m", "mjx_reinforce.watch", str(tmp_path), *options]
    said = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    policy, actor = load_policy(tmp_path / "policy", 1)

    def act(actor, observation):
        return policy.apply(actor.params, normalize.apply(actor.normalizer, observation))

    played = rollout(
        env,
        act,
        actor,
        policy.distribution,
        jax.random.key(0),
        num_episodes=1,
        horizon=60,
        num_deterministic=1,
    )
    length = int(played.mask.sum())
    assert f"return {float(played.reward.sum()):.1f} in {length} steps" in said
    skip = {"InvertedPendulum-v5": 1, "CartPole-v1": 2}[env_id]
    with Image.open(tmp_path / "seed-1.gif") as film:
        assert film.size == (96, 64)
        pictures = []
        for i in range(film.n_frames):
            film.seek(i)
            pictures.append(np.asarray(film.convert("RGB"), float))
            assert film.info["duration"] == pytest.approx(1000 * env.dt * skip)
    assert len(pictures) == -(-(length + 1) // skip)
    assert np.abs(pictures[0] - pictures[-1]).max() > 50  # something moves
    assert np.ptp(pictures[0]) > 100  # and is to be seen


def test_noise_and_other_starts_differ(tmp_path):
    env = make_run(tmp_path, "CartPole-v1")
    player = load_policy(tmp_path / "policy", 0)
    plain, other = (watch.play(env, *player, episode, 60, noise=False) for episode in (0, 1))
    noisy = watch.play(env, *player, 0, 60, noise=True)
    assert np.any(plain[0][0] != other[0][0])
    np.testing.assert_array_equal(plain[0][0], noisy[0][0])
    assert plain[0].shape != noisy[0].shape or np.any(plain[0] != noisy[0])
    assert len(plain[0]) == len(plain[1]) + 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--seed", 2], "seed 2 is not among the 2"),
        (["--seconds", 0], "--seconds must be positive and finite, got 0"),
        (["--width", 5000], "--width must be in [1, 4096], got 5000"),
        (["--episode", -1], "--episode must be in [0, 2147483647], got -1"),
        (["--output", "nowhere/film.gif"], "cannot write to nowhere"),
        (["--output", "film"], "film is no film"),
        (["--output", "policy.gif", "--overwrite"], "policy.gif exists"),
        (["--output", "config.json", "--overwrite"], "config.json is no film"),
        (["--output", "film.mp4"], "pip install mediapy imageio-ffmpeg"),
    ],
)
def test_bad_input_is_named(tmp_path, monkeypatch, capsys, arguments, message):
    make_run(tmp_path, "CartPole-v1")
    (tmp_path / "policy.gif").mkdir()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, "mediapy", None)
    with pytest.raises(SystemExit, match="2"):
        watch_run(monkeypatch, tmp_path, *arguments)
    assert message in capsys.readouterr().err


@pytest.mark.parametrize("content", [None, "[", "[]", '{"env": "CartPole-v1"}'])
def test_what_is_no_run_is_named(tmp_path, monkeypatch, capsys, content):
    if content is not None:
        (tmp_path / "config.json").write_text(content)
    with pytest.raises(SystemExit, match="2"):
        watch_run(monkeypatch, tmp_path)
    error = capsys.readouterr().err
    assert ("is no run directory" if content is None else "is damaged") in error


@pytest.mark.parametrize(
    ("file", "content", "message"),
    [
        ("policy/actor.npz", b"PK", "policy is damaged"),
        ("policy/policy.json", b"{}", "policy is damaged: KeyError"),
        ("policy/policy.json", b"{", "policy is damaged: JSONDecodeError"),
        ("config.json", b'{"env": "Reacher-v5", "horizon": 9}', "observations of 4 entries"),
        ("config.json", b'{"env": "CartPole-v1", "horizon": 0}', "the horizon is 0"),
    ],
)
def test_damage_is_named(tmp_path, monkeypatch, capsys, file, content, message):
    make_run(tmp_path, "CartPole-v1")
    (tmp_path / file).write_bytes(content)
    with pytest.raises(SystemExit, match="2"):
        watch_run(monkeypatch, tmp_path)
    assert message in capsys.readouterr().err


def test_a_run_that_is_not_over_is_named(tmp_path, monkeypatch, capsys):
    (tmp_path / "config.json").write_text('{"env": "CartPole-v1", "horizon": 9}')
    with pytest.raises(SystemExit, match="2"):
        watch_run(monkeypatch, tmp_path)
    assert "has no policy yet" in capsys.readouterr().err


@pytest.mark.parametrize("width", [48, 33])
def test_an_mp4_is_what_was_drawn(tmp_path, width):
    frames = np.zeros((5, 32, width, 3), np.uint8)
    frames[:, :16, :, 0] = 40 * np.arange(1, 6)[:, None, None]
    watch.write_film(tmp_path / "film.mp4", iter(frames), 25.0)
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-i", tmp_path / "film.mp4"]
    command += ["-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    film = subprocess.run(command, capture_output=True, check=True)
    assert b" 25 fps" in film.stderr
    shown = np.frombuffer(film.stdout, np.uint8).reshape(frames.shape)
    assert np.abs(shown[..., 0].astype(int) - frames[..., 0]).mean() < 8
    assert [path.name for path in tmp_path.iterdir()] == ["film.mp4"]


def test_an_environment_without_a_model_is_refused():
    class Bare:
        pass

    with pytest.raises(ValueError, match="Bare has no mj_model"):
        watch.scene(Bare())
