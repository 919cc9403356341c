"""``python -m mjx_reinforce.watch RUN`` plays a trained policy and makes a film of it."""

import ctypes.util
import dataclasses
import functools
import io
import json
import os
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from mjx_reinforce import envs

#: Frames a second at most: what a film shows, and what GIF viewers play.
_MAX_RATE = 30


@dataclasses.dataclass(frozen=True)
class Settings:
    """Play one episode of a trained policy, print its return, and make a film of it."""

    run: tyro.conf.Positional[Path]
    """The run directory that training left."""
    seed: int = 0
    """Which of the run's seeds plays."""
    episode: int = 0
    """Number of the start state; the same number, the same start."""
    noise: bool = False
    """Draw actions from the policy, as training does, instead of taking its mode."""
    output: Path | None = None
    """The film; .gif, or .mp4 and others where mediapy and ffmpeg are installed.
    By default RUN/seed-SEED.gif."""
    seconds: float = 20.0
    """Length of the film at most, in simulated seconds; the episode is played to its end."""
    width: int = 480
    """Pixels."""
    height: int = 360
    """Pixels."""
    overwrite: bool = False
    """Replace a film that exists."""


def main() -> None:
    """Reads the command line, plays, draws, and exits: 0 done, 2 bad input."""
    settings = tyro.cli(Settings, prog="python -m mjx_reinforce.watch")
    # Before MuJoCo is imported: without a screen it draws through EGL, where that is installed.
    if not os.environ.get("DISPLAY") and ctypes.util.find_library("EGL"):
        os.environ.setdefault("MUJOCO_GL", "egl")
    try:
        output = check(settings)
        env_id, horizon = read_run(settings.run)
        from mjx_reinforce.checkpoint import load_policy

        player = load_policy(settings.run / "policy", settings.seed)
        env = envs.make(env_id)
        renderer = Renderer(scene(env), settings.width, settings.height)
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
    qpos, rewards = play(env, *player, settings.episode, horizon, settings.noise)
    print(f"{env_id}, seed {settings.seed}: return {rewards.sum():.1f} in {len(rewards)} steps")
    skip = max(1, round(1 / (env.dt * _MAX_RATE)))
    shown = qpos[: max(1, round(settings.seconds / env.dt)) : skip]
    write_film(output, map(renderer.draw, shown), 1 / (env.dt * skip))
    print(f"{len(shown)} frames in {output}")


def check(settings: Settings) -> Path:
    """Returns the film's path.

    Raises:
      ValueError: a setting is out of range, or the film exists.
    """
    for name in ("seconds", "width", "height"):
        value = getattr(settings, name)
        if not 0 < value < float("inf"):
            raise ValueError(f"--{name} must be positive, got {value}")
    output = settings.output or settings.run / f"seed-{settings.seed}.gif"
    if not output.parent.is_dir():
        raise ValueError(f"there is no folder {output.parent}")
    if output.exists() and not settings.overwrite:
        raise ValueError(f"{output} exists; pass --overwrite or another --output")
    if output.suffix != ".gif":
        _ffmpeg(output)
    return output


def read_run(directory: Path) -> tuple[str, int]:
    """Returns the id of a run's environment and its time limit in steps.

    Raises:
      ValueError: it is no run directory.
    """
    path = directory / "config.json"
    try:
        settings = json.loads(path.read_text(encoding="utf-8"))
        return str(settings["env"]), int(settings["horizon"])
    except OSError as error:
        raise ValueError(
            f"{directory} is no run directory: cannot read {path} ({error.strerror})"
        ) from error
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{path} is damaged: {error}") from error


def scene(env: Any) -> Any:
    """Returns the MuJoCo model that an environment's ``qpos`` moves.

    Raises:
      ValueError: it has none.
    """
    if hasattr(env, "mj_model"):
        return env.mj_model
    if hasattr(env, "scene"):
        from mjx_reinforce.envs import models

        return models.load(env.scene)
    raise ValueError(f"{type(env).__name__} has no mj_model, so there is nothing to draw")


