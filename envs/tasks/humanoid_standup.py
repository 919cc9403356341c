"""HumanoidStandup: a person who lies on the floor and should get up."""

import dataclasses

import jax.numpy as jnp

from mjx_reinforce.envs.locomotion import Person
from mjx_reinforce.envs.settings import Interval, check_range


class HumanoidStandup(Person):
    """Gymnasium's HumanoidStandup (gymnasium/envs/mujoco/humanoidstandup_v5.py), solver apart.

    Gymnasium's model asks for MuJoCo's PGS solver, which MJX lacks. This one asks for Newton, which
    minimises the same function to a tighter tolerance: the two differ where PGS stops early.

    Observation, O = 348, and action, A = 17: as Humanoid.

    Reward: the torso's height (m) over the physics timestep of 0.003 s, not over the env step, plus
    1, less 0.1 times the sum of the squared actions and 5e-7 times that of the contact forces, the
    latter at most 10. Start: every position and velocity uniform within ``reset_noise_scale`` of
    lying at rest. Never terminates. No threshold; at most 1000 steps of 0.015 s.
    """

    @dataclasses.dataclass(frozen=True, kw_only=True)
    class Settings(Person.Settings):
        """Arguments of HumanoidStandup."""

        xml_file: str = "humanoid_standup.xml"
        uph_cost_weight: float = 1.0
        """Times the reward for height; Gymnasium takes this argument and ignores it."""
        impact_cost_weight: float = 0.5e-6
        """What one unit of squared contact force costs."""
        impact_cost_range: Interval = (-float("inf"), 10.0)
        """The cost of contacts is clipped to this."""

        def __post_init__(self):
            """Raises ValueError for a value that is out of its range."""
            super().__post_init__()
            check_range("impact_cost_range", self.impact_cost_range)

    settings: Settings

    def outcome(self, before, data, action):
        """Returns the reward for height less the costs, and its terms; never terminates."""
        height, weights = data.qpos[2], self.settings
        terms = {
            "reward_linup": weights.uph_cost_weight * height / self.mj_model.opt.timestep,
            "reward_quadctrl": -self.control_cost(action),
            "reward_impact": -self.contact_cost(
                data, weights.impact_cost_weight, weights.impact_cost_range
            ),
        }
        where = {
            "x_position": data.qpos[0],
            "y_position": data.qpos[1],
            "z_distance_from_origin": height - self.mj_model.qpos0[2],
        }
        return sum(terms.values()) + 1, jnp.zeros((), bool), terms | where
