"""Films of trained policies."""

import functools
import math
import subprocess
import sys
import time

import gymnasium
import imageio_ffmpeg
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct
from PIL import Image
from saved_runs import change, change_arrays, make_run
from toys import Survive, ToyState

from mjx_reinforce import act, envs, load, load_policy, watch
from mjx_reinforce.engines.rollouts import rollout
from mjx_reinforce.export import takes
from mjx_reinforce.playing import mjx_playing as playing


def watch_run(monkeypatch, *arguments):
    monkeypatch.setattr(sys, "argv", ["watch", *map(str, arguments)])
    watch.main()


@pytest.mark.parametrize("env_id", ["InvertedPendulum-v5", "CartPole-v1"])
def test_the_film_is_the_episode(tmp_path, env_id):
    """In a process of its own: the way MuJoCo draws is settled when it is imported."""
    env = envs.make(env_id)
    make_run(tmp_path, env_id)
    options = ["--width", "96", "--height", "64"]
    command = [sys.executable, "-m", "mjx_reinforce.watch", str(tmp_path), *options]
    said = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    policy, actor = load_policy(tmp_path / "policy", 1)  # the best by summary.json

    played = rollout(
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
    skip = {"InvertedPendulum-v5": 1, "CartPole-v1": 2}[env_id]
    with Image.open(tmp_path / "seed-1.gif") as film:
        assert film.size == (96, 64 + 12)
        pictures = []
        for i in range(film.n_frames):
            film.seek(i)
            pictures.append(np.asarray(film.convert("RGB"), float))
            assert film.info["duration"] == pytest.approx(1000 * env.dt * skip)
    assert len(pictures) == -(-(length + 1) // skip)
    assert np.abs(pictures[0] - pictures[-1]).max() > 50  # something moves
    assert np.ptp(pictures[0]) > 100  # and is to be seen


def test_noise_and_other_starts_differ(tmp_path):
    player = load(make_run(tmp_path))
    play = playing.simulator(envs.make("CartPole-v1"), player, 60)
    plain, other, noisy = play(0, False), play(1, False), play(0, True)
    lengths = [[len(play(i, noise).rewards) for i in range(8)] for noise in (False, True)]
    assert np.any(plain.qpos[0] != other.qpos[0])
    np.testing.assert_array_equal(plain.qpos[0], noisy.qpos[0])
    assert lengths[0] != lengths[1]
    assert len(plain.qpos) == len(plain.rewards) + 1


def test_seeds_and_starts_share_a_program(tmp_path):
    """So that the compilation cache serves every later start."""
    env, events = envs.make("CartPole-v1"), []
    make_run(tmp_path)
    playing.simulator(env, load(tmp_path, 0), 30)(0, False)
    jax.monitoring.register_event_listener(lambda event, **_: events.append(event))
    player = load(tmp_path, 2)
    del events[:]
    playing.simulator(env, player, 30)(5, True)
    assert "/jax/compilation_cache/cache_hits" in events
    assert "/jax/compilation_cache/cache_misses" not in events


def test_the_compilation_cache_is_that_of_training(tmp_path):
    code = (
        "import os\n"
        "for name in list(os.environ):\n"
        "    if name.startswith('JAX_'): del os.environ[name]\n"
        "os.environ['XDG_CACHE_HOME'] = 'here'\n"
        "from mjx_reinforce import train, watch\n"
        "assert train.configure_jax is watch.configure_jax\n"
        "watch.configure_jax()\n"
        "import jax\n"
        "print(jax.config.jax_compilation_cache_dir, jax.config.jax_default_matmul_precision)"
    )
    ran = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert ran.stdout.split() == ["here/mjx_reinforce", "highest"]


@struct.dataclass
class Moving(ToyState):
    qpos: jax.Array | None = None

    @property
    def pipeline_state(self):
        return self


class Breaking(Survive):
    """Leaves the finite numbers in its third step."""

    def reset(self, rng):
        del rng
        return Moving(jnp.zeros(1), jnp.zeros(()), jnp.zeros(()), qpos=jnp.zeros(1))

    def step(self, state, action):
        del action
        obs = state.obs + 1.0
        obs = jnp.where(obs > 2.5, jnp.nan, obs)
        return state.replace(obs=obs, reward=jnp.ones(()), qpos=obs)


def test_a_return_that_is_not_finite_is_nan(tmp_path):
    run = make_run(tmp_path, "InvertedPendulum-v5", observation_size=1)
    episode = playing.simulator(Breaking(), load(run), 20)(0, False)
    np.testing.assert_array_equal(episode.rewards, [1.0, 1.0, np.nan])
    np.testing.assert_array_equal(episode.qpos, [[0.0], [1.0], [2.0]])
    assert math.isnan(episode.total)
    said = watch.compare(watch.WatchSettings(run, episodes=2), {"mjx": lambda *_: episode})
    assert said == "mean return of 2 episodes: mjx nan (nan to nan)"


@pytest.mark.parametrize("env_id", ["CartPole-v1", "InvertedPendulum-v5"])
def test_gymnasium_plays_the_same_policy(tmp_path, env_id):
    make_run(tmp_path, env_id)
    # Its noise is far greater than the range of the actions.
    wide = {"params__constants": lambda log_std: np.full_like(log_std, 6.0)}
    change_arrays(tmp_path / "policy" / "actor.npz", checksum=None, **wide)
    player = load(tmp_path)
    version, play = playing.gymnasium_simulator(player, 15)
    assert version == gymnasium.__version__
    episode = play(3, False)
    env = gymnasium.make(env_id)
    observation, _ = env.reset(seed=3)
    for i, reward in enumerate(episode.rewards):
        seen = observation[::2] if env_id == "CartPole-v1" else observation[:2]
        np.testing.assert_allclose(episode.qpos[i], seen, rtol=1e-6)
        observation, expected, terminated, _, _ = env.step(player.act(observation))
        assert reward == expected
    assert terminated or len(episode.rewards) == 15
    assert len(episode.qpos) == len(episode.rewards) + 1
    noisy = [play(start, True).qpos for start in range(8)]
    np.testing.assert_array_equal(noisy[3], play(3, True).qpos)
    plain = [play(start, False).qpos for start in range(8)]
    assert any(x.shape != y.shape or np.any(x != y) for x, y in zip(noisy, plain, strict=True))


def test_both_simulations_are_said_side_by_side(tmp_path, monkeypatch, capsys):
    """The film is of the last one; nothing is drawn here."""

    class Blank:
        def __init__(self, *_):
            self.draw = lambda qpos, *_: np.full((8, 8, 3), len(qpos), np.uint8)

    monkeypatch.setattr(watch, "Renderer", Blank)
    monkeypatch.setattr(takes, "Renderer", Blank)
    run = make_run(tmp_path)
    watch_run(monkeypatch, run, "--backend", "gymnasium", "--episodes", 2)
    said = capsys.readouterr().out.splitlines()
    player = load(run)
    name, theirs = playing.gymnasium_simulator(player, 60)
    ours = playing.simulator(envs.make("CartPole-v1"), player, 60)
    episode = theirs(0, False)
    returned = f"return {episode.total:.1f} in {len(episode.rewards)} steps"
    assert said[0] == f"CartPole-v1, seed 1: {returned} in gymnasium {name}"
    for label, play in (("mjx", ours), (f"gymnasium {name}", theirs)):
        totals = [play(i, False).total for i in range(2)]
        words = f"{label} {sum(totals) / 2:.1f} ({min(totals):.1f} to {max(totals):.1f})"
        assert words in said[1]
    assert (run / "seed-1-gymnasium.gif").exists()


def test_a_simulator_that_is_not_there_is_named(tmp_path, monkeypatch):
    player = load(make_run(tmp_path))
    for env_id in ("ContinuousCartPole-v0", "os:path"):
        with pytest.raises(ValueError, match="leave --backend gymnasium out"):
            playing.gymnasium_simulator(player._replace(env=env_id), 9)
    with pytest.raises(ValueError, match=r"of 4 entries, the installed Gymnasium's .* \(10,\)"):
        playing.gymnasium_simulator(player._replace(env="Reacher-v5"), 9)
    monkeypatch.setitem(sys.modules, "gymnasium", None)
    with pytest.raises(ValueError, match=r"pip install 'gymnasium\[mujoco\]'"):
        playing.gymnasium_simulator(player, 9)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--backend", "gymnasium"], "pip install 'gymnasium[mujoco]'"),
        (["--sed", 3], "error: unknown flag '--sed'. Did you mean '--seed'?"),
        (["--width", "wide"], "--width takes a whole number, such as 4 or 2e6, got 'wide'"),
        (["--seed", 3], "has no seed 3: its seeds are 0 to 2"),
        (["--which", "best"], "has no policy/best"),
        (["--episodes", 0], "--episodes must be in [1, 10000], got 0"),
        (["--seconds", 0], "--seconds must be positive and finite, got 0"),
        (["--width", 5000], "--width must be in [1, 4096], got 5000"),
        (["--episode", -1], "--episode must be in [0, 2147483647], got -1"),
        (["--output", "nowhere/film.gif"], "cannot write to nowhere"),
        (["--output", "/proc/film.gif"], "cannot write to /proc; choose another --output"),
        (["--output", "film"], "film is no film"),
        (["--output", "policy.gif", "--overwrite"], "policy.gif exists"),
        (["--output", "config.json", "--overwrite"], "config.json is no film"),
        (["--output", "film.mp4"], "pip install mediapy imageio-ffmpeg"),
        (["--live"], "--live needs a screen, and neither DISPLAY nor WAYLAND_DISPLAY is set"),
        (["--live", "--backend", "mjx"], "--live needs C MuJoCo, and --backend is mjx"),
        (["--live", "--beside", "worst"], "--live shows one policy; leave --beside out"),
    ],
)
def test_bad_input_is_named(tmp_path, monkeypatch, capsys, arguments, message):
    make_run(tmp_path)
    (tmp_path / "policy.gif").mkdir()
    monkeypatch.chdir(tmp_path)
    for variable in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(variable, raising=False)
    for package in ("mediapy", "gymnasium"):
        monkeypatch.setitem(sys.modules, package, None)
    monkeypatch.setattr(envs, "make", lambda *_: pytest.fail("an environment was built"))
    with pytest.raises(SystemExit, match="2"):
        watch_run(monkeypatch, tmp_path, *arguments)
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


