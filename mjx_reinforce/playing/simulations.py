"""Which simulation plays a policy."""

from collections.abc import Callable
from typing import TYPE_CHECKING

from mjx_reinforce.envs.base import MujocoEnv
from mjx_reinforce.export.player import Player
from mjx_reinforce.playing.cast import PolicySource
from mjx_reinforce.playing.mjx_playing import Episode, gymnasium_simulator, simulator
from mjx_reinforce.playing.mujoco_playing import mujoco_simulator
from mjx_reinforce.types import observation_size

if TYPE_CHECKING:
    from mjx_reinforce.types import Environment


def simulators(
    backend: str | None, env: "Environment", player: Player, source: PolicySource, push: float
) -> dict[str, Callable[[int, bool], Episode]]:
    """Returns what plays an episode, by name; the last is filmed, others are compared with it.

    Args:
      backend: as in ``watch.WatchSettings``.
      env: what is played.
      player: the policy.
      source: of the policy.
      push: the force of the pushes (N), 0 for none.

    Raises:
      ValueError: the simulation cannot play it.
    """
    horizon = source.horizon
    if backend is None:
        quick = source.run is None and isinstance(env, MujocoEnv)
        backend = "mujoco" if quick or push else "mjx"
    if backend == "mujoco":
        return {"mujoco": mujoco_simulator(env, player, horizon, push)}
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
