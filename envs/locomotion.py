"""What the locomotion tasks share: how they start, what moving earns, what actions cost.

Walkers are paid for health, and persons pay for contacts, too.
"""

import abc
import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from mjx_reinforce.envs.base import MujocoEnv
from mjx_reinforce.envs.settings import Interval, check_range
from mjx_reinforce.physics.mjx_internals import Simulation


class Body(MujocoEnv):
    """A body that starts near its model's pose and pays for its actions."""

    @dataclasses.dataclass(frozen=True, kw_only=True)
    class Settings(MujocoEnv.Settings):
        """Arguments of every locomotion task."""

        max_episode_steps: int = 1000
        reward_threshold: float | None = None
        ctrl_cost_weight: float
        """What one unit of squared action costs."""
        reset_noise_scale: float
        """Half the width of the start distribution where it is uniform, its standard deviation
        where it is normal (m, rad, m/s, rad/s)."""
        exclude_current_positions_from_observation: bool = True
        """Whether to leave x, and y where the body can move along it, out of the observation."""

        def __post_init__(self):
            """Raises ValueError for a value that is out of its range."""
            super().__post_init__()
            if self.reset_noise_scale < 0:
                raise ValueError(
                    f"reset_noise_scale must be 0 or more, got {self.reset_noise_scale}"
                )

    settings: Settings
    #: How many entries of qpos say where in the world the body is: x, or x and y. They come first.
    num_places = 2
    #: Whether the starting velocities are normal; otherwise they are uniform.
    normal_velocity = False
    #: The observation clips velocities to this (m/s, rad/s).
    max_velocity = np.inf

    def initial(self, rng):
        """Draws qpos [nq] around the model's pose and qvel [nv] around rest."""
        qpos_key, qvel_key = jax.random.split(rng)
        model, noise = self.mj_model, self.settings.reset_noise_scale
        qpos = jax.random.uniform(qpos_key, (model.nq,), minval=-noise, maxval=noise)
        if self.normal_velocity:
            qvel = noise * jax.random.normal(qvel_key, (model.nv,))
        else:
            qvel = jax.random.uniform(qvel_key, (model.nv,), minval=-noise, maxval=noise)
        return jnp.asarray(model.qpos0, qpos.dtype) + qpos, qvel

    def observe(self, data):
        """Returns qpos, without the place in the world if that is excluded, and qvel."""
        excluded = self.settings.exclude_current_positions_from_observation
        velocity = jnp.clip(data.qvel, -self.max_velocity, self.max_velocity)
        return jnp.concatenate([data.qpos[self.num_places if excluded else 0 :], velocity])

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
        velocity = (self.place(data) - self.place(before)) / self.dt
        terms = {
            "reward_forward": self.settings.forward_reward_weight * velocity[0],
            "reward_ctrl": -self.control_cost(action),
            **self.terms(data),
        }
        where = {"x_position": data.qpos[0], "x_velocity": velocity[0]}
        if self.num_places == 2:
            where |= {"y_position": data.qpos[1], "y_velocity": velocity[1]}
            where["distance_from_origin"] = jnp.linalg.norm(data.qpos[:2])
        return jnp.sum(jnp.stack(list(terms.values()))), self.terminated(data), terms | where


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

        def __post_init__(self):
            """Raises ValueError for a value that is out of its range."""
            super().__post_init__()
            check_range("healthy_z_range", self.healthy_z_range)

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


class PlanarWalker(Healthy):
    """A body in the x, z plane that must stay up and upright."""

    @dataclasses.dataclass(frozen=True, kw_only=True)
    class Settings(Healthy.Settings):
        """Arguments of the planar walkers."""

        healthy_angle_range: Interval
        """Angles of a healthy torso (rad), bounds excluded."""

        def __post_init__(self):
            """Raises ValueError for a value that is out of its range."""
            super().__post_init__()
            check_range("healthy_angle_range", self.healthy_angle_range)

    settings: Settings
    num_places = 1
    max_velocity = 10.0

    def is_healthy(self, data):
        """Returns whether height and angle are within their ranges."""
        z, angle = data.qpos[1], data.qpos[2]
        ranges = self.settings
        return within(z, ranges.healthy_z_range) & within(angle, ranges.healthy_angle_range)

    def outcome(self, before, data, action):
        """Adds how far above its starting pose the torso is (m)."""
        reward, terminated, terms = super().outcome(before, data, action)
        height = data.qpos[1] - self.mj_model.qpos0[1]
        return reward, terminated, terms | {"z_distance_from_origin": height}


def within(x: jax.Array, bounds: Interval) -> jax.Array:
    """Returns whether x lies strictly between two bounds; NaN does not."""
    low, high = bounds
    return (low < x) & (x < high)


class Person(Body):
    """A person with the model of Gymnasium's humanoids."""

    @dataclasses.dataclass(frozen=True, kw_only=True)
    class Settings(Body.Settings):
        """Arguments of both tasks."""

        frame_skip: int = 5
        ctrl_cost_weight: float = 0.1
        reset_noise_scale: float = 1e-2
        include_cinert_in_observation: bool = True
        """Whether to observe inertias and masses."""
        include_cvel_in_observation: bool = True
        """Whether to observe the bodies' velocities."""
        include_qfrc_actuator_in_observation: bool = True
        """Whether to observe the motors' torques."""
        include_cfrc_ext_in_observation: bool = True
        """Whether to observe the contact forces."""

    settings: Settings
    contact_forces = True

    def contact_cost(self, data: Simulation, weight: float, bounds: Interval) -> jax.Array:
        """Returns what the contacts cost [].

        Args:
          data: the simulation after the env step.
          weight: what one unit of squared contact force costs.
          bounds: the least and the greatest cost.
        """
        return jnp.clip(weight * jnp.sum(jnp.square(data.cfrc_ext)), *bounds)

    def observe(self, data):
        """Returns positions, velocities and, unless left out, inertias, motions and forces."""
        chosen = self.settings
        parts = [
            (True, super().observe(data)),
            (chosen.include_cinert_in_observation, data.cinert[1:]),
            (chosen.include_cvel_in_observation, data.cvel[1:]),
            (chosen.include_qfrc_actuator_in_observation, data.qfrc_actuator[6:]),
            (chosen.include_cfrc_ext_in_observation, data.cfrc_ext[1:]),
        ]
        return jnp.concatenate([part.ravel() for included, part in parts if included])
