"""``python -m mjx_reinforce.watch RUN`` plays a trained policy and makes a film of it."""

import dataclasses
import functools
import json
import math
import os
import sys
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from rich.progress import track

from mjx_reinforce import envs
from mjx_reinforce.export.films import Renderer, import_mujoco, mediapy_with_ffmpeg, write_film
from mjx_reinforce.runs.alarms import silence_alarms

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
    """The film, .gif or, after pip install mediapy imageio-ffmpeg, .mp4.
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
    """Reads the command line, films, and exits: 0 done, 2 bad input, 130 interrupted."""
    silence_alarms()
    settings = tyro.cli(Settings, prog="python -m mjx_reinforce.watch")
    try:
        film(settings)
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        sys.exit(130)


def film(settings: Settings) -> None:
    """Plays the episode, says what it returned, and writes the film.

    Raises:
      ValueError: a setting is out of range, or the run is damaged, or nothing can be drawn here.
      OSError: a file cannot be read or written.
    """
    env_id, horizon = read_run(settings.run)
    output = check(settings)
    import_mujoco()
    from mjx_reinforce.export.policy_files import load_policy

    policy, actor = load_policy(settings.run / "policy", settings.seed)
    env = envs.make(env_id)
    expected, size = env.observation_size, actor.normalizer.mean.shape[0]
    if size != expected:
        raise ValueError(
            f"the policy in {settings.run} takes observations of {size} entries, "
            f"{env_id} has {expected}: config.json and policy/ are of different runs"
        )
    renderer = Renderer(scene(env), settings.width, settings.height)
    qpos, rewards = play(env, policy, actor, settings.episode, horizon, noise=settings.noise)
    print(f"{env_id}, seed {settings.seed}: return {rewards.sum():.1f} in {len(rewards)} steps")
    skip = max(1, math.ceil(1 / (env.dt * _MAX_RATE) - 1e-9))
    shown = qpos[: max(1, round(settings.seconds / env.dt)) : skip]
    frames = track(map(renderer.draw, shown), "drawing", len(shown), transient=True)
    write_film(output, frames, 1 / (env.dt * skip))
    print(f"{len(shown)} frames in {output}")


def check(settings: Settings) -> Path:
    """Returns the film's path.

    Raises:
      ValueError: a setting is out of range, or the film exists or cannot be written.
    """
    if not 0 < settings.seconds < float("inf"):
        raise ValueError(f"--seconds must be positive and finite, got {settings.seconds}")
    for name, least, most in (("width", 1, 4096), ("height", 1, 4096), ("episode", 0, 2**31 - 1)):
        value = getattr(settings, name)
        if not least <= value <= most:
            raise ValueError(f"--{name} must be in [{least}, {most}], got {value}")
    output = settings.output or settings.run / f"seed-{settings.seed}.gif"
    if output.suffix.lower() not in (".gif", ".mp4"):
        raise ValueError(f"{output} is no film; end --output in .gif or .mp4")
    if not os.access(output.parent, os.W_OK):
        raise ValueError(f"cannot write to {output.parent}; choose another --output")
    if output.is_dir() or (output.exists() and not settings.overwrite):
        raise ValueError(f"{output} exists; pass --overwrite or another --output")
    if output.suffix.lower() == ".mp4":
        mediapy_with_ffmpeg(output)
    return output


def read_run(directory: Path) -> tuple[str, int]:
    """Returns the id of a run's environment and its time limit in steps.

    Raises:
      ValueError: it is no run directory.
    """
    path = directory / "config.json"
    try:
        settings = json.loads(path.read_text(encoding="utf-8"))
        env_id, horizon = str(settings["env"]), int(settings["horizon"])
    except OSError as error:
        raise ValueError(
            f"{directory} is no run directory: cannot read {path} ({error.strerror})"
        ) from error
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{path} is damaged: {error!r}") from error
    if horizon < 1:
        raise ValueError(f"{path} is damaged: the horizon is {horizon}")
    if not (directory / "policy").is_dir():
        raise ValueError(f"{directory} has no policy yet: its training goes on, or was killed")
    return env_id, horizon


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
    env: Any, policy: Any, actor: Any, episode: int, horizon: int, *, noise: bool
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
      Positions [T + 1, nq], the start's first, and rewards [T], to the end of the episode: its
      own, the time limit, or the step before numbers are not finite.
    """
    import jax
    import jax.numpy as jnp

    from mjx_reinforce.engines.episode import begin, hold, step
    from mjx_reinforce.policies.actor import act

    distribution = policy.distribution
    play_step = functools.partial(step, env.step, functools.partial(act, policy), distribution)

    def advance(carry, noises):
        state, alive = carry
        played = play_step(actor, state, noises, alive, jnp.array(not noise))
        after = hold(alive, played.state, state)
        record = after.pipeline_state.qpos, played.reward, alive & ~played.broken
        return (after, played.alive), record

    @jax.jit
    def whole(key):
        start, noise_key = begin(env, key, jnp.asarray(episode))
        noises = distribution.noise(noise_key, (horizon,))
        first = start.pipeline_state.qpos
        return first, jax.lax.scan(advance, (start, jnp.array(True)), noises)[1]

    first, (qpos, rewards, mask) = jax.device_get(whole(jax.random.key(0)))
    return np.concatenate([first[None], qpos[mask]]), rewards[mask]


if __name__ == "__main__":
    main()
