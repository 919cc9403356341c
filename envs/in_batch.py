"""A task whose physics C MuJoCo computes, many episodes at once on all cores of the CPU.

Observation, reward and end are traced and compiled as in ``base``; ``mujoco.batch.Batch`` computes
what lies between them, as one operation of the compiled program. What MuJoCo carries from step to
step (mjtState's mjSTATE_INTEGRATION) is carried in float64, also by a float32 program, so that an
episode has C's own bits.
"""

import contextlib
import dataclasses
import functools
import hashlib
import logging
import threading
from collections.abc import Callable, Iterator, Sequence
from typing import Any, cast

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from brax.envs.base import Env, State
from mujoco.batch import DATA_FIELDS, Batch, SimulationError

from mjx_reinforce.engine.base import MjModel, observation_size
from mjx_reinforce.engine.contract import check_shape
from mjx_reinforce.engine.cpu.host import HostCall, HostFunction, Spec
from mjx_reinforce.engine.memory import gigabytes, host_memory, num_cores
from mjx_reinforce.envs import models
from mjx_reinforce.envs.outcomes import check_control, check_outcome, check_push
from mjx_reinforce.envs.starts import MOCAP, start_shapes
from mjx_reinforce.envs.state import Before, Physics, observed, recollect_start, recollect_step
from mjx_reinforce.envs.views import Named

#: MuJoCo's own names; it is a C extension without stubs.
_C: Any = mujoco
_LOG = logging.getLogger(__name__)
#: The field of ``Physics.carried`` with all of MuJoCo's state, in halves of float64.
STATE = "mjtState"
#: Warnings after which an episode is not what its model says: C has begun again, has taken zero for
#: a control that is no number, or has left out contacts or constraints for which there was no room.
_BROKEN = (
    _C.mjtWarning.mjWARN_BADQPOS,
    _C.mjtWarning.mjWARN_BADQVEL,
    _C.mjtWarning.mjWARN_BADQACC,
    _C.mjtWarning.mjWARN_BADCTRL,
    _C.mjtWarning.mjWARN_CONTACTFULL,
    _C.mjtWarning.mjWARN_CNSTRFULL,
)
#: Fields that C keeps sparse, where MJX and Gymnasium's documentation have a matrix.
_SPARSE = ("M", "actuator_moment", "flexedge_J", "qLD", "ten_J")
#: What C computes after a step by ``mj_rnePostConstraint``, which ``mj_step`` does not call.
_CONTACT_FORCES = ("cacc", "cfrc_ext", "cfrc_int")
#: XLA may make several calls at once. A batch is used by one thread at a time, and has all cores;
#: what MuJoCo prints is a setting of the process.
_LOCK = threading.Lock()
#: Simulations of models that need an MjData each keep it for this many sizes of a batch.
_KEPT_BATCHES = 3


def shape_of(data: Any, name: str) -> tuple[int, ...]:
    """Returns the shape in which a task reads a field of mjData: rotations are [n, 3, 3].

    Args:
      data: an ``MjData``.
      name: of the field.

    Raises:
      ValueError: C MuJoCo has no such field of a fixed size.
    """
    if name in _SPARSE:
        raise ValueError(f"the task reads {name}, which C MuJoCo keeps as a sparse matrix")
    if name not in DATA_FIELDS:
        raise ValueError(f"the task reads {name}, which is not an array of mjData of a fixed size")
    shape = np.shape(getattr(data, name))
    return (shape[0], 3, 3) if name.endswith("mat") and shape[1:] == (9,) else shape


class FieldRecorder(Named):
    """An mjData of zeros that remembers which of its fields were read."""

    def __init__(self, data: Any, mj_model: MjModel):
        self.mj_model = mj_model
        self.episode = {}
        self.memory = {}
        self.data = data
        self.names: set[str] = set()

    def __getattr__(self, name: str) -> jax.Array:
        if name.startswith("__"):
            raise AttributeError(name)
        spec = spec_of(self.data, name)
        self.names.add(name)
        return jnp.zeros(spec.shape, spec.dtype)


