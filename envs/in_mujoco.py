"""A task stepped by C MuJoCo: one episode plays at once, where JAX would compile for a minute."""

import types
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from mujoco import (  # a C extension
    MjData,  # pyright: ignore[reportAttributeAccessIssue]
    mj_forward,  # pyright: ignore[reportAttributeAccessIssue]
    mj_rnePostConstraint,  # pyright: ignore[reportAttributeAccessIssue]
    mj_step,  # pyright: ignore[reportAttributeAccessIssue]
)

from mjx_reinforce.envs import models
from mjx_reinforce.envs.base import Before, MujocoEnv
from mjx_reinforce.physics.mjx_internals import Simulation
from mjx_reinforce.types import Environment

_LEAVE_OUT = "leave --backend mujoco out"


class _Recorder(Simulation):
    """An mjData of zeros that remembers which of its fields were read."""

    def __init__(self, sizes: Simulation):
        self.sizes, self.read = sizes, set()

    def __getattr__(self, name: str) -> jax.Array:
        shape = getattr(self.sizes, name)
        if not hasattr(shape, "dtype"):
            raise ValueError(f"the task reads {name}, which is no array of mjData; {_LEAVE_OUT}")
        self.read.add(name)
        return jnp.zeros(shape.shape, shape.dtype)


class InMujoco:
    """One episode at a time of a task, in float64, under the task's own reward and end.

    Starts are those of ``env.reset``. Positions differ from those of ``env.step`` by rounding,
    which contacts amplify, and by what C's solver leaves where it stops before the optimum.

    data: the simulation, an ``MjData``; forces in ``data.xfrc_applied`` act in the next step
    """

    def __init__(self, env: Environment):
        """Finds out which fields of mjData the task reads; simulates nothing.

        Raises:
          ValueError: the task has a ``reset`` or ``step`` of its own, or reads what C MuJoCo keeps
            in arrays of another size.
        """
        own = type(env)
        if not isinstance(env, MujocoEnv) or (own.reset, own.step) != (
            MujocoEnv.reset,
            MujocoEnv.step,
        ):
            raise ValueError(
                f"{own.__name__} has steps of its own, which MuJoCo does not know; {_LEAVE_OUT}"
            )
        self.env, self.data = env, MjData(env.mj_model)
        self._sizes = Simulation(jax.eval_shape(lambda: models.make_data(env.mj_model)))
        recorder = _Recorder(self._sizes)
        jax.eval_shape(
            lambda before, action: (
                env.outcome(Before(before), recorder, action),
                env.observe(recorder),
            ),
            self._kept(),
            jnp.zeros(env.action_size),
        )
        self._read = sorted(recorder.read)
        self._fields()  # raises for those of another size
        self._start = jax.jit(env.initial)
        self._observe = jax.jit(lambda fields: env.observe(_data(fields)))
        self._advance = jax.jit(self._outcome)

    def reset(self, rng: jax.Array) -> np.ndarray:
        """Begins an episode and returns its first observation [O]; consumes the key."""
        qpos, qvel = self._start(rng)
        model, data = self.env.mj_model, MjData(self.env.mj_model)
        data.qpos[:], data.qvel[:] = qpos, qvel
        mj_forward(model, data)
        self.data = data
        return np.asarray(self._observe(self._fields()))

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool]:
        """Returns the next observation [O], the reward, and whether the episode ended.

        Args:
          action: [A] as the policy gave it.
        """
        before = self._kept()
        self.data.ctrl[:] = action
        mj_step(self.env.mj_model, self.data, self.env.frame_skip)
        if self.env.contact_forces:
            mj_rnePostConstraint(self.env.mj_model, self.data)
        observation, reward, ended = self._advance(before, self._fields(), jnp.asarray(action))
        return np.asarray(observation), float(reward), bool(ended)

    def _outcome(self, before, fields, action):
        data = _data(fields)
        reward, ended, _ = self.env.outcome(Before(before), data, action)
        return self.env.observe(data), reward, ended

    def _fields(self) -> dict[str, np.ndarray]:
        """Returns what the task reads of the simulation, in the shapes that MJX has."""
        return {name: self._field(name) for name in self._read}

    def _kept(self) -> dict[str, np.ndarray]:
        """Returns what the next outcome may read of the start of an env step."""
        names = (*models.CARRIED, *models.CONSTANT, *self.env.carried)
        return {name: self._field(name) for name in names}

    def _field(self, name: str) -> np.ndarray:
        shape, value = getattr(self._sizes, name), np.array(getattr(self.data, name))
        if value.size != np.prod(shape.shape, dtype=int):
            raise ValueError(
                f"the task reads {name}, whose size in MuJoCo changes from step to step; "
                f"{_LEAVE_OUT}"
            )
        return value.reshape(shape.shape).astype(shape.dtype)


def _data(fields: dict[str, Any]) -> Any:
    """Returns fields of mjData as attributes."""
    return types.SimpleNamespace(**fields)
