"""Episodes of a trained policy in C MuJoCo, which starts in seconds, and in its viewer.

``simulators`` says which simulation plays.
"""

import itertools
import time
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import numpy as np

from mjx_reinforce.envs.base import MujocoEnv
from mjx_reinforce.envs.in_mujoco import InMujoco
from mjx_reinforce.export.player import Player
from mjx_reinforce.playing.cast import PolicySource
from mjx_reinforce.playing.mjx_playing import Episode, gymnasium_simulator, simulator
from mjx_reinforce.types import observation_size

if TYPE_CHECKING:
    from mjx_reinforce.envs.base import MujocoEnv
    from mjx_reinforce.types import Environment, MjModel


class Moment(NamedTuple):
    """What one env step left.

    reward: nan where the simulation left the finite numbers
    ended: whether the episode is over by its own rule
    """

    reward: float
    ended: bool


def mujoco_simulator(
    env: "Environment", player: Player, horizon: int
) -> Callable[[int, bool], Episode]:
    """Returns a function that plays in C MuJoCo.

    Args:
      env: a task of ``MujocoEnv``.
      player: the policy.
      horizon: T, the time limit in steps.

    Returns:
      (seed of the start state, whether actions are drawn or the policy's mode) -> the episode.

    Raises:
      ValueError: C MuJoCo cannot play the task, see ``InMujoco``.
    """
    simulation = InMujoco(env)

    def play(episode: int, noise: bool) -> Episode:
        steps = simulate(simulation, player, episode, noise)
        rewards, qpos = [], []
        for moment in itertools.islice(steps, 1 + horizon):
            if moment is not None:
                rewards.append(moment.reward)
            if moment is None or np.isfinite(moment.reward):
                qpos.append(simulation.data.qpos.copy())
        return Episode(np.stack(qpos), np.array(rewards))

    return play


def simulate(
    simulation: InMujoco, player: Player, episode: int, noise: bool
) -> Iterator[Moment | None]:
    """Plays an episode until it ends by its own rule; yields None at its start, then each step."""
    rng = np.random.default_rng(episode) if noise else None
    observation, ended = simulation.reset(_start_key(episode)), False
    yield None
    while not ended:
        observation, reward, ended = simulation.step(np.asarray(player.act(observation, rng)))
        simulation.data.xfrc_applied[:] = 0
        broken = not (np.isfinite(observation).all() and np.isfinite(reward))
        ended = ended or broken
        yield Moment(np.nan if broken else reward, ended)


@jax.jit
def _start_key(episode: int) -> jax.Array:
    """Returns the key of an episode's start; one program compiles sooner than its parts."""
    return jax.random.split(jax.random.fold_in(jax.random.key(0), episode))[0]


def live(env: "MujocoEnv", model: "MjModel", player: Player, horizon: int, settings: Any) -> None:
    """Plays episode after episode in MuJoCo's viewer, at the speed of life, until it is closed.

    The mouse pulls at bodies: a double click selects one, Ctrl and a drag pulls.

    Args:
      env: a task of ``MujocoEnv``.
      model: what is drawn, with the bodies of the task's own model.
      player: the policy.
      horizon: the time limit in steps.
      settings: ``episode`` and ``noise``, as in ``watch.WatchSettings``.

    Raises:
      ValueError: the viewer does not open, or C MuJoCo cannot play the task.
    """
    import mujoco.viewer

    kinds: Any = mujoco
    simulation, drawn = InMujoco(env), kinds.MjData(model)
    try:
        window = mujoco.viewer.launch_passive(model, drawn, show_left_ui=False, show_right_ui=False)
    except Exception as error:  # of GLFW, or on macOS, where it wants mjpython
        raise ValueError(
            f"MuJoCo's viewer does not open ({error}); on macOS, start with mjpython in place of "
            "python; leave --live out to write a film"
        ) from error
    with window:
        for episode in itertools.count(settings.episode):
            total, due = 0.0, time.monotonic()
            steps = simulate(simulation, player, episode, settings.noise)
            for moment in itertools.islice(steps, 1 + horizon):
                if not window.is_running():
                    return
                total += moment.reward if moment is not None else 0.0
                drawn.qpos[:] = simulation.data.qpos
                kinds.mj_forward(model, drawn)
                drawn.xfrc_applied[:] = 0
                kinds.mjv_applyPerturbForce(model, drawn, window.perturb)
                simulation.data.xfrc_applied[:] = drawn.xfrc_applied
                window.sync()
                due += env.dt
                time.sleep(max(0.0, due - time.monotonic()))
            print(f"episode {episode}: return {total:.1f}", flush=True)


def simulators(
    backend: str | None, env: "Environment", player: Player, source: PolicySource
) -> dict[str, Callable[[int, bool], Episode]]:
    """Returns what plays an episode, by name; the last is filmed, others are compared with it.

    Args:
      backend: as in ``watch.WatchSettings``.
      env: what is played.
      player: the policy.
      source: of the policy.

    Raises:
      ValueError: the simulation cannot play it.
    """
    horizon = source.horizon
    if backend is None:
        quick = source.run is None and isinstance(env, MujocoEnv)
        backend = "mujoco" if quick else "mjx"
    if backend == "mujoco":
        return {"mujoco": mujoco_simulator(env, player, horizon)}
    found: dict[str, Callable[[int, bool], Episode]] = {"mjx": simulator(env, player, horizon)}
    if backend == "gymnasium":
        if source.run is not None and source.run.env_set:
            raise ValueError(
                f"--backend gymnasium plays {source.env} as it is, and {source.run.directory} was "
                f"trained with --env-set {' '.join(source.run.env_set)}: choose --backend mujoco"
            )
        version, play = gymnasium_simulator(player, horizon)
        found[f"gymnasium {version}"] = play
    return found


def check_observations(env: "Environment", player: Player, source: PolicySource) -> None:
    """Raises ValueError for a policy of a run whose observations are not the environment's."""
    if source.run is None:
        return
    if (size := observation_size(env)) != player.observation_size:
        raise ValueError(
            f"the policy in {source.run.directory} takes observations of "
            f"{player.observation_size} entries, {source.env} has {size}: config.json and policy/ "
            "are of different runs"
        )