def read_all(env: Any, before: Before, recorder: Any, action: jax.Array) -> None:
    """Calls the methods of a task that read a simulation; which fields these are is recorded.

    Args:
      env: the ``MujocoEnv``.
      before: the start of an env step.
      recorder: a ``FieldRecorder`` in place of the simulation after it.
      action: [A] of any numbers.
    """
    recollection = recollect_start(env, jax.random.key(0), recorder)
    before.memory = dict(recollection.memory)
    env.actuate(before, action)
    if env.has_pushes:
        env.push(before)
    recollect_step(env, recollection, recorder, action)
    env.outcome(before, recorder, action)
    env.observe(recorder)


def spec_of(data: Any, name: str) -> Spec:
    """Returns the shape and dtype in which a task reads a field of mjData: JAX's own of its kind.

    Raises:
      ValueError: C MuJoCo has no such field of a fixed size.
    """
    shape = shape_of(data, name)
    integers = np.issubdtype(np.asarray(getattr(data, name)).dtype, np.integer)
    return Spec(shape, jnp.result_type(int if integers else float))


@contextlib.contextmanager
def _without_messages() -> Iterator[None]:
    """Has MuJoCo print no warnings, and write none to MUJOCO_LOG.TXT in the user's folder.

    What they warn of ends an episode as broken, which the trainer counts and shows.
    """
    config = _C.MjLogConfig.get()
    silent_config = _C.MjLogConfig.get()
    silent_config.logto_console = False
    silent_config.logto_file = False
    silent_config.set()
    try:
        yield
    finally:
        config.set()


