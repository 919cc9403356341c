"""Hopper: a torso on one leg that hops forward without falling."""

import dataclasses

import jax.numpy as jnp

from mjx_reinforce.envs.locomotion import PlanarWalker, within
from mjx_reinforce.envs.settings import Interval, check_range


class Hopper(PlanarWalker):
    """Gymnasium's Hopper (gymnasium/envs/mujoco/hopper_v5.py).

    Observation, O = 11: height of the torso (m), angles of the torso, thigh, leg and foot joints
    (rad); velocity of the torso along x and z (m/s) and the angular velocities (rad/s), clipped
    to [-10, 10]. With ``exclude_current_positions_from_observation=False`` x (m) comes first,
    O = 12. Action, A = 3: torques on thigh, leg and foot in [-1, 1], times a gear of 200 (N m).

    Reward: the speed along x over the step (m/s), plus 1 if healthy, less 1e-3 times the sum of
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

        def __post_init__(self):
            """Raises ValueError for a value that is out of its range."""
            super().__post_init__()
            check_range("healthy_state_range", self.healthy_state_range)

    settings: Settings

    def is_healthy(self, data):
        """Returns whether the height, the angle and all else but x are within their ranges."""
        state = jnp.concatenate([data.qpos[2:], data.qvel])
        return super().is_healthy(data) & jnp.all(within(state, self.settings.healthy_state_range))
