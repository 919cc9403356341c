"""Films of the package's own policies, for README.md and docs: several beside each other."""

import itertools
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mjx_reinforce import Player, envs, load
from mjx_reinforce.console.jax_setup import configure_jax
from mjx_reinforce.engine.vector.pictures import import_mujoco
from mjx_reinforce.export.films import SAMPLES, Film, Take, gif, side_by_side
from mjx_reinforce.files import write_bytes
from mjx_reinforce.watch import scene

#: The tasks side by side, and the size of a file at most (bytes).
_TASKS = ("Hopper-v5", "HalfCheetah-v5", "Ant-v5", "Humanoid-v5", "HumanoidStandup-v5")
LARGEST = 300_000
#: How many colors a film has, if it may not have more, and then the share of it that is kept.
_FEWER_COLORS, _SHORTER = (128, 64, 32, 16, 8), (1.0, 0.75, 0.5)


def write(folder: Path, arm: Path | None) -> None:
    """Writes tasks.gif and, of a run of my_arm:Arm, arm.gif."""
    import_mujoco()
    configure_jax()
    folder.mkdir(parents=True, exist_ok=True)
    tasks = [_take(load(name), name[:-3].replace("HumanoidStandup", "Standup")) for name in _TASKS]
    save(folder / "tasks.gif", side_by_side(tasks, 190, 180, seconds=2.0, max_rate=10))
    if arm is not None:
        player = load(arm)
        balls = [_take(player, f"ball {i + 1}", episode=i) for i in range(3)]
        save(folder / "arm.gif", side_by_side(balls, 260, 220, seconds=3.0, max_rate=12))


def save(path: Path, film: Film) -> None:
    """Writes a film of ``LARGEST`` bytes at most, and says how large it is."""
    frames = [film.draw(frame) for frame in range(film.length)]
    write_small_gif(path, frames, film.rate, LARGEST)
    print(f"{path}: {path.stat().st_size / 1000:.0f} kB", flush=True)


def write_small_gif(path: Path, frames: Sequence[np.ndarray], rate: float, most_bytes: int) -> None:
    """Writes a .gif of so many bytes at most, with as many colors as that allows.

    If it is larger with the fewest colors, its end is left out.

    Args:
      path: .gif.
      frames: pictures [height, width, 3] uint8.
      rate: frames a second.
      most_bytes: of the file.

    Raises:
      ValueError: half of the film is larger with the fewest colors.
    """
    film = b""
    for share, colors in itertools.product(_SHORTER, _FEWER_COLORS):
        shown = frames[: math.ceil(share * len(frames))]
        film = gif(shown, rate, shown[:: -(-len(shown) // SAMPLES)], colors)
        if len(film) <= most_bytes:
            write_bytes(path, film)
            return
    raise ValueError(
        f"half of {path} would have {len(film)} bytes, {most_bytes} are allowed: make it smaller"
    )


def _take(player: Player, label: str, episode: int = 0) -> Take:
    """Returns an episode of a policy without noise."""
    from mjx_reinforce.playing import mujoco_simulator

    env = envs.make(player.env)
    played = mujoco_simulator(env, player, env.max_episode_steps)(episode, False)
    return Take(label, scene(env), env.dt, played.qpos, played.rewards)
