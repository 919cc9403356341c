"""Importing this tells Gymnasium our tasks.

    import gymnasium, mjx_reinforce.gym
    envs = gymnasium.make_vec("mjx_reinforce/HalfCheetah-v5", num_envs=4096)

Gymnasium 1.0 and newer ask no package for its tasks by themselves, so this import is needed, or the
id asks for it: "mjx_reinforce.gym:mjx_reinforce/HalfCheetah-v5". The arguments of ``make_vec`` are
those of ``make``.
"""

from typing import TYPE_CHECKING, Any

import gymnasium
from gymnasium.vector import AutoresetMode

from mjx_reinforce import envs
from mjx_reinforce.engine.vector.pictures import import_mujoco
from mjx_reinforce.settings.defaults import HORIZONS

if TYPE_CHECKING:
    from mjx_reinforce.engine.base import Environment
    from mjx_reinforce.engine.vector.for_gymnasium import GymnasiumVectorEnv

for _id in envs.names():
    gymnasium.register(
        f"mjx_reinforce/{_id}",
        entry_point="mjx_reinforce.gym:only_many",
        vector_entry_point="mjx_reinforce.gym:make",
        max_episode_steps=HORIZONS.get(_id),
        kwargs={"env": _id},
    )


def make(
    env: "str | Environment",
    num_envs: int = 1,
    *,
    arrays: str = "numpy",
    render_mode: str | None = None,
    autoreset: str | AutoresetMode = "next_step",
    **options: Any,
) -> "GymnasiumVectorEnv":
    """Makes N environments for Gymnasium; ``gymnasium.make_vec("mjx_reinforce/ID", N)`` calls it.

    Args:
      env: as of ``make_vec``.
      num_envs: N.
      arrays: "numpy", "jax" or "torch".
      render_mode: "rgb_array", or None for no pictures.
      autoreset: as of ``make_vec``, or Gymnasium's ``AutoresetMode``.
      **options: further arguments of ``make_vec``, and of the task.

    Raises:
      ValueError: as of ``make_vec``, or MuJoCo cannot draw here.
    """
    # First of all: how MuJoCo draws is settled when it is imported.
    if render_mode is not None:
        import_mujoco()
    from mjx_reinforce.engine.vector.for_gymnasium import GymnasiumVectorEnv  # loads JAX

    vec = envs.make_vec(env, num_envs, autoreset=autoreset, **options)
    return GymnasiumVectorEnv(vec, arrays, render_mode)


def only_many(env: str, **options: object) -> gymnasium.Env:
    """Raises ValueError: Gymnasium's ``make`` asks for one environment."""
    raise ValueError(
        f"many play at once here: use gymnasium.make_vec('mjx_reinforce/{env}', num_envs=...); for "
        f"one of Gymnasium's own, use gymnasium.make('{env}')"
    )
