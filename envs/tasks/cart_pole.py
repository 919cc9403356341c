"""Two tasks of a cart with a pole: the classic one and one with a continuous force.

``Cart`` has what both share: the start, the dynamics in closed form, the end.
"""

import dataclasses
import math
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from mjx_reinforce.engine.base import Box, Discrete
from mjx_reinforce.engine.checks import changed_fields
from mjx_reinforce.envs.base import Env, State
from mjx_reinforce.envs.settings import EpisodeSettings, build_settings

# The constants of Gymnasium's cart-pole, in SI units.
_GRAVITY = 9.8
_CART_MASS = 1.0
_POLE_MASS = 0.1
_HALF_LENGTH = 0.5
_TIMESTEP = 0.02
_FORCE = 10.0
_MAX_POSITION = 2.4
_START_NOISE = 0.05


@struct.dataclass(kw_only=True)
class Motion:
    """Where the cart is and how it moves.

    qpos: [2] cart position (m), pole angle from upright (rad)
    qvel: [2] cart velocity (m/s), pole angular velocity (rad/s)
    """

    qpos: jax.Array
    qvel: jax.Array


class Cart(Env):
    """A cart on a rail with a pole on it; tasks define ``action_space`` and ``step``."""

    settings: EpisodeSettings

    dt = _TIMESTEP
    frame_skip = 1
    #: The model that shows ``qpos`` in pictures and videos; the dynamics do not use it.
    scene = "cart_pole.xml"
    action_space: Box | Discrete
    #: The pole is lost beyond this angle from upright (rad).
    max_angle: float

    def __init__(self, **arguments: Any):
        """Builds the task.

        Args:
          **arguments: the fields of the class's ``Settings``.

        Raises:
          ValueError: an argument is unknown or out of its range.
        """
        self.settings = build_settings(self, arguments)
        self.max_episode_steps = self.settings.max_episode_steps
        self.reward_threshold = self.settings.reward_threshold

    @property
    def observation_size(self) -> int:
        """The number O of entries of an observation."""
        return 4

    def __repr__(self) -> str:
        return f"{type(self).__name__}({changed_fields(self.settings)})"

    @property
    def action_size(self) -> int:
        """The number of entries of a continuous action, or of discrete ones to choose from."""
        space = self.action_space
        return space.num_actions if isinstance(space, Discrete) else len(space.low)

    @property
    def backend(self) -> str:
        """The physics engine, for brax's interface."""
        return "closed form"

    def reset(self, rng: jax.Array) -> State:
        """Returns a start uniform within 0.05 (m, rad, m/s, rad/s); consumes the key."""
        qpos, qvel = jax.random.uniform(rng, (2, 2), minval=-_START_NOISE, maxval=_START_NOISE)
        return self.set_state(qpos, qvel)

    def set_state(self, qpos: jax.Array, qvel: jax.Array) -> State:
        """Returns the state at a given position and angle [2] and their rates [2]."""
        zero = jnp.zeros((), qpos.dtype)
        return _state(qpos, qvel, zero, zero)

    def push(
        self, state: State, force: jax.Array | float, reward_up: float, reward_lost: float
    ) -> State:
        """Returns the state a timestep later.

        Args:
          state: where the cart and the pole are.
          force: on the cart (N), [].
          reward_up: the reward of a step that does not end the episode.
          reward_lost: the reward of the step that does.
        """
        motion = cast(Motion, state.pipeline_state)
        qacc = _acceleration(motion, force)
        qvel = motion.qvel + _TIMESTEP * qacc
        # Explicit Euler, as in Gymnasium: positions move by the old velocities.
        qpos = motion.qpos + _TIMESTEP * motion.qvel
        is_lost = jnp.any(jnp.abs(qpos) > jnp.array([_MAX_POSITION, self.max_angle], qpos.dtype))
        reward = jnp.where(is_lost, reward_lost, reward_up).astype(qpos.dtype)
        return _state(qpos, qvel, reward, is_lost.astype(qpos.dtype), state)


