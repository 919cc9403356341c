"""What the locomotion tasks share: how they start, what moving earns, when they fall."""

import abc
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from mujoco import mjx

from mjx_reinforce.envs.base import MujocoEnv

Range = tuple[float, float]


class Body(MujocoEnv):
    """A body that starts near its model's pose and pays for its actions."""

    #: The first entries of qpos that say where in the world it is: x, or x and y.
    num_places = 2
    #: Whether the starting velocities are normal; else they are uniform.
    normal_velocity = False
    #: The observation clips velocities to this (m/s, rad/s).
    max_velocity = np.inf

    def __init__(
        self,
        *,
        ctrl_cost_weight: float,
        reset_noise_scale: float,
        exclude_current_positions_from_observation: bool,
        **settings: Any,
    ):
        """Builds what all of these tasks have.

        Args:
          ctrl_cost_weight: what one unit of squared action costs.
          reset_noise_scale: half the width of the uniform noise, the deviation of the normal one.
          exclude_current_positions_from_observation: whether to leave out where it is.
          **settings: of ``MujocoEnv``.

        Raises:
          ValueError: the noise is negative or ``frame_skip`` not positive.
        """
        if reset_noise_scale < 0:
            raise ValueError(f"reset_noise_scale must be 0 or more, got {reset_noise_scale}")
        if settings["frame_skip"] < 1:
            raise ValueError(f"frame_skip must be 1 or more, got {settings['frame_skip']}")
        super().__init__(max_episode_steps=1000, **settings)
        self._ctrl_cost_weight = ctrl_cost_weight
        self._noise = reset_noise_scale
        self._skipped = self.num_places if exclude_current_positions_from_observation else 0

    def initial(self, rng):
        """Draws qpos [nq] around the model's pose and qvel [nv] around rest."""
        qpos_key, qvel_key = jax.random.split(rng)
        model = self.mj_model
        qpos = jax.random.uniform(qpos_key, (model.nq,), minval=-self._noise, maxval=self._noise)
        if self.normal_velocity:
            qvel = self._noise * jax.random.normal(qvel_key, (model.nv,))
        else:
            qvel = jax.random.uniform(
                qvel_key, (model.nv,), minval=-self._noise, maxval=self._noise
            )
        return jnp.asarray(model.qpos0, qpos.dtype) + qpos, qvel

    def observe(self, data):
        """Returns qpos, without the place in the world unless asked for, and qvel."""
        velocity = jnp.clip(data.qvel, -self.max_velocity, self.max_velocity)
        return jnp.concatenate([data.qpos[self._skipped :], velocity])

    def control_cost(self, action: jax.Array) -> jax.Array:
        """Returns what the action costs [], as the policy gave it."""
        return self._ctrl_cost_weight * jnp.sum(jnp.square(action))


class Runner(Body):
    """A body that is paid for its speed along x."""

    def __init__(self, *, forward_reward_weight: float, **settings: Any):
        """Builds the task.

        Args:
          forward_reward_weight: what 1 m/s along x earns.
          **settings: of ``Body``.
        """
        super().__init__(**settings)
        self._forward_reward_weight = forward_reward_weight

    def place(self, data: mjx.Data) -> jax.Array:
        """Returns the point whose speed counts [1 or 2] (m)."""
        return data.qpos[: self.num_places]

    def terms(self, data: mjx.Data) -> dict[str, jax.Array]:
        """Returns the task's other rewards and, negative, costs; none by default."""
        return {}

    def terminated(self, data: mjx.Data) -> jax.Array:
        """Tells whether the episode ends []; never by default."""
        return jnp.zeros((), bool)

    def outcome(self, before, data, action):
        """Returns the sum of the terms, whether the episode ends, and the terms."""
        velocity = (self.place(data) - self.place(before)) / self.dt
        terms = {
            "reward_forward": self._forward_reward_weight * velocity[0],
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

    def __init__(
        self,
        *,
        healthy_reward: float,
        terminate_when_unhealthy: bool,
        healthy_z_range: Range,
        **settings: Any,
    ):
        """Builds the task.

        Args:
          healthy_reward: what a healthy step earns.
          terminate_when_unhealthy: whether an unhealthy step ends the episode.
          healthy_z_range: heights of the torso (m).
          **settings: of ``Runner``.

        Raises:
          ValueError: the range is empty.
        """
        check_range("healthy_z_range", healthy_z_range)
        super().__init__(**settings)
        self._healthy_reward = healthy_reward
        self._terminate_when_unhealthy = terminate_when_unhealthy
        self._healthy_z_range = healthy_z_range

    @abc.abstractmethod
    def is_healthy(self, data: mjx.Data) -> jax.Array:
        """Tells whether the body is as it should be []."""

    def terms(self, data):
        """Returns the reward for health."""
        return {"reward_survive": self._healthy_reward * self.is_healthy(data)}

    def terminated(self, data):
        """Tells whether the body is unhealthy, where that ends the episode."""
        return ~self.is_healthy(data) & self._terminate_when_unhealthy


class PlanarWalker(Healthy):
    """A body in the x, z plane that must stay up and upright."""

    num_places = 1
    max_velocity = 10.0

    def __init__(self, *, healthy_angle_range: Range, **settings: Any):
        """Builds the task.

        Args:
          healthy_angle_range: angles of the torso (rad).
          **settings: of ``Healthy``.

        Raises:
          ValueError: a range is empty.
        """
        check_range("healthy_angle_range", healthy_angle_range)
        super().__init__(**settings)
        self._healthy_angle_range = healthy_angle_range

    def is_healthy(self, data):
        """Tells whether height and angle are within their ranges."""
        z, angle = data.qpos[1], data.qpos[2]
        return within(z, self._healthy_z_range) & within(angle, self._healthy_angle_range)

    def outcome(self, before, data, action):
        """Adds how far above its starting pose the torso is (m)."""
        reward, terminated, terms = super().outcome(before, data, action)
        height = data.qpos[1] - self.mj_model.qpos0[1]
        return reward, terminated, terms | {"z_distance_from_origin": height}


def within(x: jax.Array, bounds: Range) -> jax.Array:
    """Tells whether x lies strictly between two bounds; NaN does not."""
    low, high = bounds
    return (low < x) & (x < high)


def check_range(name: str, bounds: Range) -> None:
    """Refuses a range that contains nothing."""
    low, high = bounds
    if not low < high:
        raise ValueError(f"{name} must be (low, high) with low < high, got {bounds}")
