"""Walker2d: a torso on two legs that walks forward in a plane without falling."""

from mjx_reinforce.envs.locomotion import PlanarWalker, Range


class Walker2d(PlanarWalker):
    """Gymnasium's Walker2d (gymnasium/envs/mujoco/walker2d_v5.py).

    Observation, O = 17: height of the torso (m), angles of the torso, the right thigh, leg and
    foot and the left ones (rad); velocity of the torso along x and z (m/s) and the angular
    velocities (rad/s), clipped to [-10, 10]. With
    ``exclude_current_positions_from_observation=False`` x (m) comes first, O = 18. Action, A = 6:
    torques in [-1, 1] on the right thigh, leg and foot and the left ones, times a gear of 100
    (N m).

    Reward: the speed along x over the step (m/s), plus 1 if healthy, less 1e-3 times the sum of
    the squared actions. Start: every position and velocity uniform within ``reset_noise_scale``
    of standing at rest. Terminates when not healthy: height outside (0.8, 2) m or torso angle
    outside (-1, 1) rad. No threshold; at most 1000 steps of 0.008 s.
    """

    def __init__(
        self,
        *,
        xml_file: str = "walker2d.xml",
        frame_skip: int = 4,
        forward_reward_weight: float = 1.0,
        ctrl_cost_weight: float = 1e-3,
        healthy_reward: float = 1.0,
        terminate_when_unhealthy: bool = True,
        healthy_z_range: Range = (0.8, 2.0),
        healthy_angle_range: Range = (-1.0, 1.0),
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
          healthy_z_range: heights of the torso (m), bounds excluded.
          healthy_angle_range: angles of the torso (rad), bounds excluded.
          reset_noise_scale: half the width of the start distribution (m, rad, m/s, rad/s).
          exclude_current_positions_from_observation: whether to leave out x.
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
            healthy_reward=healthy_reward,
            terminate_when_unhealthy=terminate_when_unhealthy,
            healthy_z_range=healthy_z_range,
            healthy_angle_range=healthy_angle_range,
            reset_noise_scale=reset_noise_scale,
            exclude_current_positions_from_observation=exclude_current_positions_from_observation,
            solver=solver,
        )
