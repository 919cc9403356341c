"""Single episodes of a trained policy: in our simulation, and in C MuJoCo, which starts at once."""

import functools
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mjx_reinforce.engine.base import term_names
from mjx_reinforce.engine.episode import begin, hold, step
from mjx_reinforce.engine.play.choice import environment_of
from mjx_reinforce.envs.c_mujoco.in_mujoco import InMujoco
from mjx_reinforce.export.policy_files import Player
from mjx_reinforce.learning.policy import act

if TYPE_CHECKING:
    from mjx_reinforce.engine.base import Environment


class Episode(NamedTuple):
    """One episode to its end: its own, the time limit, or where it leaves the finite numbers.

    qpos: [L, nq] generalized positions (m, rad), the start's first
    rewards: [T], nan in a step that left the finite numbers
    terms: [T] each, terms of the reward by name; none where it has fewer than two
    commands: [L, K] the entry "command" of the memory, or of the episode; None without one
    pushes: [T] whether C MuJoCo began the step with a push; None of our simulation
    """

    qpos: np.ndarray
    rewards: np.ndarray
    terms: Mapping[str, np.ndarray] = MappingProxyType({})
    commands: np.ndarray | None = None
    pushes: np.ndarray | None = None

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
    # Here too C MuJoCo computes the physics where nothing else is faster.
    env, _ = environment_of("auto", env)
    unclipped = player.policy.distribution

    def sample(*inputs: jax.Array) -> jax.Array:
        return unclipped.clip(unclipped.sample(*inputs))

    # Training draws actions as they come; a policy that is ready plays within the bounds.
    distribution = unclipped._replace(sample=sample)
    names = term_names(env)
    play_step = functools.partial(
        step, env.step, functools.partial(act, player.policy), distribution, terms=names
    )

    @jax.jit
    def play_episode(actor, key, episode, deterministic):
        """Returns ``qpos`` and command of the start; of T steps these, rewards, terms, a mask."""

        def advance(carry, noise):
            """Plays a step; behind the episode's end the state stays as it was."""
            state, is_alive = carry
            played_step = play_step(actor, state, noise, is_alive, deterministic)
            next_state = hold(is_alive, played_step.state, state)
            # A step out of the finite numbers ends the episode, and its reward is none.
            reward = jnp.where(played_step.broken, jnp.nan, played_step.reward)
            return (next_state, played_step.alive), (
                (next_state.pipeline_state.qpos, _command(next_state)),
                reward,
                played_step.terms,
                is_alive,
            )

        start, noise_key = begin(env, jax.random.fold_in(key, episode))
        noises = distribution.noise(noise_key, (horizon,))
        _, steps = jax.lax.scan(advance, (start, jnp.array(True)), noises)
        return (start.pipeline_state.qpos, _command(start)), steps

    def play(episode: int, noise: bool) -> Episode:
        """Plays the episode of a number, from this function's one compiled program."""
        number = jnp.asarray(episode)
        deterministic = jnp.asarray(not noise)
        played = play_episode(player.actor, jax.random.key(0), number, deterministic)
        start, (poses, rewards, terms, mask) = jax.device_get(played)
        rewards = rewards[mask]
        # The last pose of a broken episode cannot be drawn.
        num_poses = len(rewards) - int(np.isnan(rewards[-1]))
        qpos, commands = (
            np.concatenate([x[None], later[mask][:num_poses]])
            for x, later in zip(start, poses, strict=True)
        )
        terms = {name: terms[name][mask] for name in names}
        return Episode(qpos, rewards, terms, commands if commands.size else None)

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
    names = term_names(env)

    def play(episode: int, noise: bool) -> Episode:
        """Plays the episode of a number, from the start that it has in our simulation, too."""
        rng = np.random.default_rng(episode) if noise else None
        observation = simulation.reset(_start_key(episode))
        has_ended = False
        # Copies: MuJoCo writes every step into the same array.
        qpos = [simulation.data.qpos.copy()]
        commands = [simulation.command]
        rewards, terms, pushes = [], [], []
        while not has_ended and len(rewards) < horizon:
            observation, reward, has_ended = simulation.step(
                np.asarray(player.act(observation, rng))
            )
            terms.append([simulation.terms[name] for name in names])
            pushes.append(simulation.is_pushed)
            if not (np.isfinite(observation).all() and np.isfinite(reward)):
                rewards.append(np.nan)
                break
            rewards.append(reward)
            qpos.append(simulation.data.qpos.copy())
            commands.append(simulation.command)
        columns = dict(zip(names, np.array(terms).T, strict=True))
        return Episode(
            qpos=np.stack(qpos),
            rewards=np.array(rewards),
            terms=columns,
            commands=np.stack(commands) if simulation.command.size else None,
            pushes=np.array(pushes),
        )

    return play


def _command(state: Any) -> jax.Array:
    """Returns the numbers [K] of the entry "command", as ``InMujoco.command``."""
    physics = state.pipeline_state
    entries = getattr(physics, "episode", {}) | getattr(physics, "memory", {})
    return jnp.ravel(jnp.asarray(entries.get("command", ()), float))


@jax.jit
def _start_key(episode: int) -> jax.Array:
    """Returns the key of an episode's start; one program compiles sooner than its parts."""
    return jax.random.split(jax.random.fold_in(jax.random.key(0), episode))[0]
