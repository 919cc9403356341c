"""Swimmer: three rods in a viscous fluid, driven forward by the two joints between them."""

import dataclasses

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

    @dataclasses.dataclass(frozen=True, kw_only=True)
    class Settings(Runner.Settings):
        """Arguments of Swimmer."""

        xml_file: str = "swimmer.xml"
        frame_skip: int = 4
        reward_threshold: float | None = 360.0
        ctrl_cost_weight: float = 1e-4
        reset_noise_scale: float = 0.1

    settings: Settings
