"""Single episodes of a trained policy, in our simulation and in Gymnasium's."""

import functools
import warnings
from collections.abc import Callable
from types import ModuleType
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mjx_reinforce.engines.episode import begin, hold, step
from mjx_reinforce.envs.in_mujoco import was_reset
from mjx_reinforce.export.films import import_gymnasium
from mjx_reinforce.export.player import Player
from mjx_reinforce.policies.actor import act

if TYPE_CHECKING:
    from mjx_reinforce.types import Environment


class Episode(NamedTuple):
    """One episode to its end: its own, the time limit, or where it leaves the finite numbers.

    qpos: [L, nq] generalised positions (m, rad), the start's first
    rewards: [T], nan in a step that left the finite numbers
    """

    qpos: np.ndarray
    rewards: np.ndarray

    @property
    def total(self) -> float:
        """The return, nan if the episode left the finite numbers."""
        return float(self.rewards.sum())


def simulator(env: "Environment", player: Player, horizon: int) -> Callable[[int, bool], Episode]:
    """Returns a function that plays in our simulation.

    The program depends neither on the seed nor on the start, so it is compiled once and found
    in the compilation cache afterwards.

    Args:
      env: what is played; its ``pipeline_state`` has ``qpos``.
      player: the policy.
      horizon: T, the time limit in steps.

    Returns:
      (number of the start state, whether actions are drawn or the policy's mode) -> the episode.
    """
    distribution = player.policy.distribution
    play_step = functools.partial(
        step, env.step, functools.partial(act, player.policy), distribution
    )

    @jax.jit
    def whole(actor, key, episode, deterministic):
        def advance(carry, noise):
            state, alive = carry
            played = play_step(actor, state, noise, alive, deterministic)
            after = hold(alive, played.state, state)
            reward = jnp.where(played.broken, jnp.nan, played.reward)
            return (after, played.alive), (after.pipeline_state.qpos, reward, alive)

        start, noise_key = begin(env, jax.random.fold_in(key, episode))
        noises = distribution.noise(noise_key, (horizon,))
        first = start.pipeline_state.qpos
        return first, jax.lax.scan(advance, (start, jnp.array(True)), noises)[1]

    def play(episode: int, noise: bool) -> Episode:
        arguments = player.actor, jax.random.key(0), jnp.asarray(episode), jnp.asarray(not noise)
        first, (qpos, rewards, mask) = jax.device_get(whole(*arguments))
        rewards = rewards[mask]
        shown = qpos[mask][: len(rewards) - bool(np.isnan(rewards[-1]))]
        return Episode(np.concatenate([first[None], shown]), rewards)

    return play


def gymnasium_simulator(player: Player, horizon: int) -> tuple[str, Callable[[int, bool], Episode]]:
    """Returns the version of the installed Gymnasium, and a function that plays in it.

    Args:
      player: the policy.
      horizon: the time limit in steps.

    Returns:
      The version, and (seed of the start state, whether actions are drawn or the policy's
      mode) -> the episode.

    Raises:
      ValueError: Gymnasium is not installed, or has no such environment.
    """
    gymnasium = import_gymnasium()
    env = _make_env(gymnasium, player, horizon)

    def play(episode: int, noise: bool) -> Episode:
        rng = np.random.default_rng(episode) if noise else None
        observation, _ = env.reset(seed=episode)
        qpos, rewards, ended = [_positions(env)], [], False
        while not ended:
            observation, reward, terminated, truncated, _ = env.step(player.act(observation, rng))
            broken = hasattr(env.unwrapped, "data") and was_reset(env.unwrapped.data)
            rewards.append(np.nan if broken else reward)
            if not broken:
                qpos.append(_positions(env))
            ended = terminated or truncated or broken
        return Episode(np.stack(qpos), np.asarray(rewards, float))

    return gymnasium.__version__, play


def _make_env(gymnasium: ModuleType, player: Player, horizon: int) -> Any:
    """Returns Gymnasium's environment; raises ValueError as ``gymnasium_simulator``."""
    if ":" in player.env:  # to Gymnasium, "module:id" is a module to import
        raise ValueError(f"{player.env} is not Gymnasium's; leave --backend gymnasium out")
    try:
        # What MuJoCo and Gymnasium deprecate is no news to who only wants to watch.
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            env = gymnasium.make(player.env, max_episode_steps=horizon)
    except gymnasium.error.Error as error:
        reason = str(error).splitlines()[0]
        raise ValueError(
            f"Gymnasium cannot make {player.env} ({reason}); leave --backend gymnasium out"
        ) from error
    shape = env.observation_space.shape
    if shape != (player.observation_size,):
        raise ValueError(
            f"the policy for {player.env} takes observations of {player.observation_size} "
            f"entries, the installed Gymnasium's have shape {shape}"
        )
    return env


def _positions(env: Any) -> np.ndarray:
    """Returns the positions [nq] of a MuJoCo task, or of the classic cart and pole."""
    task = env.unwrapped
    return np.array(task.data.qpos if hasattr(task, "data") else task.state[::2])
