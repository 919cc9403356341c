"""What sensors in a body measure, of any simulation that a task reads.

They are those of the last forward pass, as MuJoCo's sensors are: after an env step they are one
physics step older than qpos and qvel.
"""

import jax
import jax.numpy as jnp
import numpy as np

from mjx_reinforce.envs.views import Named


def gravity(data: Named, body: str) -> jax.Array:
    """Returns the direction of gravity in a body's frame, a unit vector [3]: upright (0, 0, -1).

    An inertial measurement unit (IMU) estimates it. Without gravity in the model it is 0.

    Args:
      data: the simulation.
      body: the body's name.
    """
    acceleration = np.array(data.mj_model.opt.gravity)
    down = acceleration / max(np.linalg.norm(acceleration), np.finfo(float).tiny)
    return jnp.asarray(down) @ data.body(body).xmat


def angular_velocity(data: Named, body: str) -> jax.Array:
    """Returns a body's angular velocity in its frame [3] (rad/s), as a gyroscope measures it.

    Args:
      data: the simulation.
      body: the body's name.
    """
    part = data.body(body)
    return part.cvel[:3] @ part.xmat


def linear_velocity(data: Named, body: str) -> jax.Array:
    """Returns the velocity of the origin of a body's frame, in this frame [3] (m/s).

    A robot has no sensor of it. Use it in rewards, or to compare with a state estimator.

    Args:
      data: the simulation.
      body: the body's name.
    """
    part = data.body(body)
    root = data.mj_model.body_rootid[part.id]
    # MuJoCo's velocities are those at the center of mass of the whole tree.
    arm = part.xpos - data.subtree_com[root]  # pyright: ignore[reportAttributeAccessIssue]
    return (part.cvel[3:] + jnp.cross(part.cvel[:3], arm)) @ part.xmat
