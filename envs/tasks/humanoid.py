"""Humanoid: a person who walks along x without falling."""

import dataclasses

import jax.numpy as jnp

from mjx_reinforce.envs.locomotion import Healthy, Person, within
from mjx_reinforce.envs.settings import Interval, check_range


class Humanoid(Person, Healthy):
    """Gymnasium's Humanoid (gymnasium/envs/mujoco/humanoid_v5.py), solver apart.

    Gymnasium's model asks for MuJoCo's PGS solver, which MJX lacks. This one asks for Newton, which
    minimises the same function to a tighter tolerance: the two differ where PGS stops early.

    Observation, O = 348: height of the torso (m), its orientation (quaternion), 17 joint angles
    (rad), 22 in all; their 23 velocities (m/s, rad/s); for each of 13 bodies inertia about the
    centre of mass, mass offset and mass, 10 each (kg m^2, kg m, kg); angular and linear velocity, 6
    each (rad/s, m/s); 17 motor torques (N m); torque and force of contacts on each body, 6 each
    (N m, N). With ``exclude_current_positions_from_observation=False`` x and y (m) come first.
    Action, A = 17: torques in [-0.4, 0.4] on abdomen y, z, x, right hip x, z, y and knee, left hip
    x, z, y and knee, right shoulder 1, 2 and elbow, left shoulder 1, 2 and elbow, times gears of
    100, hip y 300, knee 200, arms 25 (N m).

    Reward: 1.25 times the speed of the mass centre along x over the step (m/s), plus 5 if healthy,
    less 0.1 times the sum of the squared actions and 5e-7 times that of the contact forces, the
    latter at most 10. Start: every position and velocity uniform within ``reset_noise_scale`` of
    standing at rest. Terminates when the torso's height leaves (1, 2) m. No threshold; at most 1000
    steps of 0.015 s.
    """

    @dataclasses.dataclass(frozen=True, kw_only=True)
    class Settings(Person.Settings, Healthy.Settings):
        """Arguments of Humanoid."""

        xml_file: str = "humanoid.xml"
        forward_reward_weight: float = 1.25
        contact_cost_weight: float = 5e-7
        """What one unit of squared contact force costs."""
        contact_cost_range: Interval = (-float("inf"), 10.0)
        """The cost of contacts is clipped to this."""
        healthy_reward: float = 5.0
        healthy_z_range: Interval = (1.0, 2.0)

        def __post_init__(self):
            """Raises ValueError for a value that is out of its range."""
            super().__post_init__()
            check_range("contact_cost_range", self.contact_cost_range)

    settings: Settings
    carried = ("xipos",)

    def place(self, data):
        """Returns x and y of the mass centre [2] (m) at the last forward pass."""
        mass = self.mj_model.body_mass
        return jnp.asarray(mass / mass.sum(), data.xipos.dtype) @ data.xipos[:, :2]

    def is_healthy(self, data):
        """Returns whether the torso's height is in its range."""
        return within(data.qpos[2], self.settings.healthy_z_range)

    def terms(self, data):
        """Returns the reward for health and the cost of contacts."""
        weight, bounds = self.settings.contact_cost_weight, self.settings.contact_cost_range
        return super().terms(data) | {"reward_contact": -self.contact_cost(data, weight, bounds)}
