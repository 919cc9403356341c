"""Hopper: a torso on one leg that hops forward without falling."""

import jax.numpy as jnp

from mjx_reinforce.envs.locomotion import PlanarWalker, Range, check_range, within


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

    def __init__(
        self,
        *,
        xml_file: str = "hopper.xml",
        frame_skip: int = 4,
        forward_reward_weight: float = 1.0,
        ctrl_cost_weight: float = 1e-3,
        healthy_reward: float = 1.0,
        terminate_when_unhealthy: bool = True,
        healthy_state_range: Range = (-100.0, 100.0),
        healthy_z_range: Range = (0.7, float("inf")),
        healthy_angle_range: Range = (-0.2, 0.2),
        reset_noise_scale: float = 5e-3,
        exclude_current_positions_from_observation: bool = True,
        solver: str = "exact",
    ):
        """Builds the task.

        Args:
          xml_file: the model.
          frame_skip: physics steps of 0.002 s an env step.
          forward_reward_weight: what 1 m/s along x earns.
          ctrl_cost_weight: what one unit of squared action costs.
          healthy_reward: what a healthy step earns.
          terminate_when_unhealthy: whether an unhealthy step ends the episode.
          healthy_state_range: angles (rad) and velocities (m/s, rad/s), bounds excluded.
          healthy_z_range: heights of the torso (m), bounds excluded.
          healthy_angle_range: angles of the torso (rad), bounds excluded.
          reset_noise_scale: half the width of the start distribution (m, rad, m/s, rad/s).
          exclude_current_positions_from_observation: whether to leave out x.
          solver: "exact", "mjx" or "fast", see ``MujocoEnv``.

        Raises:
          ValueError: an argument is out of its range.
        """
        check_range("healthy_state_range", healthy_state_range)
        super().__init__(
            xml_file=xml_file,
            frame_skip=frame_skip,
            reward_threshold=3800.0,
            forward_reward_weight=forward_reward_weight,
            ctrl_cost_weight=ctrl_cost_weight,
            healthy_reward=healthy_reward,
            terminate_when_unhealthy=terminate_when_unhealthy,
            healthy_z_range=healthy_z_range,
            healthy_angle_range=healthy_angle_range,
            reset_noise_scale=reset_noise_scale,
            exclude_current_positions_from_observation=exclude_current_positions_from_observation,
            solver=solver,
        )
        self._healthy_state_range = healthy_state_range

    def is_healthy(self, data):
        """Tells whether height, angle and all else but x and z are within their ranges."""
        state = jnp.concatenate([data.qpos[2:], data.qvel])
        return super().is_healthy(data) & jnp.all(within(state, self._healthy_state_range))
