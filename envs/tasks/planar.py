"""Bodies that move in a plane: HalfCheetah, Swimmer, Hopper and Walker2d."""

import dataclasses

import jax.numpy as jnp

from mjx_reinforce.envs.locomotion import Healthy, Runner, within
from mjx_reinforce.envs.settings import Interval


class HalfCheetah(Runner):
    """Gymnasium's HalfCheetah (gymnasium/envs/mujoco/half_cheetah_v5.py).

    Observation, O = 17: height of the torso's center over its pose (m), pitch of the torso, angles
    of the back thigh, shin and foot and of the front thigh, shin and foot (rad); velocity along x
    and z (m/s), angular velocities in the same order (rad/s). With
    ``exclude_current_positions_from_observation=False`` x (m) comes first, O = 18. Action, A = 6:
    torques in [-1, 1] on the back thigh, shin and foot and the front ones, times gears of 120, 90,
    60, 120, 60 and 30 (N m).

    Reward: the speed along x over the step (m/s) minus 0.1 times the sum of the squared actions.
    Start: positions uniform within ``reset_noise_scale`` of the pose, velocities normal with that
    deviation. Never terminates. Solved at a return of 4800; at most 1000 steps of 0.05 s.
    """

    num_places = 1
    normal_velocity = True

    @dataclasses.dataclass(frozen=True, kw_only=True)
    class Settings(Runner.Settings):
        """Arguments of HalfCheetah."""

        xml_file: str = "half_cheetah.xml"
        frame_skip: int = 5
        reward_threshold: float | None = 4800.0
        ctrl_cost_weight: float = 0.1
        reset_noise_scale: float = 0.1


class Swimmer(Runner):
    """Gymnasium's Swimmer (gymnasium/envs/mujoco/swimmer_v5.py).

    Observation, O = 8: angle of the front rod, angles of the two joints (rad); velocity of the
    tip along x and y (m/s), angular velocities of the rod and the joints (rad/s). With
    ``exclude_current_positions_from_observation=False`` the tip's x and y (m) come first, O = 10.
    Action, A = 2: torques on the joints in [-1, 1], times a gear of 150 (N m).

    Reward: the tip's speed along x over the step (m/s) minus 1e-4 times the sum of the squared
    actions. Start: every position and velocity uniform within ``reset_noise_scale`` of the
    straight rods at rest. Never terminates. Solved at a return of 360; at most 1000 steps of
    0.04 s.
    """

    @dataclasses.dataclass(frozen=True, kw_only=True)
    class Settings(Runner.Settings):
        """Arguments of Swimmer."""

        xml_file: str = "swimmer.xml"
        frame_skip: int = 4
        reward_threshold: float | None = 360.0
        ctrl_cost_weight: float = 1e-4
        reset_noise_scale: float = 0.1


class PlanarWalker(Healthy):
    """A body in the x, z plane that must stay up and upright."""

    @dataclasses.dataclass(frozen=True, kw_only=True)
    class Settings(Healthy.Settings):
        """Arguments of the planar walkers."""

        healthy_angle_range: Interval
        """Angles of a healthy torso (rad), bounds excluded."""

    settings: Settings
    num_places = 1
    max_velocity = 10.0

    def is_healthy(self, data):
        """Returns whether height and angle are within their ranges."""
        # qpos is x, z and the pitch of the torso, then the joints.
        z = data.qpos[1]
        angle = data.qpos[2]
        ranges = self.settings
        return within(z, ranges.healthy_z_range) & within(angle, ranges.healthy_angle_range)

    def outcome(self, before, data, action):
        """Adds how far above its starting pose the torso is (m)."""
        reward, terminated, terms = super().outcome(before, data, action)
        # Gymnasium's ``info``, which earns nothing.
        height = data.qpos[1] - self.mj_model.qpos0[1]
        return reward, terminated, terms | {"z_distance_from_origin": height}


class Hopper(PlanarWalker):
    """Gymnasium's Hopper (gymnasium/envs/mujoco/hopper_v5.py).

    Observation, O = 11: height of the torso (m), angles of the torso, thigh, leg and foot joints
    (rad); velocity of the torso along x and z (m/s) and the angular velocities (rad/s), clipped
    to [-10, 10]. With ``exclude_current_positions_from_observation=False`` x (m) comes first,
    O = 12. Action, A = 3: torques on thigh, leg and foot in [-1, 1], times a gear of 200 (N m).

    Reward: the speed along x over the step (m/s), plus 1 if healthy, minus 1e-3 times the sum of
    the squared actions. Start: every position and velocity uniform within ``reset_noise_scale``
    of standing at rest. Terminates when not healthy: height at most 0.7 m, torso 0.2 rad or more
    off upright, or an angle or a velocity outside (-100, 100). Solved at a return of 3800; at
    most 1000 steps of 0.008 s.
    """

    @dataclasses.dataclass(frozen=True, kw_only=True)
    class Settings(PlanarWalker.Settings):
        """Arguments of Hopper."""

        xml_file: str = "hopper.xml"
        frame_skip: int = 4
        reward_threshold: float | None = 3800.0
        ctrl_cost_weight: float = 1e-3
        healthy_state_range: Interval = (-100.0, 100.0)
        """Angles (rad) and velocities (m/s, rad/s) of a healthy state, bounds excluded."""
        healthy_z_range: Interval = (0.7, float("inf"))
        healthy_angle_range: Interval = (-0.2, 0.2)
        reset_noise_scale: float = 5e-3

    settings: Settings

    def is_healthy(self, data):
        """Returns whether the height, the angle and all else but x are within their ranges."""
        # Without x and z, which have no such bound, or one of their own.
        state = jnp.concatenate([data.qpos[2:], data.qvel])
        return super().is_healthy(data) & jnp.all(within(state, self.settings.healthy_state_range))


class Walker2d(PlanarWalker):
    """Gymnasium's Walker2d (gymnasium/envs/mujoco/walker2d_v5.py).

    Observation, O = 17: height of the torso (m), angles of the torso, the right thigh, leg and
    foot and the left ones (rad); velocity of the torso along x and z (m/s) and the angular
    velocities (rad/s), clipped to [-10, 10]. With
    ``exclude_current_positions_from_observation=False`` x (m) comes first, O = 18. Action, A = 6:
    torques in [-1, 1] on the right thigh, leg and foot and the left ones, times a gear of 100
    (N m).

    Reward: the speed along x over the step (m/s), plus 1 if healthy, minus 1e-3 times the sum of
    the squared actions. Start: every position and velocity uniform within ``reset_noise_scale``
    of standing at rest. Terminates when not healthy: height outside (0.8, 2) m or torso angle
    outside (-1, 1) rad. No threshold; at most 1000 steps of 0.008 s.
    """

    @dataclasses.dataclass(frozen=True, kw_only=True)
    class Settings(PlanarWalker.Settings):
        """Arguments of Walker2d."""

        xml_file: str = "walker2d.xml"
        frame_skip: int = 4
        reward_threshold: float | None = None
        ctrl_cost_weight: float = 1e-3
        healthy_z_range: Interval = (0.8, 2.0)
        healthy_angle_range: Interval = (-1.0, 1.0)
        reset_noise_scale: float = 5e-3