class CartPole(Cart):
    """Gymnasium's CartPole (gymnasium/envs/classic_control/cartpole.py).

    Observation, O = 4: cart position (m), cart velocity (m/s), pole angle (rad), pole angular
    velocity (rad/s). Action, an integer: 0 pushes the cart with -10 N, 1 with 10 N.

    Reward: 1 every step, the last included. Start: every entry uniform within 0.05. Terminates
    when the cart leaves 2.4 m or the pole 12 degrees. Steps of 0.02 s; v0 is solved at a return
    of 195 of at most 200, v1 at 475 of 500.
    """

    @dataclasses.dataclass(frozen=True, kw_only=True)
    class Settings(EpisodeSettings):
        """Arguments of CartPole."""

        max_episode_steps: int = 500
        """The time limit (env steps): 500 is v1, 200 is v0."""
        reward_threshold: float | None = 475.0
        """The return at which the task is solved: 475 is v1, 195 is v0."""
        sutton_barto_reward: bool = False
        """Whether to pay 0 while the pole is up and -1 on the step that ends the episode."""

    settings: Settings
    action_space = Discrete(2)
    max_angle = 12 * 2 * math.pi / 360

    def step(self, state: State, action: jax.Array) -> State:
        """Returns the state one step later under ``action`` []."""
        sutton_barto = self.settings.sutton_barto_reward
        reward_up = 0.0 if sutton_barto else 1.0
        reward_lost = -1.0 if sutton_barto else 1.0
        force = jnp.where(action == 1, _FORCE, -_FORCE)
        return self.push(state, force, reward_up, reward_lost)


class ContinuousCartPole(Cart):
    """A cart pushed by any force (document 002, a classic cart with a Box of actions).

    Observation: as ``CartPole``. Action, A = 1: force on the cart in [-1, 1], times 10 (N), not
    clipped.

    Reward: 1 each step, 0 on the one that loses the pole. Start: every entry uniform within 0.05.
    Terminates when the cart leaves 2.4 m or the pole 20 degrees. At most 50 steps of 0.02 s, so
    that no return is above 50; the document names no threshold.
    """

    @dataclasses.dataclass(frozen=True, kw_only=True)
    class Settings(EpisodeSettings):
        """Arguments of ContinuousCartPole."""

        max_episode_steps: int = 50
        reward_threshold: float | None = 50.0

    settings: Settings
    action_space = Box(np.array([-1.0]), np.array([1.0]))
    max_angle = 20 * math.pi / 180

    def step(self, state: State, action: jax.Array) -> State:
        """Returns the state one step later under ``action`` [1]."""
        return self.push(state, _FORCE * action[0], 1.0, 0.0)


def _acceleration(motion: Motion, force: jax.Array | float) -> jax.Array:
    """Returns the accelerations [2] (m/s^2, rad/s^2).

    Florian (2007), Correct equations for the dynamics of the cart-pole system, equations 23 and
    24 without friction.
    """
    angle = motion.qpos[1]
    rate = motion.qvel[1]
    sine = jnp.sin(angle)
    cosine = jnp.cos(angle)
    mass = _CART_MASS + _POLE_MASS
    moment = _POLE_MASS * _HALF_LENGTH
    # The cart's acceleration if the pole did not turn faster or slower.
    push = (force + moment * rate**2 * sine) / mass
    # 4/3 is the pole's inertia about its end, over its mass and its half length squared.
    angular_acceleration = (_GRAVITY * sine - cosine * push) / (
        _HALF_LENGTH * (4.0 / 3.0 - _POLE_MASS * cosine**2 / mass)
    )
    acceleration = push - moment * angular_acceleration * cosine / mass
    return jnp.stack([acceleration, angular_acceleration])


def _state(qpos, qvel, reward, terminated, previous: State | None = None) -> State:
    """Returns a state; all else is as in the previous one, such as what wrappers keep there."""
    motion = cast(Any, Motion(qpos=qpos, qvel=qvel))
    # Gymnasium's order is position and velocity of the cart, then of the pole.
    obs = jnp.stack([qpos[0], qvel[0], qpos[1], qvel[1]])
    if previous is None:
        return State(motion, obs, reward, terminated)
    return dataclasses.replace(
        previous, pipeline_state=motion, obs=obs, reward=reward, done=terminated
    )