def test_a_policy_of_another_environment_is_named(tmp_path, monkeypatch, capsys):
    make_run(tmp_path)
    for file in ("config.json", "policy/policy.json"):
        change(tmp_path / file, env="Reacher-v5")
    change_arrays(tmp_path / "policy" / "actor.npz", checksum=None)
    with pytest.raises(SystemExit, match="2"):
        watch_run(monkeypatch, tmp_path)
    error = capsys.readouterr().err
    assert "takes observations of 4 entries, Reacher-v5 has 10" in error


@pytest.mark.parametrize("width", [48, 33])
def test_an_mp4_is_what_was_drawn(tmp_path, width):
    frames = np.zeros((5, 32, width, 3), np.uint8)
    frames[:, :16, :, 0] = 40 * np.arange(1, 6)[:, None, None]
    watch.write_film(tmp_path / "film.mp4", iter(frames), 25.0, [*frames[:1]])
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-i", tmp_path / "film.mp4"]
    command += ["-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    film = subprocess.run(command, capture_output=True, check=True)
    assert b" 25 fps" in film.stderr
    shown = np.frombuffer(film.stdout, np.uint8).reshape(frames.shape)
    assert np.abs(shown[..., 0].astype(int) - frames[..., 0]).mean() < 8
    assert [path.name for path in tmp_path.iterdir()] == ["film.mp4"]


def test_a_gif_has_the_colours_of_the_samples(tmp_path):
    """They are more than 256, the second half of them in the later samples alone."""
    ramp = np.arange(256, dtype=np.uint8)
    frames = np.zeros((6, 8, 256, 3), np.uint8)
    frames[:3, :, :, 0], frames[3:, :, :, 1] = ramp, ramp
    for i, frame in enumerate(frames):
        frame[:4, 40 * i : 40 * i + 40] = 255  # moves: equal pictures would become one
    watch.write_film(tmp_path / "film.gif", iter(frames), 25.0, [*frames[::2]])
    with Image.open(tmp_path / "film.gif") as film:
        assert film.n_frames == 6
        for i, frame in enumerate(frames):
            film.seek(i)
            shown = np.asarray(film.convert("RGB"), float)
            assert np.abs(shown - frame).mean() < 1


def test_what_takes_long_says_so_without_a_terminal(capfd, monkeypatch):
    monkeypatch.setattr(watch, "heartbeat", functools.partial(watch.heartbeat, interval=0.01))
    with watch._waiting("compiling and playing"):
        time.sleep(0.2)
    assert "still compiling and playing, 0 s" in capfd.readouterr().err


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


def test_wrapped_environments_are_filmed(tmp_path):
    """By a wrapper of brax's, which hands on all attributes, and by one's own, which has few."""
    (tmp_path / "wraps.py").write_text(WRAPPERS)
    run = make_run(tmp_path)
    change_arrays(run / "policy" / "actor.npz", checksum=None)
    frames = {}
    for name in ("CartPole-v1", "wraps:Plain", "wraps:OfBrax", "wraps:Twice"):
        for file in ("config.json", "policy/policy.json"):
            change(run / file, env=name)
        command = [sys.executable, "-m", "mjx_reinforce.watch", ".", "--env", name, "--overwrite"]
        options = ["--width", "96", "--height", "64"]
        subprocess.run([*command, *options], check=True, capture_output=True, cwd=run)
        with Image.open(run / "seed-1.gif") as film:
            frames[name] = film.n_frames, film.info["duration"]
    assert frames["CartPole-v1"] == frames["wraps:Plain"] == frames["wraps:OfBrax"]
    assert frames["wraps:Twice"][1] == 1000 * 2 * envs.make("CartPole-v1").dt


def test_an_environment_without_a_model_is_refused(register, tmp_path, monkeypatch, capsys):
    """Survive has what training needs, and no more."""
    make_run(tmp_path, "InvertedPendulum-v5", observation_size=1)
    for file in ("config.json", "policy/policy.json"):
        change(tmp_path / file, env="Survive-v0")
    change_arrays(tmp_path / "policy" / "actor.npz", checksum=None)
    with pytest.raises(SystemExit, match="2"):
        watch_run(monkeypatch, tmp_path)
    error = capsys.readouterr().err
    assert "Survive has no mj_model, so there is nothing to draw" in error
    assert "in a wrapper, set self.env to what it wraps" in error
    assert error.count("\n") == 1
