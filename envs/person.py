"""What Humanoid and HumanoidStandup share: the observation and the cost of contacts."""

import dataclasses

import jax
import jax.numpy as jnp

from mjx_reinforce.envs.locomotion import Body
from mjx_reinforce.envs.settings import Interval
from mjx_reinforce.physics.mjx_internals import Simulation


class Person(Body):
    """A person with the model of Gymnasium's humanoids."""

    @dataclasses.dataclass(frozen=True, kw_only=True)
    class Settings(Body.Settings):
        """Arguments of both tasks."""

        frame_skip: int = 5
        ctrl_cost_weight: float = 0.1
        reset_noise_scale: float = 1e-2
        include_cinert_in_observation: bool = True
        """Whether to observe inertias and masses."""
        include_cvel_in_observation: bool = True
        """Whether to observe the bodies' velocities."""
        include_qfrc_actuator_in_observation: bool = True
        """Whether to observe the motors' torques."""
        include_cfrc_ext_in_observation: bool = True
        """Whether to observe the contact forces."""

    settings: Settings
    contact_forces = True

    def contact_cost(self, data: Simulation, weight: float, bounds: Interval) -> jax.Array:
        """Returns what the contacts cost [].

        Args:
          data: the simulation after the env step.
          weight: what one unit of squared contact force costs.
          bounds: the least and the greatest cost.
        """
        return jnp.clip(weight * jnp.sum(jnp.square(data.cfrc_ext)), *bounds)

    def observe(self, data):
        """Returns positions, velocities and, unless left out, inertias, motions and forces."""
        chosen = self.settings
        parts = [
            (True, super().observe(data)),
            (chosen.include_cinert_in_observation, data.cinert[1:]),
            (chosen.include_cvel_in_observation, data.cvel[1:]),
            (chosen.include_qfrc_actuator_in_observation, data.qfrc_actuator[6:]),
            (chosen.include_cfrc_ext_in_observation, data.cfrc_ext[1:]),
        ]
        return jnp.concatenate([part.ravel() for included, part in parts if included])