def play(
    env: Any, policy: Any, actor: Any, episode: int, horizon: int, noise: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Plays one episode.

    Args:
      env: what is played; its ``pipeline_state`` has ``qpos``.
      policy: the policy.
      actor: one seed's parameters and observation statistics.
      episode: number of the start state.
      horizon: the time limit in steps.
      noise: whether actions are drawn, or the policy's mode.

    Returns:
      Positions [T + 1, nq], the start's first, and rewards [T], to the end of the episode.
    """
    import jax
    import jax.numpy as jnp

    from mjx_reinforce import normalize
    from mjx_reinforce.rollouts import begin

    distribution = policy.distribution

    def step(carry, noises):
        state, alive = carry
        outputs = policy.apply(actor.params, normalize.apply(actor.normalizer, state.obs))
        drawn = distribution.sample(outputs, noises)
        after = env.step(state, drawn if noise else distribution.mode(outputs))
        after = jax.tree.map(lambda new, old: jnp.where(alive, new, old), after, state)
        record = after.pipeline_state.qpos, after.reward, alive
        return (after, alive & (after.done == 0)), record

    @jax.jit
    def whole(key):
        start, noise_key = begin(env, key, jnp.asarray(episode))
        noises = distribution.noise(noise_key, (horizon,))
        first = start.pipeline_state.qpos
        return first, jax.lax.scan(step, (start, jnp.array(True)), noises)[1]

    first, (qpos, rewards, mask) = jax.device_get(whole(jax.random.key(0)))
    return np.concatenate([first[None], qpos[mask]]), rewards[mask]


class Renderer:
    """Draws a model at given positions, through its camera "track" if it has one."""

    def __init__(self, model: Any, width: int, height: int):
        """Opens MuJoCo's renderer for pictures of so many pixels.

        Raises:
          ValueError: there is no OpenGL here.
        """
        import mujoco

        model.vis.global_.offwidth = max(model.vis.global_.offwidth, width)
        model.vis.global_.offheight = max(model.vis.global_.offheight, height)
        model.vis.headlight.ambient[:], model.vis.headlight.diffuse[:] = 0.4, 0.6
        cameras = [model.camera(i).name for i in range(model.ncam)]
        self._camera = "track" if "track" in cameras else -1
        self._model, self._data = model, mujoco.MjData(model)  # type: ignore - a C extension
        try:
            self._renderer = mujoco.Renderer(model, height, width)
        except Exception as error:  # each of MuJoCo's backends has its own
            raise ValueError(
                f"MuJoCo cannot draw here ({error}); install EGL (Debian: apt install libegl1) "
                "or set MUJOCO_GL to egl, osmesa or glfw, whichever this machine has"
            ) from error

    def draw(self, qpos: np.ndarray) -> np.ndarray:
        """Returns a picture [height, width, 3] uint8 at positions [nq]."""
        import mujoco

        self._data.qpos[:] = qpos
        mujoco.mj_forward(self._model, self._data)  # type: ignore - a C extension
        self._renderer.update_scene(self._data, self._camera)
        return self._renderer.render()


def write_film(path: Path, frames: Iterable[np.ndarray], rate: float) -> None:
    """Writes a film at once.

    Args:
      path: .gif, or what ffmpeg knows by its ending.
      frames: pictures [height, width, 3] uint8.
      rate: frames a second.
    """
    from mjx_reinforce.records import write_bytes

    if path.suffix == ".gif":
        from PIL import Image

        first, *rest = (Image.fromarray(frame) for frame in frames)
        film = io.BytesIO()
        save = functools.partial(first.save, film, format="GIF", save_all=True, loop=0)
        save(append_images=rest, duration=1000 / rate)
        write_bytes(path, film.getvalue())
    else:
        partial = path.with_name(f".{path.stem}.partial{path.suffix}")
        _ffmpeg(path).write_video(partial, list(frames), fps=rate)
        os.replace(partial, path)


def _ffmpeg(path: Path) -> Any:
    """Returns mediapy.

    Raises:
      ValueError: mediapy or ffmpeg is not installed.
    """
    try:
        import mediapy
    except ImportError:
        mediapy = None
    if mediapy is None or not mediapy.video_is_available():
        raise ValueError(
            f"films other than .gif, such as {path}, need mediapy and ffmpeg: "
            "pip install mediapy, and ffmpeg from your system"
        )
    return mediapy


if __name__ == "__main__":
    main()
