"""Runge-Kutta of order 4 as ``mj_RungeKutta`` of C MuJoCo 4.0.

It is MJX's, except the orientations of free and ball joints. MJX 3.17 averages the stages' angular
velocities, though each is in its own stage's frame, which makes it a method of order 2. MuJoCo,
from 4.0 on, averages the rates of one rotation vector (Runge-Kutta-Munthe-Kaas).
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from mujoco import mjx

from mjx_reinforce.engine.physics.mjx_internals import advance

# For each stage: its place in the timestep, its weight, and the place of the next stage.
_STAGES = ((0, 1 / 6, 0.5), (0.5, 1 / 3, 0.5), (0.5, 1 / 3, 1), (1, 1 / 6, 0))

# Below this square of an angle a series in it replaces the closed form in ``_rotation_rate``.
_SMALL_SQUARE = 0.01
_BORTZ_SERIES = (1 / 12, 1 / 720, 1 / 30240, 1 / 1209600)


def runge_kutta_4(
    model: mjx.Model, data: mjx.Data, evaluate: Callable[[mjx.Data], mjx.Data]
) -> mjx.Data:
    """Advances the simulation by one timestep.

    Args:
      model: an MJX model made with impl='jax'.
      data: its data, with ``ctrl`` set.
      evaluate: the model's forward pass, up to the acceleration.
    """
    start, timestep = data, model.opt.timestep

    def follow(carry: tuple, row: jax.Array) -> tuple[tuple, None]:
        """Evaluates a stage, adds its weighted rates, and moves from the start to the next."""
        stage, rate, sums = carry
        position, weight, next_position = row
        stage = like(evaluate(stage), stage)
        # The next stage's solver starts at this one's solution. C starts all four where the time
        # step did: the minimum is the same, after more steps (Humanoid, random actions: 1.9, not
        # 1.7).
        stage = stage.replace(qacc_warmstart=stage.qacc)
        rate = _displacement_rate(model, stage.qvel, rate, position)
        rates = rate, stage.qacc, stage.act_dot
        sums = tuple(total + weight * x for total, x in zip(sums, rates, strict=True))
        qvel, qacc, act_dot = (next_position * x for x in rates)
        advanced = advance(model, start.replace(qacc=qacc), act_dot, qacc, qvel)
        stage = stage.replace(
            qpos=advanced.qpos,
            qvel=advanced.qvel,
            act=start.act + act_dot * timestep,
            time=start.time + next_position * timestep,
        )
        return (stage, rate, sums), None

    # A loop, so that XLA compiles one forward pass instead of four.
    nothing = jax.tree.map(jnp.zeros_like, (data.qvel, data.qvel, data.act))
    rows = jnp.asarray(_STAGES, data.qpos.dtype)
    (stage, _, sums), _ = jax.lax.scan(follow, (data, data.qvel, nothing), rows)
    end = stage.replace(qpos=start.qpos, qvel=start.qvel, act=start.act, time=start.time)
    qvel, qacc, act_dot = sums
    # The next step starts its solver at the last stage's acceleration, and shows the mean.
    return advance(model, end, act_dot, qacc, qvel).replace(qacc=qacc)


def like(new: mjx.Data, old: mjx.Data) -> mjx.Data:
    """Returns the new data in the types of the old; MJX makes tendon indices int64 under x64."""
    return jax.tree.map(lambda x, y: x.astype(y.dtype), new, old)


def _displacement_rate(
    model: mjx.Model, qvel: jax.Array, last_rate: jax.Array, position: jax.Array
) -> jax.Array:
    """Returns how fast the displacement since the step's start grows at a stage, [nv].

    Args:
      model: an MJX model; without free and ball joints, the answer is ``qvel``.
      qvel: [nv] the stage's velocity.
      last_rate: [nv] the rate that led to the stage.
      position: [] the stage's place in the timestep, from 0 to 1.
    """
    rate = qvel
    for kind, dof in zip(model.jnt_type, model.jnt_dofadr, strict=True):
        if kind not in (mjx.JointType.FREE, mjx.JointType.BALL):
            continue
        first = int(dof) + (3 if kind == mjx.JointType.FREE else 0)
        turn = slice(first, first + 3)
        rotation = position * model.opt.timestep * last_rate[turn]
        rate = rate.at[turn].set(_rotation_rate(rotation, qvel[turn]))
    return rate


def _rotation_rate(rotation: jax.Array, velocity: jax.Array) -> jax.Array:
    r"""Returns the time derivative of a rotation vector r under angular velocity w, [3].

    Bortz (1971), with w in the rotated frame; ``mju_derivExpmap`` of MuJoCo 4.0:

        r' = w + r x w / 2 + c(|r|) r x (r x w),   c(x) = (1 - (x/2) cot(x/2)) / x^2

    c is singular at multiples of 2 pi, so that r is first replaced by the same rotation of an
    angle in (-pi, pi].
    """
    square = jnp.sum(rotation**2)
    large = square > jnp.pi**2
    angle = jnp.sqrt(jnp.where(large, square, 1))
    excess = 2 * jnp.pi * jnp.floor(angle / (2 * jnp.pi) + 0.5)
    rotation = jnp.where(large, rotation * (1 - excess / angle), rotation)
    square = jnp.sum(rotation**2)
    small = square < _SMALL_SQUARE
    safe = jnp.where(small, 1, square)
    half = jnp.sqrt(safe) / 2
    series = sum(c * square**i for i, c in enumerate(_BORTZ_SERIES))
    coefficient = jnp.where(small, series, (1 - half / jnp.tan(half)) / safe)
    across = jnp.cross(rotation, velocity)
    return velocity + across / 2 + coefficient * jnp.cross(rotation, across)
