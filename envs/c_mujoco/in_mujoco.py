"""A task stepped by C MuJoCo: one episode plays at once, where JAX would compile for a minute."""

import copy
from typing import Any, cast

import jax
import mujoco
import numpy as np

from mjx_reinforce.engine.base import Environment
from mjx_reinforce.envs import models
from mjx_reinforce.envs.base import Before, MujocoEnv
from mjx_reinforce.envs.c_mujoco.fields import fields_read, spec_of
from mjx_reinforce.envs.outcomes import check_control, check_push
from mjx_reinforce.envs.state import (
    NOTHING,
    Recollection,
    observed,
    recollect_start,
    recollect_step,
)

#: MuJoCo's own names; it is a C extension without stubs.
_C: Any = mujoco
#: What C MuJoCo warns of where it begins again in the middle of an episode.
_RESETS = (_C.mjtWarning.mjWARN_BADQPOS, _C.mjtWarning.mjWARN_BADQVEL, _C.mjtWarning.mjWARN_BADQACC)


def was_reset(data: Any) -> bool:
    """Returns whether C MuJoCo reset an ``MjData``, of which a number was NaN or beyond 1e10."""
    return any(data.warning[kind].number for kind in _RESETS)


class InMujoco:
    """One episode at a time of a task, in float64, under the task's own reward and end.

    Starts are those of ``env.reset``. Positions differ from those of ``env.step`` by rounding,
    which contacts amplify, and by what C's solver leaves where it stops before the optimum.

    data: the simulation, an ``MjData``; forces in ``data.xfrc_applied`` act in the next step
    terms: what ``outcome`` returned last as the terms of the reward
    is_pushed: whether the last env step began with a push
    """

    def __init__(self, env: Environment):
        """Finds out which fields of mjData the task reads; simulates nothing.

        Raises:
          ValueError: the task has a ``reset`` or ``step`` of its own, or reads what C MuJoCo has
            in no array of a fixed size.
        """
        task = type(env)
        methods = (MujocoEnv.reset, MujocoEnv.step)
        if not isinstance(env, MujocoEnv) or (task.reset, task.step) != methods:
            raise ValueError(f"{task.__name__} has steps of its own, which MuJoCo does not know")
        self.env = env
        self.model = models.c_model(env.mj_model)
        self.data = _C.MjData(self.model)
        self._episode, _ = jax.eval_shape(env.draw, jax.random.key(0))
        self._names = sorted(fields_read(env, self.data, self._start_fields(), self._episode))
        self._recollection = NOTHING
        self._observation: Any = None  # what the policy saw
        self.terms: dict[str, float] = {}
        self.is_pushed = False
        self._split = jax.jit(env.split_rng)
        self._start = jax.jit(env.draw)
        self._observe = jax.jit(self._first_observation)
        self._advance = jax.jit(self._outcome)

    def reset(self, rng: jax.Array) -> np.ndarray:
        """Begins an episode and returns its first observation [O]; consumes the key."""
        memory_rng, rng = self._split(rng)
        self._episode, start = self._start(rng)
        # A copy, since an episode may replace fields of the model.
        self.model = model = copy.copy(models.c_model(self.env.mj_model))
        data = _C.MjData(model)
        if model_fields := models.replaced(self._episode):
            for name, field in model_fields.items():
                getattr(model, name)[:] = field
            _C.mj_setConst(model, data)
            _C.mj_resetData(model, data)
        for name, field in start.items():
            getattr(data, name)[:] = field
        _C.mj_forward(model, data)
        if self.env.settle_steps:
            _C.mj_step(model, data, self.env.settle_steps)
            data.time = 0
        self.data = data
        fields = self._fields()
        self._observation, self._recollection = self._observe(memory_rng, fields, self._episode)
        return np.asarray(self._observation)

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool]:
        """Returns the next observation [O], the reward, and whether the episode ended.

        The reward is nan where MuJoCo has reset the simulation.

        Args:
          action: [A] as the policy gave it.
        """
        before = self._start_fields()
        name = type(self.env).__name__
        # Not compiled: a control of NumPy's numbers keeps their precision.
        before_view = self._view(before, self._episode, self._recollection)
        control = self.env.actuate(before_view, cast(Any, action))
        self.data.ctrl[:] = check_control(name, control, action, self.model.nu)
        if self.env.has_pushes:
            push = check_push(name, self.env.push(before_view), self.model.nv)
            self.data.qvel[:] += np.asarray(push)
            self.is_pushed = bool(np.any(push))
        _C.mj_step(self.model, self.data, self.env.frame_skip)
        if self.env.contact_forces:
            _C.mj_rnePostConstraint(self.model, self.data)
        self._observation, reward, terminated, self._recollection, terms = self._advance(
            before,
            self._fields(),
            self._episode,
            self._recollection,
            self._observation,
            np.asarray(action),
        )
        self.terms = {name: float(term) for name, term in terms.items()}
        # The task would pay for where MuJoCo has put the body back.
        if was_reset(self.data):
            reward = np.nan
        return np.asarray(self._observation), float(reward), bool(terminated)

    @property
    def command(self) -> np.ndarray:
        """The numbers [K] of the entry "command" of the memory, or of the episode; else K is 0."""
        return np.ravel((self._episode | self._recollection.memory).get("command", ()))

    def _first_observation(self, memory_rng, fields, episode):
        data = self._view(fields, episode)
        recollection = recollect_start(self.env, memory_rng, data)
        return observed(self.env, data), recollection

    def _outcome(self, before, fields, episode, recollection, last_frames, action):
        """Returns the observation, the outcome, and what the episode then remembers."""
        data = self._view(fields, episode)
        next_recollection = recollect_step(self.env, recollection, data, action)
        before = self._view(before, episode, recollection)
        reward, terminated, terms = self.env.outcome(before, data, action)
        observation = observed(self.env, data, last_frames)
        return observation, reward, terminated, next_recollection, terms

    def _view(
        self,
        fields: dict[str, Any],
        episode: dict[str, Any],
        recollection: Recollection = NOTHING,
    ) -> Any:
        """Returns fields of mjData as the task reads them."""
        return Before(fields, self.env.mj_model, episode, recollection.memory)

    def _fields(self) -> dict[str, np.ndarray]:
        """Returns what the task reads of the simulation, in the shapes that tasks read."""
        return {name: self._field(name) for name in self._names}

    def _start_fields(self) -> dict[str, np.ndarray]:
        """Returns what the next outcome may read of the start of an env step."""
        field_names = (*models.CARRIED, *models.CONSTANT, *self.env.carried)
        return {name: self._field(name) for name in field_names}

    def _field(self, name: str) -> np.ndarray:
        spec = spec_of(self.data, name)
        return np.array(getattr(self.data, name)).reshape(spec.shape).astype(spec.dtype)
