"""Films of the package's own policies, for README.md and docs: several beside each other."""

from pathlib import Path

from mjx_reinforce import Player, envs, load
from mjx_reinforce.console.jax_setup import configure_jax
from mjx_reinforce.export.films import import_mujoco, write_small_gif
from mjx_reinforce.export.takes import Film, Take, side_by_side
from mjx_reinforce.playing.cast import untrained
from mjx_reinforce.watch import scene

#: The tasks side by side, and the size of a file at most (bytes).
_TASKS, LARGEST = ("Hopper-v5", "HalfCheetah-v5", "Walker2d-v5", "Ant-v5"), 300_000


def write(folder: Path, arm: Path | None) -> None:
    """Writes tasks.gif, before-and-after.gif, pushed.gif and, of a run of my_arm:Arm, arm.gif."""
    import_mujoco()
    configure_jax()
    folder.mkdir(parents=True, exist_ok=True)
    tasks = [_take(load(name), name.removesuffix("-v5")) for name in _TASKS]
    save(folder / "tasks.gif", side_by_side(tasks, 176, 176, seconds=3.0, max_rate=12))
    hopper = load("Hopper-v5")
    both = [_take(untrained(hopper), "before training"), _take(hopper, "after training")]
    save(folder / "before-and-after.gif", side_by_side(both, 240, 240, seconds=4.0, max_rate=12))
    if arm is not None:
        player = load(arm)
        balls = [_take(player, f"ball {i + 1}", episode=i) for i in range(3)]
        save(folder / "arm.gif", side_by_side(balls, 260, 220, seconds=3.0, max_rate=12))
    push = 20.0
    pushed = [_take(load("InvertedPendulum-v5"), f"pushed with {push:.0f} N", push)]
    save(folder / "pushed.gif", side_by_side(pushed, 320, 240, seconds=9.0, max_rate=12))


def save(path: Path, film: Film) -> None:
    """Writes a film of ``LARGEST`` bytes at most, and says how large it is."""
    frames = [film.draw(frame) for frame in range(film.length)]
    write_small_gif(path, frames, film.rate, LARGEST)
    print(f"{path}: {len(frames)} frames, {path.stat().st_size / 1000:.0f} kB", flush=True)


def _take(player: Player, label: str, push: float = 0.0, episode: int = 0) -> Take:
    """Returns an episode of a policy without noise."""
    from mjx_reinforce.playing.mujoco_playing import mujoco_simulator, pushed_body

    env = envs.make(player.env)
    played = mujoco_simulator(env, player, env.max_episode_steps, push)(episode, False)
    body = pushed_body(env.mj_model)
    return Take(label, scene(env), env.dt, played.qpos, played.rewards, played.pushes, body)
