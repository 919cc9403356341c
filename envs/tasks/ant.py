"""Ant: a torso on four legs that walks along x without falling or jumping."""

import dataclasses

import jax.numpy as jnp

from mjx_reinforce.envs.locomotion import Healthy
from mjx_reinforce.envs.settings import Interval


class Ant(Healthy):
    """Gymnasium's Ant (gymnasium/envs/mujoco/ant_v5.py).

    Observation, O = 105: height of the torso (m) and its orientation (quaternion), hip and ankle
    angles of the four legs (rad); velocity (m/s) and angular velocity (rad/s) of the torso, angular
    velocities of the joints (rad/s); for each of 13 bodies the torque (N m) and force (N) of its
    contacts, clipped to ``contact_force_range``. With
    ``exclude_current_positions_from_observation=False`` x and y (m) come first. Action, A = 8:
    torques in [-1, 1] on hip and ankle of the legs 4, 1, 2, 3, times a gear of 150 (N m).

    Reward: the speed of ``main_body`` along x over the step (m/s), plus 1 if healthy, minus 0.5
    times the sum of the squared actions and 5e-4 times that of the clipped contact forces. Start:
    positions uniform within ``reset_noise_scale`` of the pose, velocities normal with that
    deviation. Terminates when not healthy: height outside [0.2, 1] m, or not finite. Solved at a
    return of 6000; at most 1000 steps of 0.05 s.
    """

    @dataclasses.dataclass(frozen=True, kw_only=True)
    class Settings(Healthy.Settings):
        """Arguments of Ant."""

        xml_file: str = "ant.xml"
        frame_skip: int = 5
        reward_threshold: float | None = 6000.0
        ctrl_cost_weight: float = 0.5
        contact_cost_weight: float = 5e-4
        """What one unit of squared, clipped contact force costs."""
        healthy_z_range: Interval = (0.2, 1.0)
        """Heights of a healthy torso (m), bounds included."""
        main_body: int | str = 1
        """The body whose speed counts, by name or number."""
        contact_force_range: Interval = (-1.0, 1.0)
        """Contact torques (N m) and forces (N) are clipped to this."""
        reset_noise_scale: float = 0.1
        include_cfrc_ext_in_observation: bool = True
        """Whether to observe the contact forces."""

    settings: Settings
    normal_velocity = True
    carried = ("xpos",)
    contact_forces = True

    def __init__(self, **arguments: float | bool):
        """Builds the task; see ``MujocoEnv``.

        Raises:
          ValueError: the model has no ``main_body``, or as ``MujocoEnv``.
        """
        super().__init__(**arguments)
        main_body = self.settings.main_body
        # MuJoCo's own error names neither the setting nor the file.
        try:
            self._main_body = self.mj_model.body(main_body).id
        except (KeyError, IndexError) as error:
            raise ValueError(
                f"main_body {main_body!r} is not in {self.settings.xml_file}: {error}"
            ) from None

    def place(self, data):
        """Returns x and y of the main body [2] (m) at the last forward pass."""
        return data.xpos[self._main_body, :2]

    def is_healthy(self, data):
        """Returns whether the height is in its range and the whole state finite."""
        # Bounds included, unlike those of the other walkers.
        low, high = self.settings.healthy_z_range
        finite = jnp.all(jnp.isfinite(data.qpos)) & jnp.all(jnp.isfinite(data.qvel))
        return finite & (low <= data.qpos[2]) & (data.qpos[2] <= high)

    def terms(self, data):
        """Returns the reward for health and the cost of contacts."""
        cost = self.settings.contact_cost_weight * jnp.sum(jnp.square(self._forces(data)))
        return super().terms(data) | {"reward_contact": -cost}

    def observe(self, data):
        """Returns positions, velocities and contact forces."""
        motion = super().observe(data)
        if not self.settings.include_cfrc_ext_in_observation:
            return motion
        # Without those on the world, body 0.
        return jnp.concatenate([motion, self._forces(data)[1:].ravel()])

    def _forces(self, data):
        """Returns the clipped contact torques and forces on every body [nbody, 6]."""
        return jnp.clip(data.cfrc_ext, *self.settings.contact_force_range)