class Simulations:
    """Batches of simulations of one model, one for each number of episodes that play at once."""

    def __init__(
        self,
        model: MjModel,
        fields: Sequence[str],
        randomized: Sequence[str],
        *,
        contact_forces: bool = False,
        pushes: bool = False,
    ):
        """Simulates nothing yet.

        Args:
          model: the model.
          fields: of mjData, which a call returns.
          randomized: fields of the model that differ from episode to episode.
          contact_forces: whether ``step`` computes ``_CONTACT_FORCES`` as well.
          pushes: whether ``step`` adds something to the velocities.
        """
        self.model = model
        self.contact_forces = contact_forces
        self.pushes = pushes
        self.fields = tuple(fields)
        self.randomized = tuple(randomized)
        self.num_threads = num_cores()
        self._batches: dict[int, Batch] = {}

    @property
    def state_size(self) -> int:
        """The numbers of mjtState that MuJoCo carries from step to step."""
        return _C.mj_stateSize(self.model, _C.mjtState.mjSTATE_INTEGRATION)

    def start(
        self,
        names: Sequence[str],
        settle_steps: int,
        inputs: Sequence[np.ndarray],
        results: Sequence[np.ndarray],
    ) -> None:
        """Begins episodes: a forward pass at given positions, velocities and other fields.

        Args:
          names: of the fields that are not as the model has them.
          settle_steps: physics steps before the time is 0.
          inputs: which episodes begin [B], those fields [B, ...], the randomized fields of the
            model [B, ...].
          results: state [B, S], sound [B] and the fields [B, ...], which are written; those of an
            episode that does not begin have no meaning.
        """
        starting, *arrays = inputs
        start_fields = arrays[: len(names)]
        model_fields = arrays[len(names) :]
        ids = np.flatnonzero(starting)
        with _LOCK:
            batch = self._batch(len(starting))
            # Clears what an episode before has left: activations, warm starts, delays, warnings.
            batch.reset(ids=ids, stage=_C.mjtStage.mjSTAGE_NONE)
            warnings = self._warnings(batch)
            self._set_model(batch, model_fields, ids)
            for name, values in zip(names, start_fields, strict=True):
                batch.bind(name)[ids] = values[ids]
            failed = self._failed(batch, functools.partial(batch.forward, ids=ids))
            if settle_steps:
                settle = functools.partial(batch.step, ids=ids, nstep=settle_steps)
                failed |= self._failed(batch, settle)
                batch.bind("time")[ids] = 0
            self._write(batch, failed | (self._warnings(batch) > warnings), results)

    def step(
        self, num_steps: int, inputs: Sequence[np.ndarray], results: Sequence[np.ndarray]
    ) -> None:
        """Advances the episodes that run by some physics steps.

        Args:
          num_steps: physics steps, under the same control.
          inputs: which episodes run [B], state [B, S], control [B, nu], what is added to the
            velocities [B, nv] if something is, the randomized fields of the model.
          results: as of ``start``; those of an episode that does not run have no meaning.
        """
        running, state, control, *model_fields = inputs
        pushes = [model_fields.pop(0)] if self.pushes else []
        ids = np.flatnonzero(running)
        with _LOCK:
            batch = self._batch(len(state))
            if self._sleeps():
                _check_same(batch.state[ids], state.view(np.float64)[ids])
            # The rows say all that there is of a simulation: it may have been another before.
            batch.state[:] = state.view(np.float64)
            batch.bind("ctrl")[:] = control
            for push in pushes:
                batch.bind("qvel")[:] += push
            warnings = self._warnings(batch)
            self._set_model(batch, model_fields, ids)
            advance = functools.partial(batch.step, ids=ids, nstep=num_steps)
            failed = self._failed(batch, advance)
            self._write(batch, failed | (self._warnings(batch) > warnings), results)
            if self.contact_forces:
                self._write_contact_forces(batch, ids, results)

    def _batch(self, num_episodes: int) -> Batch:
        """Returns the batch of so many simulations."""
        if num_episodes not in self._batches:
            # The oldest goes. Training, evaluation and test each play a number of episodes.
            while len(self._batches) >= _KEPT_BATCHES:
                del self._batches[next(iter(self._batches))]
            self._check_memory(num_episodes)
            batch = Batch(
                self.model,
                num_episodes,
                nthread=min(self.num_threads, num_episodes),
                persistent=self._needs_own_data(),
            )
            # Before the first call: a field that is bound later is zero until the next.
            for name in self.fields:
                batch.bind(name)
            self._batches[num_episodes] = batch
        return self._batches[num_episodes]

    def _sleeps(self) -> bool:
        """Returns whether bodies may sleep: MuJoCo keeps which of them do outside of its state."""
        return bool(self.model.opt.enableflags & _C.mjtEnableBit.mjENBL_SLEEP)

    def _needs_own_data(self) -> bool:
        """Returns whether a simulation has something that its state does not say."""
        # Contact forces follow from all of mjData as the last step left it.
        return self._sleeps() or self.model.nplugin > 0 or self.contact_forces

    def _check_memory(self, num_episodes: int) -> None:
        """Raises ValueError where the arenas of so many simulations fit in no memory."""
        count = num_episodes if self._needs_own_data() else min(self.num_threads, num_episodes)
        num_bytes = count * (self.model.narena + _C.MjData(self.model).nbuffer)
        available = host_memory()
        if num_bytes > available:
            raise ValueError(
                f"{num_episodes:,} simulations need {gigabytes(num_bytes)}, and there are "
                f"{gigabytes(available)}; play fewer episodes at once, or give the model a smaller "
                '<size memory="..."/>'
            )

    def _set_model(self, batch: Batch, model_fields: Sequence[np.ndarray], ids: np.ndarray) -> None:
        """Gives simulations fields of the model of their own, and what follows from them."""
        changed = np.zeros(batch.nsim, bool)
        for name, values in zip(self.randomized, model_fields, strict=True):
            field = batch.expand(name)
            episode_values = values.reshape(field.shape).astype(field.dtype)
            differs = field[ids] != episode_values[ids]
            changed[ids] |= differs.any(axis=tuple(range(1, differs.ndim)))
            field[ids] = episode_values[ids]
        # It takes as long as a few steps, and an episode's model stays what it was when it began.
        if changed.any():
            batch.set_const(ids=np.flatnonzero(changed))

    def _failed(self, batch: Batch, compute: Callable[[], None]) -> np.ndarray:
        """Computes, and returns of which simulations MuJoCo gave up [B], as in a full arena."""
        try:
            with _without_messages():
                compute()
        except SimulationError as error:
            _LOG.warning("an episode ends as broken: %s", error)
        return np.asarray(batch.status) != 0

    def _warnings(self, batch: Batch) -> np.ndarray:
        """Returns how often each simulation has been warned of what breaks it [B]."""
        return batch.warning[:, [int(kind) for kind in _BROKEN], 1].sum(1)

    def _write(self, batch: Batch, broken: np.ndarray, results: Sequence[np.ndarray]) -> None:
        """Writes the state, whether it is sound, and the fields.

        Args:
          batch: the simulations.
          broken: [B] which of them are not what the model says.
          results: as of ``start``.
        """
        state, sound, *fields = results
        state.view(np.float64)[:] = batch.state
        sound[:] = ~broken
        for name in ("qpos", "qvel"):
            # C looks at these when the next step begins, MJX's engines look at once.
            sound &= (np.abs(batch.bind(name)) <= _C.mjMAXVAL).all(1)
        for name, field in zip(self.fields, fields, strict=True):
            field[:] = batch.bind(name).reshape(field.shape)

    def _write_contact_forces(
        self, batch: Batch, ids: np.ndarray, results: Sequence[np.ndarray]
    ) -> None:
        """Writes the contact forces of the simulations with these numbers; arguments as above."""
        fields = dict(zip(self.fields, results[2:], strict=True))
        names = [name for name in _CONTACT_FORCES if name in fields]
        model = self.model
        data = _C.MjData(model)
        for number in ids:
            if self.randomized:
                model = batch.get_model(int(number))
            batch.get_data(int(number), data)
            _C.mj_rnePostConstraint(model, data)
            for name in names:
                fields[name][number] = getattr(data, name)


