"""What the tasks share whose body must not fall."""

import abc
import dataclasses

import jax

from mjx_reinforce.envs.locomotion import Runner
from mjx_reinforce.envs.settings import Interval, check_range
from mjx_reinforce.physics.mjx_internals import Simulation


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
