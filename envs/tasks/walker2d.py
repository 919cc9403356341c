"""Walker2d: a torso on two legs that walks forward in a plane without falling."""

import dataclasses

from mjx_reinforce.envs.locomotion import PlanarWalker
from mjx_reinforce.envs.settings import Interval


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

    settings: Settings
