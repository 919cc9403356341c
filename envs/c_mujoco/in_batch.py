"""A task whose physics C MuJoCo computes, many episodes at once on all cores of the CPU.

Observation, reward and end are traced and compiled as in ``base``; ``mujoco.batch.Batch`` computes
what lies between them, as one operation of the compiled program. What MuJoCo carries from step to
step (mjtState's mjSTATE_INTEGRATION) is carried in float64, also by a float32 program, so that an
episode has C's own bits.
"""

import functools
import hashlib
from collections.abc import Sequence
from typing import Any, cast

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from brax.envs.base import Env, State

from mjx_reinforce.engine.base import MjModel, observation_size
from mjx_reinforce.engine.contract import check_shape
from mjx_reinforce.engine.cpu.host import HostCall, HostFunction, Spec
from mjx_reinforce.envs import models
from mjx_reinforce.envs.c_mujoco.fields import fields_read, spec_of
from mjx_reinforce.envs.c_mujoco.simulations import Simulations
from mjx_reinforce.envs.models import Fields
from mjx_reinforce.envs.outcomes import check_control, check_outcome, check_push
from mjx_reinforce.envs.starts import MOCAP, start_shapes
from mjx_reinforce.envs.state import (
    Before,
    Physics,
    first_state,
    next_state,
    physics_state,
    recollect_start,
    recollect_step,
)

#: MuJoCo's own names; it is a C extension without stubs.
_C: Any = mujoco
#: The field of ``Physics.carried`` with all of MuJoCo's state, in halves of float64.
STATE = "mjtState"


