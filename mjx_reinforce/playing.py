"""Single episodes of a trained policy: in our simulation, and in C MuJoCo, which starts at once."""

import functools
from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mjx_reinforce.engine.episode import begin, hold, step
from mjx_reinforce.envs.in_mujoco import InMujoco
from mjx_reinforce.export.policy_files import Player
from mjx_reinforce.learning.policy import act

if TYPE_CHECKING:
    from mjx_reinforce.engine.base import Environment


class Episode(NamedTuple):
    """One episode to its end: its own, the time limit, or where it leaves the finite numbers.

    qpos: [L, nq] generalized positions (m, rad), the start's first
    rewards: [T], nan in a step that left the finite numbers
    """

    qpos: np.ndarray
    rewards: np.ndarray

    @property
    def total(self) -> float:
        """The return, nan if the episode left the finite numbers."""
        return float(self.rewards.sum())


#: Plays the episode from the start state of a number; True draws actions, False takes the mode.
Simulator = Callable[[int, bool], Episode]


def simulator(env: "Environment", player: Player, horizon: int) -> Simulator:
    """Returns a function that plays in our simulation.

    The program depends neither on the seed nor on the start, so it is compiled once and found
    in the compilation cache afterwards.

    Args:
      env: what is played; its ``pipeline_state`` has ``qpos``.
      player: the policy.
      horizon: T, the time limit in steps.
    """
    drawn = player.policy.distribution
    distribution = drawn._replace(sample=lambda *given: drawn.clip(drawn.sample(*given)))
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


def mujoco_simulator(env: "Environment", player: Player, horizon: int) -> Simulator:
    """Returns a function that plays in C MuJoCo.

    Args:
      env: a task of ``MujocoEnv``.
      player: the policy.
      horizon: T, the time limit in steps.

    Raises:
      ValueError: C MuJoCo cannot play the task, see ``InMujoco``.
    """
    simulation = InMujoco(env)

    def play(episode: int, noise: bool) -> Episode:
        rng = np.random.default_rng(episode) if noise else None
        observation, ended = simulation.reset(_start_key(episode)), False
        qpos, rewards = [simulation.data.qpos.copy()], []
        while not ended and len(rewards) < horizon:
            observation, reward, ended = simulation.step(np.asarray(player.act(observation, rng)))
            if not (np.isfinite(observation).all() and np.isfinite(reward)):
                rewards.append(np.nan)
                break
            rewards.append(reward)
            qpos.append(simulation.data.qpos.copy())
        return Episode(np.stack(qpos), np.array(rewards))

    return play


@jax.jit
def _start_key(episode: int) -> jax.Array:
    """Returns the key of an episode's start; one program compiles sooner than its parts."""
    return jax.random.split(jax.random.fold_in(jax.random.key(0), episode))[0]
