"""The best and the median policy of every task in Gymnasium and in our simulation, and films."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

from experiments.kit.episodes import own_simulation
from experiments.studies.results.films import save
from experiments.studies.results.kept import POLICIES, write_played
from experiments.studies.results.runs import has_policies
from experiments.studies.results.tasks import ROOT, Task
from mjx_reinforce import Player, envs, load
from mjx_reinforce.console.jax_setup import configure_jax
from mjx_reinforce.engine.vector.pictures import import_mujoco
from mjx_reinforce.export.films import Take, side_by_side
from mjx_reinforce.export.run_files import Run, read_run
from mjx_reinforce.watch import scene

#: Films: their length (simulated s), frames a second, and size (pixels).
_SECONDS, _RATE, _SIZE = 6.0, 12, (320, 240)


def play(tasks: Iterable[Task], directory: Path, films: Path, num_episodes: int) -> None:
    """Plays the policies of those tasks whose runs have some, and films the best in Gymnasium.

    Args:
      tasks: of the results.
      directory: of the stages; the returns go to DIR/play/TASK.csv.
      films: the folder of films, TASK-best.gif.
      num_episodes: of each policy in each simulation.
    """
    import_mujoco()
    configure_jax()
    films.mkdir(parents=True, exist_ok=True)
    for task in tasks:
        path = directory / "play" / f"{task.name}.csv"
        if path.exists() or not has_policies(directory / task.name):
            print(f"{task.name} is {'played' if path.exists() else 'not trained'}", flush=True)
            continue
        print(f"== {task.name}", flush=True)
        run = read_run(directory / task.name)
        ours = own_simulation(run, load(run.directory), num_episodes)
        rows: list[dict[str, Any]] = []
        for policy in POLICIES:
            film = films / f"{task.name}-best.gif" if policy == "best" else None
            rows += _play(run, policy, num_episodes, ours, film)
        write_played(path, rows)


def _play(
    run: Run, policy: Any, num_episodes: int, ours: Any, film: Path | None
) -> list[dict[str, Any]]:
    """Plays one policy, films it if so wished, and returns a row for each episode."""
    from mjx_reinforce.export.policy_files import load_seed

    player, _ = load_seed(run, policy)
    env = gymnasium.make(run.env, max_episode_steps=run.horizon)
    episodes = [_play_in_gymnasium(env, player, number) for number in range(num_episodes)]
    returns = {
        "ours": np.asarray(ours(player.actor, ROOT + 1), float).tolist(),
        f"gymnasium {gymnasium.__version__}": [episode.total for episode in episodes],
    }
    for name, values in returns.items():
        print(f"{policy}, seed {player.seed}: mean return {np.mean(values):.1f} in {name}")
    if film is not None:
        _film(film, run.env, f"{run.env}, {policy} seed", episodes)
    return [
        {
            "policy": policy,
            "seed": player.seed,
            "simulation": name,
            "episode": number,
            "return": f"{value:.9g}",
        }
        for name, values in returns.items()
        for number, value in enumerate(values)
    ]


def _play_in_gymnasium(env: gymnasium.Env, player: Player, episode: int) -> Any:
    """Returns the episode of a policy without noise from the start of a number."""
    from mjx_reinforce.playing import Episode

    task: Any = env.unwrapped

    def positions() -> np.ndarray:
        return np.array(task.data.qpos if hasattr(task, "data") else task.state[::2])

    observation, _ = env.reset(seed=episode)
    qpos, rewards, ended = [positions()], [], False
    while not ended:
        observation, reward, terminated, truncated, _ = env.step(player.act(observation))
        qpos.append(positions())
        rewards.append(reward)
        ended = terminated or truncated
    return Episode(np.stack(qpos), np.array(rewards, float))


def _film(path: Path, env_id: str, label: str, episodes: Sequence[Any]) -> None:
    """Writes a film of episodes one after the other, until it is long enough."""
    env = envs.make(env_id)
    qpos = np.concatenate([episode.qpos for episode in episodes])
    # The return is a sum over the film: each episode but the first begins by taking back the last.
    rewards = [np.append(episode.rewards, -episode.rewards.sum()) for episode in episodes]
    take = Take(label, scene(env), env.dt, qpos, np.concatenate(rewards)[:-1])
    save(path, side_by_side([take], *_SIZE, seconds=_SECONDS, max_rate=_RATE))
