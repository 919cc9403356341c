"""Ant: a torso on four legs that walks along x without falling or jumping."""

import jax.numpy as jnp

from mjx_reinforce.envs.locomotion import Healthy, Range, check_range


class Ant(Healthy):
    """Gymnasium's Ant (gymnasium/envs/mujoco/ant_v5.py).

    Observation, O = 105: height of the torso (m) and its orientation (quaternion), hip and ankle
    angles of the four legs (rad); velocity (m/s) and angular velocity (rad/s) of the torso, angular
    velocities of the joints (rad/s); for each of 13 bodies the torque (N m) and force (N) of its
    contacts, clipped to ``contact_force_range``. With
    ``exclude_current_positions_from_observation=False`` x and y (m) come first. Action, A = 8:
    torques in [-1, 1] on hip and ankle of the legs 4, 1, 2, 3, times a gear of 150 (N m).

    Reward: the speed of ``main_body`` along x over the step (m/s), plus 1 if healthy, less 0.5
    times the sum of the squared actions and 5e-4 times that of the clipped contact forces. Start:
    positions uniform within ``reset_noise_scale`` of the pose, velocities normal with that
    deviation. Terminates when not healthy: height outside [0.2, 1] m, or not finite. Solved at a
    return of 6000; at most 1000 steps of 0.05 s.
    """

    normal_velocity = True
    carried = ("xpos",)
    contact_forces = True

    def __init__(
        self,
        *,
        xml_file: str = "ant.xml",
        frame_skip: int = 5,
        forward_reward_weight: float = 1.0,
        ctrl_cost_weight: float = 0.5,
        contact_cost_weight: float = 5e-4,
        healthy_reward: float = 1.0,
        main_body: int | str = 1,
        terminate_when_unhealthy: bool = True,
        healthy_z_range: Range = (0.2, 1.0),
        contact_force_range: Range = (-1.0, 1.0),
        reset_noise_scale: float = 0.1,
        exclude_current_positions_from_observation: bool = True,
        include_cfrc_ext_in_observation: bool = True,
        solver: str = "exact",
    ):
        """Builds the task.

        Args:
          xml_file: the model.
          frame_skip: physics steps of 0.01 s an env step.
          forward_reward_weight: what 1 m/s along x earns.
          ctrl_cost_weight: what one unit of squared action costs.
          contact_cost_weight: what one unit of squared, clipped contact force costs.
          healthy_reward: what a healthy step earns.
          main_body: the body whose speed counts, by name or number.
          terminate_when_unhealthy: whether an unhealthy step ends the episode.
          healthy_z_range: heights of the torso (m), bounds included.
          contact_force_range: contact torques (N m) and forces (N) are clipped to this.
          reset_noise_scale: half the width for positions (m, rad), the deviation for velocities
            (m/s, rad/s).
          exclude_current_positions_from_observation: whether to leave out x and y.
          include_cfrc_ext_in_observation: whether to observe the contact forces.
          solver: "exact", "mjx" or "fast", see ``MujocoEnv``.

        Raises:
          ValueError: an argument is out of its range, or the model has no such body.
        """
        check_range("contact_force_range", contact_force_range)
        super().__init__(
            xml_file=xml_file,
            frame_skip=frame_skip,
            reward_threshold=6000.0,
            forward_reward_weight=forward_reward_weight,
            ctrl_cost_weight=ctrl_cost_weight,
            healthy_reward=healthy_reward,
            terminate_when_unhealthy=terminate_when_unhealthy,
            healthy_z_range=healthy_z_range,
            reset_noise_scale=reset_noise_scale,
            exclude_current_positions_from_observation=exclude_current_positions_from_observation,
            solver=solver,
        )
        try:
            self._main_body = self.mj_model.body(main_body).id
        except (KeyError, IndexError) as error:
            raise ValueError(f"main_body {main_body!r} is not in {xml_file}: {error}") from None
        self._contact_cost_weight = contact_cost_weight
        self._contact_force_range = contact_force_range
        self._include_cfrc_ext = include_cfrc_ext_in_observation

    def place(self, data):
        """Returns x and y of the main body [2] (m), as old as Gymnasium's."""
        return data.xpos[self._main_body, :2]

    def is_healthy(self, data):
        """Tells whether the height is in its range and everything finite."""
        low, high = self._healthy_z_range
        finite = jnp.all(jnp.isfinite(data.qpos)) & jnp.all(jnp.isfinite(data.qvel))
        return finite & (low <= data.qpos[2]) & (data.qpos[2] <= high)

    def terms(self, data):
        """Returns the reward for health and the cost of contacts."""
        cost = self._contact_cost_weight * jnp.sum(jnp.square(self._forces(data)))
        return super().terms(data) | {"reward_contact": -cost}

    def observe(self, data):
        """Returns positions, velocities and contact forces."""
        motion = super().observe(data)
        if not self._include_cfrc_ext:
            return motion
        return jnp.concatenate([motion, self._forces(data)[1:].ravel()])

    def _forces(self, data):
        """Returns the clipped contact torques and forces on every body [nbody, 6]."""
        return jnp.clip(data._impl.cfrc_ext, *self._contact_force_range)
