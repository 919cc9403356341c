"""Humanoid: a person who walks along x without falling."""

from typing import Any

import jax
import jax.numpy as jnp
from mujoco import mjx

from mjx_reinforce.envs.locomotion import Body, Healthy, Range, check_range, within


class Person(Body):
    """What Humanoid and HumanoidStandup share: the observation and the cost of contacts."""

    contact_forces = True

    def __init__(
        self,
        *,
        contact_cost_weight: float,
        contact_cost_range: Range,
        include_cinert_in_observation: bool,
        include_cvel_in_observation: bool,
        include_qfrc_actuator_in_observation: bool,
        include_cfrc_ext_in_observation: bool,
        **settings: Any,
    ):
        """Builds what the two have; the arguments are explained there."""
        check_range("contact_cost_range", contact_cost_range)
        super().__init__(**settings)
        self._contact_cost_weight = contact_cost_weight
        self._contact_cost_range = contact_cost_range
        self._include_cinert = include_cinert_in_observation
        self._include_cvel = include_cvel_in_observation
        self._include_qfrc_actuator = include_qfrc_actuator_in_observation
        self._include_cfrc_ext = include_cfrc_ext_in_observation

    def contact_cost(self, data: mjx.Data) -> jax.Array:
        """Returns what the contacts cost []."""
        forces: Any = data._impl
        cost = self._contact_cost_weight * jnp.sum(jnp.square(forces.cfrc_ext))
        return jnp.clip(cost, *self._contact_cost_range)

    def observe(self, data):
        """Returns positions, velocities and, unless left out, inertias, motions and forces."""
        parts = [
            (True, super().observe(data)),
            (self._include_cinert, data._impl.cinert[1:]),
            (self._include_cvel, data.cvel[1:]),
            (self._include_qfrc_actuator, data.qfrc_actuator[6:]),
            (self._include_cfrc_ext, data._impl.cfrc_ext[1:]),
        ]
        return jnp.concatenate([part.ravel() for included, part in parts if included])


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

    carried = ("xipos",)

    def __init__(
        self,
        *,
        xml_file: str = "humanoid.xml",
        frame_skip: int = 5,
        forward_reward_weight: float = 1.25,
        ctrl_cost_weight: float = 0.1,
        contact_cost_weight: float = 5e-7,
        contact_cost_range: Range = (-float("inf"), 10.0),
        healthy_reward: float = 5.0,
        terminate_when_unhealthy: bool = True,
        healthy_z_range: Range = (1.0, 2.0),
        reset_noise_scale: float = 1e-2,
        exclude_current_positions_from_observation: bool = True,
        include_cinert_in_observation: bool = True,
        include_cvel_in_observation: bool = True,
        include_qfrc_actuator_in_observation: bool = True,
        include_cfrc_ext_in_observation: bool = True,
        solver: str = "exact",
    ):
        """Builds the task.

        Args:
          xml_file: the model, with a solver that MJX has.
          frame_skip: physics steps of 0.003 s an env step.
          forward_reward_weight: what 1 m/s along x earns.
          ctrl_cost_weight: what one unit of squared action costs.
          contact_cost_weight: what one unit of squared contact force costs.
          contact_cost_range: the cost of contacts is clipped to this.
          healthy_reward: what a healthy step earns.
          terminate_when_unhealthy: whether an unhealthy step ends the episode.
          healthy_z_range: heights of the torso (m), bounds excluded.
          reset_noise_scale: half the width of the start distribution (m, rad, m/s, rad/s).
          exclude_current_positions_from_observation: whether to leave out x and y.
          include_cinert_in_observation: whether to observe inertias and masses.
          include_cvel_in_observation: whether to observe the bodies' velocities.
          include_qfrc_actuator_in_observation: whether to observe the motors' torques.
          include_cfrc_ext_in_observation: whether to observe the contact forces.
          solver: "exact", "mjx" or "fast", see ``MujocoEnv``.

        Raises:
          ValueError: an argument is out of its range.
        """
        super().__init__(
            xml_file=xml_file,
            frame_skip=frame_skip,
            reward_threshold=None,
            forward_reward_weight=forward_reward_weight,
            ctrl_cost_weight=ctrl_cost_weight,
            contact_cost_weight=contact_cost_weight,
            contact_cost_range=contact_cost_range,
            healthy_reward=healthy_reward,
            terminate_when_unhealthy=terminate_when_unhealthy,
            healthy_z_range=healthy_z_range,
            reset_noise_scale=reset_noise_scale,
            exclude_current_positions_from_observation=exclude_current_positions_from_observation,
            include_cinert_in_observation=include_cinert_in_observation,
            include_cvel_in_observation=include_cvel_in_observation,
            include_qfrc_actuator_in_observation=include_qfrc_actuator_in_observation,
            include_cfrc_ext_in_observation=include_cfrc_ext_in_observation,
            solver=solver,
        )

    def place(self, data):
        """Returns x and y of the mass centre [2] (m), as old as Gymnasium's."""
        mass = self.mj_model.body_mass
        return jnp.asarray(mass / mass.sum(), data.xipos.dtype) @ data.xipos[:, :2]

    def is_healthy(self, data):
        """Tells whether the torso's height is in its range."""
        return within(data.qpos[2], self._healthy_z_range)

    def terms(self, data):
        """Returns the reward for health and the cost of contacts."""
        return super().terms(data) | {"reward_contact": -self.contact_cost(data)}
