"""A pole on a cart, and two poles, one on the other, that are to be kept upright."""

import dataclasses

import jax.numpy as jnp

from mjx_reinforce.envs.near_pose import NearPose

_MAX_ANGLE = 0.2


class InvertedPendulum(NearPose):
    """Gymnasium's InvertedPendulum (gymnasium/envs/mujoco/inverted_pendulum_v5.py).

    Observation, O = 4: cart position (m), pole angle (rad), cart velocity (m/s),
    pole angular velocity (rad/s). Action, A = 1: force on the cart in [-3, 3],
    times a gear of 100 (N).

    Reward: 1 each step the pole stays up. The step on which it falls earns 0 in
    v5 and 1 in v4. Start: every position and velocity uniform within
    ``reset_noise_scale``. Terminates when the angle leaves [-0.2, 0.2] rad or the
    observation is not finite. Solved at a return of 950; at most 1000 steps of
    0.04 s.
    """

    @dataclasses.dataclass(frozen=True, kw_only=True)
    class Settings(NearPose.Settings):
        """Arguments of InvertedPendulum."""

        xml_file: str = "inverted_pendulum.xml"
        frame_skip: int = 2
        reward_threshold: float | None = 950.0
        reset_noise_scale: float = 0.01
        reward_at_fall: float = 0.0
        """The reward of the step that ends the episode: 0 is v5, 1 is v4."""

    settings: Settings

    def outcome(self, before, data, action):
        """Returns 1 while the pole is up, and whether it fell."""
        # Comparisons with NaN are false: without this a state of NaN would be upright for good.
        finite = jnp.all(jnp.isfinite(data.qpos)) & jnp.all(jnp.isfinite(data.qvel))
        terminated = ~finite | (jnp.abs(data.qpos[1]) > _MAX_ANGLE)
        reward = jnp.where(terminated, self.settings.reward_at_fall, 1.0)
        return reward, terminated, {"reward_survive": reward}


class InvertedDoublePendulum(NearPose):
    """Gymnasium's InvertedDoublePendulum (gymnasium/envs/mujoco/inverted_double_pendulum_v5.py).

    Observation, O = 9: cart position (m); sine of the lower pole's angle and of the upper's
    against the lower; their cosines; cart velocity (m/s) and the two angular velocities (rad/s),
    clipped to 10; constraint force on the cart (N), clipped to 10, not zero where it pushes
    against the end of the rail. Action, A = 1: force on the cart in [-1, 1], times a gear of
    500 (N).

    Reward: 10 each step the tip stays up, minus 0.01 x^2 and (y - 2)^2 for the tip's position x, y
    (m) and 1e-3 v1^2 + 5e-3 v2^2 for the angular velocities. Start: positions uniform within
    ``reset_noise_scale``, velocities normal with that standard deviation. Terminates when the
    tip is at 1 m or lower, of 1.2 m. Solved at a return of 9100; at most 1000 steps of 0.05 s.
    """

    @dataclasses.dataclass(frozen=True, kw_only=True)
    class Settings(NearPose.Settings):
        """Arguments of InvertedDoublePendulum."""

        xml_file: str = "inverted_double_pendulum.xml"
        """The model; its first site is the tip."""
        frame_skip: int = 5
        reward_threshold: float | None = 9100.0
        healthy_reward: float = 10.0
        """The reward of a step that does not end the episode."""
        reset_noise_scale: float = 0.1

    settings: Settings
    normal_velocity = True

    def observe(self, data):
        """Returns the observation [9]."""
        angles = data.qpos[1:]
        rates = jnp.clip(data.qvel, -10, 10)
        # The cart's alone: nothing holds the hinges. Gymnasium had all three before v5.
        force = jnp.clip(data.qfrc_constraint[:1], -10, 10)
        return jnp.concatenate([data.qpos[:1], jnp.sin(angles), jnp.cos(angles), rates, force])

    def outcome(self, before, data, action):
        """Returns the bonus less the penalties, and whether the tip is down.

        The tip's position is that of the last Runge-Kutta stage, as in Gymnasium, not that of the
        new qpos.
        """
        # Gymnasium calls the tip's height y; the third axis is z in MuJoCo.
        x, _, y = data.site_xpos[0]
        terminated = y <= 1
        terms = {
            "reward_survive": self.settings.healthy_reward * ~terminated,
            "distance_penalty": -(0.01 * x**2 + (y - 2) ** 2),
            "velocity_penalty": -(1e-3 * data.qvel[1] ** 2 + 5e-3 * data.qvel[2] ** 2),
        }
        return sum(terms.values()), terminated, terms
