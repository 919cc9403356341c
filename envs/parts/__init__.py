"""What tasks of robots are made of: noise, delays, commands, pushes, variation, rewards.

Pure functions for the methods of a ``MujocoEnv``. They are the same in every engine.
"""

from mjx_reinforce.envs.parts.body import angular_velocity, gravity, linear_velocity
from mjx_reinforce.envs.parts.changes import command, is_due, push, push_velocity
from mjx_reinforce.envs.parts.delays import append, delayed, history
from mjx_reinforce.envs.parts.gait import clock, cyclic, feet, gait
from mjx_reinforce.envs.parts.noise import normal_noise, uniform_noise
from mjx_reinforce.envs.parts.rewards import action_rate, effort, tracking, upright, weighted
from mjx_reinforce.envs.parts.variation import (
    actuators,
    armature,
    centers,
    damping,
    friction,
    masses,
)

__all__ = [
    "action_rate",
    "actuators",
    "angular_velocity",
    "append",
    "armature",
    "centers",
    "clock",
    "command",
    "cyclic",
    "damping",
    "delayed",
    "effort",
    "feet",
    "friction",
    "gait",
    "gravity",
    "history",
    "is_due",
    "linear_velocity",
    "masses",
    "normal_noise",
    "push",
    "push_velocity",
    "tracking",
    "uniform_noise",
    "upright",
    "weighted",
]
