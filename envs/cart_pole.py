"""Two tasks of a cart with a pole: the classic one and one with a continuous force."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np

from mjx_reinforce.envs.base import State
from mjx_reinforce.envs.cart import Cart
from mjx_reinforce.types import Box, Discrete

_FORCE = 10.0


class CartPole(Cart):
    """Gymnasium's CartPole (gymnasium/envs/classic_control/cartpole.py).

    Observation, O = 4: cart position (m), cart velocity (m/s), pole angle (rad), pole angular
    velocity (rad/s). Action, an integer: 0 pushes the cart with -10 N, 1 with 10 N.

    Reward: 1 every step, the last included. Start: every entry uniform within 0.05. Terminates
    when the cart leaves 2.4 m or the pole 12 degrees. Steps of 0.02 s; v0 is solved at a return
    of 195 of at most 200, v1 at 475 of 500.
    """

    @dataclasses.dataclass(frozen=True, kw_only=True)
    class Settings(Cart.Settings):
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
        up, lost = (0.0, -1.0) if self.settings.sutton_barto_reward else (1.0, 1.0)
        return self.push(state, jnp.where(action == 1, _FORCE, -_FORCE), up, lost)


class ContinuousCartPole(Cart):
    """A cart pushed by any force (document 002, a classic cart with a Box of actions).

    Observation: as ``CartPole``. Action, A = 1: force on the cart in [-1, 1], times 10 (N), not
    clipped.

    Reward: 1 each step, 0 on the one that loses the pole. Start: every entry uniform within 0.05.
    Terminates when the cart leaves 2.4 m or the pole 20 degrees. At most 50 steps of 0.02 s, so
    that no return is above 50; the document names no threshold.
    """

    @dataclasses.dataclass(frozen=True, kw_only=True)
    class Settings(Cart.Settings):
        """Arguments of ContinuousCartPole."""

        max_episode_steps: int = 50
        reward_threshold: float | None = 50.0

    settings: Settings
    action_space = Box(np.array([-1.0]), np.array([1.0]))
    max_angle = 20 * math.pi / 180

    def step(self, state: State, action: jax.Array) -> State:
        """Returns the state one step later under ``action`` [1]."""
        return self.push(state, _FORCE * action[0], 1.0, 0.0)
