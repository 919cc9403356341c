"""HumanoidStandup: a person who lies on the floor and should get up."""

import jax.numpy as jnp

from mjx_reinforce.envs.humanoid import Person
from mjx_reinforce.envs.locomotion import Range


class HumanoidStandup(Person):
    """Gymnasium's HumanoidStandup (gymnasium/envs/mujoco/humanoidstandup_v5.py), solver apart.

    Gymnasium's model asks for MuJoCo's PGS solver, which MJX lacks. This one asks for Newton, which
    minimises the same function to a tighter tolerance: the two differ where PGS stops early.

    Observation, O = 348, and action, A = 17: as Humanoid.

    Reward: the torso's height (m) over the physics timestep of 0.003 s, not over the env step, plus
    1, less 0.1 times the sum of the squared actions and 5e-7 times that of the contact forces, the
    latter at most 10. Start: every position and velocity uniform within ``reset_noise_scale`` of
    lying at rest. Never terminates. No threshold; at most 1000 steps of 0.015 s.
    """

    def __init__(
        self,
        *,
        xml_file: str = "humanoid_standup.xml",
        frame_skip: int = 5,
        uph_cost_weight: float = 1.0,
        ctrl_cost_weight: float = 0.1,
        impact_cost_weight: float = 0.5e-6,
        impact_cost_range: Range = (-float("inf"), 10.0),
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
          uph_cost_weight: times the reward for height; Gymnasium takes it and ignores it.
          ctrl_cost_weight: what one unit of squared action costs.
          impact_cost_weight: what one unit of squared contact force costs.
          impact_cost_range: the cost of contacts is clipped to this.
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
            ctrl_cost_weight=ctrl_cost_weight,
            contact_cost_weight=impact_cost_weight,
            contact_cost_range=impact_cost_range,
            reset_noise_scale=reset_noise_scale,
            exclude_current_positions_from_observation=exclude_current_positions_from_observation,
            include_cinert_in_observation=include_cinert_in_observation,
            include_cvel_in_observation=include_cvel_in_observation,
            include_qfrc_actuator_in_observation=include_qfrc_actuator_in_observation,
            include_cfrc_ext_in_observation=include_cfrc_ext_in_observation,
            solver=solver,
        )
        self._uph_cost_weight = uph_cost_weight

    def outcome(self, before, data, action):
        """Returns the reward for height less the costs, and its terms; never terminates."""
        height = data.qpos[2]
        terms = {
            "reward_linup": self._uph_cost_weight * height / self.mj_model.opt.timestep,
            "reward_quadctrl": -self.control_cost(action),
            "reward_impact": -self.contact_cost(data),
        }
        where = {
            "x_position": data.qpos[0],
            "y_position": data.qpos[1],
            "z_distance_from_origin": height - self.mj_model.qpos0[2],
        }
        return sum(terms.values()) + 1, jnp.zeros((), bool), terms | where