class InBatch(Env):
    """A ``MujocoEnv`` whose physics steps C MuJoCo computes, for any number of episodes at once.

    Its ``reset`` and ``step`` are those of the task: pure functions, to be mapped by ``jax.vmap``.
    """

    def __init__(self, env: Any):
        """Finds out which fields of mjData the task reads; simulates nothing.

        Raises:
          ValueError: the task reads what C MuJoCo has in no array of a fixed size.
        """
        self.env = env
        self.max_episode_steps = env.max_episode_steps
        self.reward_threshold = env.reward_threshold
        self.action_space = env.action_space
        # Those of mocap bodies are not always as the model has them.
        self._carried = env.carried
        if env.mj_model.nmocap:
            self._carried = (*env.carried, *MOCAP)
        self._episode = jax.eval_shape(env.draw, jax.random.key(0))[0]
        randomized = [name for name in models.RANDOM if name in self._episode]
        # Not kept: of some models the arena alone has gigabytes.
        data = _C.MjData(env.mj_model)
        fields = self._fields_read(data)
        self._specs = {name: spec_of(data, name) for name in (*fields, *start_shapes(env.mj_model))}
        self._constants = {
            name: np.array(getattr(data, name), spec_of(data, name).dtype)
            for name in models.CONSTANT
        }
        self._simulations = Simulations(
            models.c_model(env.mj_model),
            fields,
            randomized,
            contact_forces=env.contact_forces,
            pushes=env.has_pushes,
        )
        self._digest = models.digest(env.mj_model)
        self._step_call = self._host_step()

    def _fields_read(self, data: Any) -> list[str]:
        """Returns the fields of mjData that the task reads, and those that an env step hands on."""
        names = (*models.CARRIED, *models.CONSTANT, *self._carried)
        specs = {name: spec_of(data, name) for name in names}
        start_fields = {name: jnp.zeros(spec.shape, spec.dtype) for name, spec in specs.items()}
        names_read = fields_read(self.env, data, start_fields, self._episode)
        return sorted({*names_read, *models.CARRIED, *self._carried})

    def _host_start(self, names: tuple[str, ...], settle_steps: int) -> HostCall:
        """Returns the operation that begins an episode, given fields of mjData by their names."""
        start = functools.partial(self._simulations.start, names, settle_steps)
        inputs = [self._specs[name] for name in names]
        options = (names, settle_steps)
        return self._host_call("start", options, start, [Spec((), bool), *inputs])

    def _host_step(self) -> HostCall:
        """Returns the operation that advances an episode."""
        num_steps = self.env.frame_skip
        step = functools.partial(self._simulations.step, num_steps)
        inputs = [Spec((), bool), self._state_spec(), self._specs["ctrl"]]
        if self.env.has_pushes:
            inputs.append(self._specs["qvel"])
        return self._host_call("step", num_steps, step, inputs)

    def _host_call(
        self, kind: str, options: object, function: HostFunction, inputs: Sequence[Spec]
    ) -> HostCall:
        """Returns an operation of the simulations.

        Args:
          kind: part of its name.
          options: what it depends on besides the model, the task's fields, and those at random.
          function: what it calls.
          inputs: what it reads besides the fields at random, which come last.
        """
        simulations = self._simulations
        episode = self._episode
        random = [Spec(episode[x].shape, episode[x].dtype) for x in simulations.randomized]
        field_specs = [self._specs[name] for name in simulations.fields]
        results = [self._state_spec(), Spec((), bool), *field_specs]
        key = hashlib.sha256(self._digest.encode())
        dependencies = (
            simulations.fields,
            simulations.randomized,
            simulations.contact_forces,
            simulations.pushes,
            options,
            results,
        )
        key.update(repr(dependencies).encode())
        return HostCall(f"{kind}_{key.hexdigest()}", function, [*inputs, *random], results)

    def _state_spec(self) -> Spec:
        """Returns the shape and dtype of MuJoCo's state, in halves of float64."""
        return Spec((2 * self._simulations.state_size,), np.uint32)

    def reset(self, rng: jax.Array) -> State:
        """Returns the start of an episode; consumes the key."""
        return self.reset_where(rng, jnp.array(True))

    def reset_where(self, rng: jax.Array, is_used: jax.Array) -> State:
        """Does as ``reset`` where an episode is to begin []; else what it returns means nothing."""
        memory_rng, draw_rng = self.env.split_rng(rng)
        episode, start = self.env.draw(draw_rng)
        # As many simulations begin as there are keys, also where nothing is drawn: the batch that
        # steps them is the one that knows which of their bodies sleep.
        words = jax.random.key_data(rng)
        is_used &= jnp.all(words == words)
        return self.begin(start, episode, memory_rng, is_used, self.env.settle_steps)

    def set_state(
        self,
        qpos: jax.Array,
        qvel: jax.Array,
        episode: Fields | None = None,
        rng: jax.Array | None = None,
        **fields: jax.Array,
    ) -> State:
        """Returns the state at positions [nq] and velocities [nv], as ``MujocoEnv.set_state``."""
        start = {"qpos": qpos, "qvel": qvel, **fields}
        return self.begin(start, episode or {}, rng, jnp.array(True), settle_steps=0)

    def begin(
        self,
        start: Fields,
        episode: Fields,
        rng: jax.Array | None,
        is_used: jax.Array,
        settle_steps: int,
    ) -> State:
        """Returns the state of an episode that starts with fields of mjData.

        Args:
          start: the fields.
          episode: what ``randomize`` returned.
          rng: the key of the episode's memory; consumed.
          is_used: [] whether an episode begins; else what it returns means nothing.
          settle_steps: physics steps before it begins.
        """
        begin = self._host_start(tuple(start), settle_steps)
        start_fields = [jnp.asarray(x, float) for x in start.values()]
        results = begin(is_used, *start_fields, *self._model_fields(episode))
        view, carried, _ = self._simulated(results, episode)
        recollection = recollect_start(self.env, rng, view)
        physics = physics_state(self.env, view, {}, carried, recollection)
        return first_state(self.env, physics, self._before(physics), view)

    def step(self, state: State, action: jax.Array) -> State:
        """Returns the state one env step later under ``action`` [A].

        The reward is NaN where C MuJoCo has begun again, or has left something out.
        """
        return self.step_where(state, action, jnp.array(True))

    def step_unfinished(self, state: State, action: jax.Array) -> State:
        """Does as ``step``; what it returns of an episode that was over means nothing."""
        is_running = (state.done == 0) & jnp.isfinite(state.reward)
        return self.step_where(state, action, is_running)

    def step_where(self, state: State, action: jax.Array, is_used: jax.Array) -> State:
        """Does as ``step`` where an episode goes on []; else what it returns means nothing."""
        check_shape("the action", action, (self.action_size,))
        before = cast(Physics, state.pipeline_state)
        name = type(self.env).__name__
        before_view = self._before(before)
        actuated = self.env.actuate(before_view, action)
        control = check_control(name, actuated, action, self.mj_model.nu)
        control = jnp.asarray(control, jnp.result_type(float))
        inputs = [before.carried[STATE], control]
        if self.env.has_pushes:
            inputs.append(check_push(name, self.env.push(before_view), self.mj_model.nv))
        results = self._step_call(is_used, *inputs, *self._model_fields(before.episode))
        view, carried, sound = self._simulated(results, before.episode)
        recollection = recollect_step(self.env, before, view, action)
        physics = physics_state(self.env, view, {}, carried, recollection)
        outcome = check_outcome(name, self.env.outcome(before_view, view, action))
        return next_state(self.env, state, physics, view, outcome, sound)

    def _model_fields(self, episode: Fields) -> list[jax.Array]:
        """Returns the fields of the model that an episode has of its own."""
        return [episode[name] for name in self._simulations.randomized]

    def _simulated(
        self, results: Sequence[jax.Array], episode: Fields
    ) -> tuple[Before, Fields, jax.Array]:
        """Returns what the task reads, what is carried besides, and whether it is sound []."""
        state, sound, *values = results
        fields = dict(zip(self._simulations.fields, values, strict=True))
        carried = {name: fields[name] for name in self._carried} | {STATE: state}
        return Before(fields, self.env.mj_model, episode), carried, sound

    def _before(self, state: Physics) -> Before:
        """Returns what a task knows of the start of an env step."""
        constant = {name: jnp.asarray(value) for name, value in self._constants.items()}
        fields = constant | state.carried | models.fields_of(state, models.CARRIED)
        return Before(fields, self.env.mj_model, state.episode, state.memory)

    @property
    def mj_model(self) -> MjModel:
        """The model."""
        return self.env.mj_model

    @property
    def dt(self) -> float:
        """The duration of one env step (s)."""
        return self.env.dt

    @property
    def observation_size(self) -> int:
        """The number O of entries that a policy sees."""
        return observation_size(self)

    @property
    def action_size(self) -> int:
        """The number A of entries of an action."""
        return self.env.action_size

    @property
    def backend(self) -> str:
        """The physics engine, for brax's interface."""
        return "mujoco"

    def __repr__(self) -> str:
        return repr(self.env)