def _check_same(left: np.ndarray, resumed: np.ndarray) -> None:
    """Raises ValueError unless episodes with bodies that sleep go on where a batch left them.

    Args:
      left: [N, S] the states in which the batch left them.
      resumed: [N, S] those from which they are to go on.
    """
    if left.tobytes() != resumed.tobytes():
        raise ValueError(
            "which bodies sleep is no part of MuJoCo's state, and other episodes were played in "
            "between, or these from an earlier state; play a batch of episodes from its start to "
            'its end before the next one, or remove <flag sleep="enable"/> from the model'
        )


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
            env.mj_model,
            fields,
            randomized,
            contact_forces=env.contact_forces,
            pushes=env.has_pushes,
        )
        self._digest = models.digest(env.mj_model)
        self._step_call = self._host_step()

    def _fields_read(self, data: Any) -> list[str]:
        """Returns the fields of mjData that the task reads, and those that an env step hands on."""
        recorder: Any = FieldRecorder(data, self.env.mj_model)

        def read(start_fields: dict[str, Any], episode: dict[str, Any], action: jax.Array) -> None:
            recorder.episode = episode
            read_all(self.env, Before(start_fields, self.env.mj_model, episode), recorder, action)

        names = (*models.CARRIED, *models.CONSTANT, *self._carried)
        specs = {name: spec_of(data, name) for name in names}
        start_fields = {name: jnp.zeros(spec.shape, spec.dtype) for name, spec in specs.items()}
        jax.eval_shape(read, start_fields, self._episode, jnp.zeros(self.env.action_size))
        return sorted({*recorder.names, *models.CARRIED, *self._carried})

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
        return self.settled(start, episode, memory_rng, is_used & jnp.all(words == words))

    def set_state(
        self,
        qpos: jax.Array,
        qvel: jax.Array,
        episode: dict[str, jax.Array] | None = None,
        rng: jax.Array | None = None,
        **fields: jax.Array,
    ) -> State:
        """Returns the state at positions [nq] and velocities [nv], as ``MujocoEnv.set_state``."""
        start = {"qpos": qpos, "qvel": qvel, **fields}
        return self._start(start, episode or {}, rng, jnp.array(True), settle_steps=0)

    def settled(
        self,
        start: dict[str, jax.Array],
        episode: dict[str, jax.Array],
        rng: jax.Array | None,
        is_used: jax.Array,
    ) -> State:
        """Returns the state after the task's ``settle_steps`` from fields of mjData.

        Args:
          start: the fields.
          episode: what ``randomize`` returned.
          rng: the key of the episode's memory; consumed.
          is_used: [] whether an episode begins; else what it returns means nothing.
        """
        return self._start(start, episode, rng, is_used, self.env.settle_steps)

    def _start(
        self,
        start: dict[str, jax.Array],
        episode: dict[str, jax.Array],
        rng: jax.Array | None,
        is_used: jax.Array,
        settle_steps: int,
    ) -> State:
        """Returns the state of an episode that starts with fields of mjData, where it is to []."""
        real = jnp.result_type(float)
        begin = self._host_start(tuple(start), settle_steps)
        start_fields = [jnp.asarray(x, real) for x in start.values()]
        results = begin(is_used, *start_fields, *self._model_fields(episode))
        physics, view, _ = self._simulated(results, episode)
        recollection = recollect_start(self.env, rng, view)
        physics = dataclasses.replace(physics, **recollection._asdict())
        zero = jnp.zeros((), real)
        action = jnp.zeros(self.action_size, real)
        terms = self._outcome(self._before(physics), view, action)[2]
        metrics = dict.fromkeys(terms, zero)
        return State(cast(Any, physics), observed(self.env, view), zero, zero, metrics)

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
        physics, view, sound = self._simulated(results, before.episode)
        recollection = recollect_step(self.env, before, view, action)
        physics = dataclasses.replace(physics, **recollection._asdict())
        reward, terminated, terms = self._outcome(before_view, view, action)
        dtype = state.reward.dtype
        return dataclasses.replace(
            state,
            pipeline_state=physics,
            obs=observed(self.env, view, cast(jax.Array, state.obs)),
            reward=jnp.where(sound, jnp.asarray(reward, dtype), jnp.nan),
            done=jnp.asarray(terminated, dtype),
            metrics=state.metrics | jax.tree.map(lambda x: jnp.asarray(x, dtype), terms),
        )

    def _model_fields(self, episode: dict[str, jax.Array]) -> list[jax.Array]:
        """Returns the fields of the model that an episode has of its own."""
        return [episode[name] for name in self._simulations.randomized]

    def _simulated(
        self, results: Sequence[jax.Array], episode: dict[str, jax.Array]
    ) -> tuple[Physics, Any, jax.Array]:
        """Returns what the next env step needs, what the task reads, and whether it is sound []."""
        state, sound, *values = results
        fields = dict(zip(self._simulations.fields, values, strict=True))
        carried = {name: fields[name] for name in self._carried} | {STATE: state}
        common: dict[str, Any] = {name: fields[name] for name in models.CARRIED}
        physics = Physics(**common, carried=carried, episode=episode, constants={})
        return physics, Before(fields, self.env.mj_model, episode), sound

    def _before(self, state: Physics) -> Before:
        """Returns what a task knows of the start of an env step."""
        constant = {name: jnp.asarray(value) for name, value in self._constants.items()}
        common = {name: getattr(state, name) for name in models.CARRIED}
        fields = constant | state.carried | common
        return Before(fields, self.env.mj_model, state.episode, state.memory)

    def _outcome(self, before: Before, view: Any, action: jax.Array) -> Any:
        """Returns what the task's ``outcome`` returns, checked."""
        return check_outcome(type(self.env).__name__, self.env.outcome(before, view, action))

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
