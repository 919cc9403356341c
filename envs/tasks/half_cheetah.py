"""HalfCheetah: a planar animal on two legs that runs as fast as it can."""

import dataclasses

from mjx_reinforce.envs.locomotion import Runner


class HalfCheetah(Runner):
    """Gymnasium's HalfCheetah (gymnasium/envs/mujoco/half_cheetah_v5.py).

    Observation, O = 17: height of the torso's centre over its pose (m), pitch of the torso, angles
    of the back thigh, shin and foot and of the front thigh, shin and foot (rad); velocity along x
    and z (m/s), angular velocities in the same order (rad/s). With
    ``exclude_current_positions_from_observation=False`` x (m) comes first, O = 18. Action, A = 6:
    torques in [-1, 1] on the back thigh, shin and foot and the front ones, times gears of 120, 90,
    60, 120, 60 and 30 (N m).

    Reward: the speed along x over the step (m/s) less 0.1 times the sum of the squared actions.
    Start: positions uniform within ``reset_noise_scale`` of the pose, velocities normal with that
    deviation. Never terminates. Solved at a return of 4800; at most 1000 steps of 0.05 s.
    """

    num_places = 1
    normal_velocity = True

    @dataclasses.dataclass(frozen=True, kw_only=True)
    class Settings(Runner.Settings):
        """Arguments of HalfCheetah."""

        xml_file: str = "half_cheetah.xml"
        frame_skip: int = 5
        reward_threshold: float | None = 4800.0
        ctrl_cost_weight: float = 0.1
        reset_noise_scale: float = 0.1

    settings: Settings
