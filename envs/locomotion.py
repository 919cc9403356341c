"""What the locomotion tasks share: what moving and health earn, and what actions cost."""

import abc
import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from mjx_reinforce.engine.physics.mjx_internals import Simulation
from mjx_reinforce.envs.near_pose import NearPose
from mjx_reinforce.envs.settings import Interval


class Body(NearPose):
    """A body that starts near its model's pose and pays for its actions."""

    @dataclasses.dataclass(frozen=True, kw_only=True)
    class Settings(NearPose.Settings):
        """Arguments of every locomotion task."""

        reward_threshold: float | None = None
        ctrl_cost_weight: float
        """What one unit of squared action costs."""
        exclude_current_positions_from_observation: bool = True
        """Whether to leave x, and y where the body can move along it, out of the observation."""

    settings: Settings
    #: How many entries of qpos say where in the world the body is: x, or x and y. They come first.
    num_places = 2
    #: The observation clips velocities to this (m/s, rad/s).
    max_velocity = np.inf

    def observe(self, data):
        """Returns qpos, without the place in the world if that is excluded, and qvel."""
        velocity = jnp.clip(data.qvel, -self.max_velocity, self.max_velocity)
        position = data.qpos
        # The task is the same wherever the body is, so a policy need not see its place.
        if self.settings.exclude_current_positions_from_observation:
            position = position[self.num_places :]
        return jnp.concatenate([position, velocity])

    def control_cost(self, action: jax.Array) -> jax.Array:
        """Returns what the action costs [], as the policy gave it: before actuators clamp it."""
        return self.settings.ctrl_cost_weight * jnp.sum(jnp.square(action))


class Runner(Body):
    """A body that is paid for its speed along x."""

    @dataclasses.dataclass(frozen=True, kw_only=True)
    class Settings(Body.Settings):
        """Arguments of every task that pays for speed."""

        forward_reward_weight: float = 1.0
        """What 1 m/s along x earns."""

    settings: Settings

    def place(self, data: Simulation) -> jax.Array:
        """Returns the point whose speed counts [1 or 2] (m)."""
        return data.qpos[: self.num_places]

    def terms(self, data: Simulation) -> dict[str, jax.Array]:
        """Returns the task's other rewards and, negative, costs; none by default."""
        return {}

    def terminated(self, data: Simulation) -> jax.Array:
        """Returns whether the episode ends []; never by default."""
        return jnp.zeros((), bool)

    def outcome(self, before, data, action):
        """Returns the sum of the terms, whether the episode ends, and the terms."""
        # The mean over the env step (m/s), not the velocity at its end.
        velocity = (self.place(data) - self.place(before)) / self.dt
        terms = {
            "reward_forward": self.settings.forward_reward_weight * velocity[0],
            "reward_ctrl": -self.control_cost(action),
            **self.terms(data),
        }
        # Gymnasium's ``info``, which earns nothing.
        info = {"x_position": data.qpos[0], "x_velocity": velocity[0]}
        if self.num_places == 2:
            info |= {"y_position": data.qpos[1], "y_velocity": velocity[1]}
            info["distance_from_origin"] = jnp.linalg.norm(data.qpos[:2])
        return jnp.sum(jnp.stack(list(terms.values()))), self.terminated(data), terms | info


class Healthy(Runner):
    """A runner that is paid for being healthy and that may end when it is not."""

    @dataclasses.dataclass(frozen=True, kw_only=True)
    class Settings(Runner.Settings):
        """Arguments of every task whose body must not fall."""

        healthy_reward: float = 1.0
        """What a healthy step earns."""
        terminate_when_unhealthy: bool = True
        """Whether an unhealthy step ends the episode."""
        healthy_z_range: Interval
        """Heights of a healthy torso (m), bounds excluded."""

    settings: Settings

    @abc.abstractmethod
    def is_healthy(self, data: Simulation) -> jax.Array:
        """Returns whether the body has not fallen []: whether its state is within the ranges."""

    def terms(self, data):
        """Returns the reward for health."""
        return {"reward_survive": self.settings.healthy_reward * self.is_healthy(data)}

    def terminated(self, data):
        """Returns whether the body is unhealthy, if that ends the episode."""
        return ~self.is_healthy(data) & self.settings.terminate_when_unhealthy


def within(x: jax.Array, bounds: Interval) -> jax.Array:
    """Returns whether x lies strictly between two bounds; NaN does not."""
    low, high = bounds
    return (low < x) & (x < high)
