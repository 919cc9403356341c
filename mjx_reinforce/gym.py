"""Importing this tells Gymnasium our tasks.

    import gymnasium, mjx_reinforce.gym
    envs = gymnasium.make_vec("mjx_reinforce/HalfCheetah-v5", num_envs=4096)

Gymnasium 1.0 and newer ask no package for its tasks by themselves, so this import is needed, or the
id asks for it: "mjx_reinforce.gym:mjx_reinforce/HalfCheetah-v5". The arguments of ``make_vec`` are
those of ``vector.for_gymnasium.make``.
"""

import gymnasium

from mjx_reinforce import envs
from mjx_reinforce.settings.tables import TASKS

for _id in envs.names():
    gymnasium.register(
        f"mjx_reinforce/{_id}",
        entry_point="mjx_reinforce.engine.vector.for_gymnasium:only_many",
        vector_entry_point="mjx_reinforce.engine.vector.for_gymnasium:make",
        max_episode_steps=TASKS[_id].horizon if _id in TASKS else None,
        kwargs={"env": _id},
    )
