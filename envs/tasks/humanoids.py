"""Two tasks of a person: Humanoid walks along x, HumanoidStandup gets up from the floor."""

import dataclasses

import jax
import jax.numpy as jnp

from mjx_reinforce.engine.physics.mjx_internals import Simulation
from mjx_reinforce.envs.locomotion import Body, Healthy, within
from mjx_reinforce.envs.settings import Interval


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
        settings = self.settings
        # Without the world, body 0, and without the root, whose six freedoms no motor drives.
        parts = [
            (True, super().observe(data)),
            (settings.include_cinert_in_observation, data.cinert[1:]),
            (settings.include_cvel_in_observation, data.cvel[1:]),
            (settings.include_qfrc_actuator_in_observation, data.qfrc_actuator[6:]),
            (settings.include_cfrc_ext_in_observation, data.cfrc_ext[1:]),
        ]
        return jnp.concatenate([part.ravel() for is_included, part in parts if is_included])


class Humanoid(Person, Healthy):
    """Gymnasium's Humanoid (gymnasium/envs/mujoco/humanoid_v5.py), solver apart.

    Gymnasium's model asks for MuJoCo's PGS solver, which MJX lacks. This one asks for Newton, which
    minimizes the same function to a tighter tolerance: the two differ where PGS stops early.

    Observation, O = 348: height of the torso (m), its orientation (quaternion), 17 joint angles
    (rad), 22 in all; their 23 velocities (m/s, rad/s); for each of 13 bodies inertia about the
    center of mass, mass offset and mass, 10 each (kg m^2, kg m, kg); angular and linear velocity, 6
    each (rad/s, m/s); 17 motor torques (N m); torque and force of contacts on each body, 6 each
    (N m, N). With ``exclude_current_positions_from_observation=False`` x and y (m) come first.
    Action, A = 17: torques in [-0.4, 0.4] on abdomen y, z, x, right hip x, z, y and knee, left hip
    x, z, y and knee, right shoulder 1, 2 and elbow, left shoulder 1, 2 and elbow, times gears of
    100, hip y 300, knee 200, arms 25 (N m).

    Reward: 1.25 times the speed of the mass center along x over the step (m/s), plus 5 if healthy,
    minus 0.1 times the sum of the squared actions and 5e-7 times that of the contact forces, the
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

    settings: Settings
    carried = ("xipos",)

    def place(self, data):
        """Returns x and y of the mass center [2] (m) at the last forward pass."""
        # [nbody]; the world, body 0, has no mass, and so no weight in the mean.
        mass = self.mj_model.body_mass
        return jnp.asarray(mass / mass.sum(), data.xipos.dtype) @ data.xipos[:, :2]

    def is_healthy(self, data):
        """Returns whether the torso's height is in its range."""
        return within(data.qpos[2], self.settings.healthy_z_range)

    def terms(self, data):
        """Returns the reward for health and the cost of contacts."""
        settings = self.settings
        terms = super().terms(data)
        cost = self.contact_cost(data, settings.contact_cost_weight, settings.contact_cost_range)
        return terms | {"reward_contact": -cost}


class HumanoidStandup(Person):
    """Gymnasium's HumanoidStandup (gymnasium/envs/mujoco/humanoidstandup_v5.py), solver apart.

    Gymnasium's model asks for MuJoCo's PGS solver, which MJX lacks. This one asks for Newton, which
    minimizes the same function to a tighter tolerance: the two differ where PGS stops early.

    Observation, O = 348, and action, A = 17: as Humanoid.

    Reward: the torso's height (m) over the physics timestep of 0.003 s, not over the env step, plus
    1, minus 0.1 times the sum of the squared actions and 5e-7 times that of the contact forces, the
    latter at most 10. Start: every position and velocity uniform within ``reset_noise_scale`` of
    lying at rest. Never terminates. No threshold; at most 1000 steps of 0.015 s.
    """

    @dataclasses.dataclass(frozen=True, kw_only=True)
    class Settings(Person.Settings):
        """Arguments of HumanoidStandup."""

        xml_file: str = "humanoid_standup.xml"
        uph_cost_weight: float = 1.0
        """Times the reward for height; Gymnasium takes this argument and ignores it."""
        impact_cost_weight: float = 0.5e-6
        """What one unit of squared contact force costs."""
        impact_cost_range: Interval = (-float("inf"), 10.0)
        """The cost of contacts is clipped to this."""

    settings: Settings

    def outcome(self, before, data, action):
        """Returns the reward for height less the costs, and its terms; never terminates."""
        height = data.qpos[2]
        weights = self.settings
        # Gymnasium divides by the physics timestep, so a height of 1 m earns 333 a step.
        terms = {
            "reward_linup": weights.uph_cost_weight * height / self.mj_model.opt.timestep,
            "reward_quadctrl": -self.control_cost(action),
            "reward_impact": -self.contact_cost(
                data, weights.impact_cost_weight, weights.impact_cost_range
            ),
        }
        info = {
            "x_position": data.qpos[0],
            "y_position": data.qpos[1],
            "z_distance_from_origin": height - self.mj_model.qpos0[2],
        }
        return sum(terms.values()) + 1, jnp.zeros((), bool), terms | info
