"""Swimmer: three rods in a viscous fluid, driven forward by the two joints between them."""

from mjx_reinforce.envs.locomotion import Runner


class Swimmer(Runner):
    """Gymnasium's Swimmer (gymnasium/envs/mujoco/swimmer_v5.py).

    Observation, O = 8: angle of the front rod, angles of the two joints (rad); velocity of the
    tip along x and y (m/s), angular velocities of the rod and the joints (rad/s). With
    ``exclude_current_positions_from_observation=False`` the tip's x and y (m) come first, O = 10.
    Action, A = 2: torques on the joints in [-1, 1], times a gear of 150 (N m).

    Reward: the tip's speed along x over the step (m/s) less 1e-4 times the sum of the squared
    actions. Start: every position and velocity uniform within ``reset_noise_scale`` of the
    straight rods at rest. Never terminates. Solved at a return of 360; at most 1000 steps of
    0.04 s.
    """

    def __init__(
        self,
        *,
        xml_file: str = "swimmer.xml",
        frame_skip: int = 4,
        forward_reward_weight: float = 1.0,
        ctrl_cost_weight: float = 1e-4,
        reset_noise_scale: float = 0.1,
        exclude_current_positions_from_observation: bool = True,
        solver: str = "exact",
    ):
        """Builds the task.

        Args:
          xml_file: the model.
          frame_skip: physics steps of 0.01 s an env step.
          forward_reward_weight: what 1 m/s along x earns.
          ctrl_cost_weight: what one unit of squared action costs.
          reset_noise_scale: half the width of the start distribution (m, rad, m/s, rad/s).
          exclude_current_positions_from_observation: whether to leave out x and y.
          solver: "exact", "mjx" or "fast", see ``MujocoEnv``.

        Raises:
          ValueError: an argument is out of its range.
        """
        super().__init__(
            xml_file=xml_file,
            frame_skip=frame_skip,
            reward_threshold=360.0,
            forward_reward_weight=forward_reward_weight,
            ctrl_cost_weight=ctrl_cost_weight,
            reset_noise_scale=reset_noise_scale,
            exclude_current_positions_from_observation=exclude_current_positions_from_observation,
            solver=solver,
        )
