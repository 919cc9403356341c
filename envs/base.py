"""What every MuJoCo task shares: the model, the physics of one env step, the state."""

import abc
import dataclasses
import functools
from collections.abc import Callable
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
from brax.envs.base import Env, State
from mujoco import mjMAXVAL, mjx  # pyright: ignore[reportAttributeAccessIssue] (a C extension)

from mjx_reinforce.engine.base import (
    Box,
    PhysicsModel,
    is_kept_whole,
    observation_size,
)
from mjx_reinforce.engine.checks import changed_fields, check_count, check_name, check_number
from mjx_reinforce.engine.contract import check_shape
from mjx_reinforce.engine.physics import mjx_internals, sensors
from mjx_reinforce.engine.physics import step as physics
from mjx_reinforce.engine.physics.mjx_internals import Simulation
from mjx_reinforce.engine.scalar import prune, whole
from mjx_reinforce.engine.team import last_pass, supported, tables
from mjx_reinforce.envs import derived, models, refusals
from mjx_reinforce.envs.c_mujoco import in_batch
from mjx_reinforce.envs.outcomes import (
    check_centers,
    check_control,
    check_episode,
    check_outcome,
    check_push,
    check_start,
)
from mjx_reinforce.envs.settings import EpisodeSettings, build_settings
from mjx_reinforce.envs.starts import MOCAP, at_rest, key_frame, start_shapes
from mjx_reinforce.envs.state import (
    Before,
    Physics,
    Recollection,
    observed,
    recollect_start,
    recollect_step,
)
from mjx_reinforce.envs.views import View

#: A forward pass of C MuJoCo 4.0.
_forward = mjx_internals.fenced(physics.forward)


def _step_of(model: mjx.Model, forward: Callable[..., Any]) -> Callable[..., Any]:
    """Returns a physics step of a model, of which ``forward`` is the forward pass."""
    return functools.partial(physics.step, model, evaluate=forward)


def _carried(state: "Physics | mjx.Data") -> dict[str, jax.Array]:
    """Returns what MuJoCo carries from step to step, of a state or a simulation."""
    return {name: getattr(state, name) for name in models.CARRIED}


def _constant(start: mjx.Data) -> dict[str, jax.Array]:
    """Returns what no physics step changes of a simulation."""
    return {name: getattr(start, name) for name in models.CONSTANT}


def _mocap(fields: dict[str, jax.Array]) -> dict[str, jax.Array]:
    """Returns the poses of mocap bodies among fields of a start, or of what is carried."""
    return {name: fields[name] for name in MOCAP if name in fields}


def _is_sound(data: mjx.Data) -> jax.Array:
    """Returns whether C MuJoCo would go on [], and not reset: ``mj_checkPos``, ``Vel`` and ``Acc``.

    C looks at positions and velocities when the next step begins, which may be one step later.
    """
    arrays = data.qpos, data.qvel, data.qacc
    return functools.reduce(jnp.logical_and, (jnp.all(jnp.abs(x) <= mjMAXVAL) for x in arrays))


class MujocoEnv(Env):
    """A task on one MuJoCo model, stepped by MJX as Gymnasium steps MuJoCo.

    One env step is ``frame_skip`` physics steps under the same control, by default the action. It
    is not clipped here: MuJoCo clamps it inside the actuator
    (gymnasium/envs/mujoco/mujoco_env.py, ``do_simulation``). Truncation is the
    trainer's: ``max_episode_steps`` says when.

    Subclasses define ``initial`` and ``outcome``, and read their arguments from ``settings``.
    """

    @dataclasses.dataclass(frozen=True, kw_only=True)
    class Settings(EpisodeSettings):
        """Arguments of every task on a MuJoCo model."""

        xml_file: str | models.MjSpec | models.MjModel
        """The model: a file of this package's assets, or a path with a folder in it; or an
        ``mujoco.MjSpec`` or ``mujoco.MjModel``, which is copied."""
        frame_skip: int
        """Physics steps an env step; the model says how many seconds a physics step lasts."""

        def __post_init__(self):
            """Raises ValueError for a value that is out of its range."""
            super().__post_init__()
            check_count("frame_skip", self.frame_skip)

    settings: Settings
    #: Fields of mjData that ``outcome`` reads of ``before`` besides time, qpos, qvel and act. What
    #: MuJoCo computes from these is up to one physics step older, as in Gymnasium.
    carried: tuple[str, ...] = ()
    #: Whether ``outcome`` or ``observe`` reads ``cfrc_ext``, which is zero at the start of an
    #: episode, as in Gymnasium.
    contact_forces = False
    #: How many observations a policy sees: the last ones, the oldest first, one after the other. At
    #: the start of an episode all are the first. A policy that runs elsewhere keeps them itself.
    frames: int = 1
    #: Physics steps that an episode makes before it begins, under the controls of its start; its
    #: time is then 0.
    settle_steps: int = 0
    #: What ``actuate`` adds to the controls at each env step of a period [P, nu], if it does that:
    #: files of ``export --env`` add it, too. ``parts.gait`` makes one, ``parts.cyclic`` reads it.
    gait: np.ndarray | None = None

    def __init__(self, **arguments: object):
        """Compiles the model.

        Args:
          **arguments: the fields of the class's ``Settings``.

        Raises:
          ValueError: an argument is unknown or out of its range, or MJX cannot run the model.
        """
        self.settings = build_settings(self, arguments)
        self.frame_skip = self.settings.frame_skip
        self.max_episode_steps = self.settings.max_episode_steps
        self.reward_threshold = self.settings.reward_threshold
        self.mj_model = models.load_model(self.settings.xml_file)
        try:
            self._model = models.to_mjx(self.mj_model, self.settings.xml_file)
            self.refusal = None
        except refusals.UnsupportedError as error:  # C MuJoCo may play it
            self._model = None
            self.refusal = str(error)
        self._start = jax.jit(prune(self._forward_state))
        self._settled_start = jax.jit(prune(self._settled_state))
        # A range that is written without a limit counts for nothing in MuJoCo.
        low, high = np.array(self.mj_model.actuator_ctrlrange).T
        is_limited = np.array(self.mj_model.actuator_ctrllimited, bool)
        self.action_space = Box(
            np.where(is_limited, low, -np.inf), np.where(is_limited, high, np.inf)
        )

    @abc.abstractmethod
    def initial(self, rng: jax.Array) -> tuple[jax.Array, jax.Array] | dict[str, jax.Array] | str:
        """Draws the start of an episode; consumes the key.

        Returns:
          qpos [nq] and qvel [nv]; or fields of mjData by their names: "qpos", "qvel", "act" [na],
          "ctrl" [nu], "mocap_pos" [nmocap, 3] and "mocap_quat" [nmocap, 4]; or the name of a key
          frame, for all of it but its time. What is missing is as the model has it. Poses of mocap
          bodies hold for the episode.
        """

    @abc.abstractmethod
    def outcome(
        self, before: Before, data: View, action: jax.Array
    ) -> tuple[float | jax.Array, bool | jax.Array, dict[str, Any]]:
        """Returns the reward [], whether the episode terminated [], and the reward's terms.

        Args:
          before: the simulation at the start of the env step. It has time, qpos, qvel, act, and
            the fields in ``carried``: "ctrl" there is what was applied in the env step before.
          data: the simulation after the env step; it has every field of mjData, parts by their
            names, as ``data.site("tip").xpos`` (see ``views.Named``), and ``data.episode``.
          action: [A] as the policy gave it.
        """

    def control(self, action: jax.Array) -> jax.Array:
        """Returns the controls [nu] that an action [A] applies (ctrl); by default the action.

        With ``self.home + self.scale * action``, and an ``action_space`` of [-1, 1], a policy acts
        around a pose. Actions may have another size than controls: that of the ``action_space``.
        """
        return action

    def key_frame(self, name: str | int) -> dict[str, jax.Array]:
        """Returns a key frame by its name or number, all but its time, as ``initial`` may return.

        Raises:
          ValueError: the model has no such key frame.
        """
        return key_frame(self.mj_model, name)

    def randomize(self, rng: jax.Array) -> dict[str, Any]:
        """Draws what differs from episode to episode; by default nothing. Consumes the key.

        Returns:
          Numbers and arrays by name, such as a goal or a command, which ``outcome`` and ``observe``
          read as ``data.episode["goal"]``. Those with a name of ``models.RANDOM``, such as
          ``geom_friction`` [ngeom, 3] or ``body_mass`` [nbody], take the place of that field of
          the model in this episode. What MuJoCo derives from them follows in every engine, as by
          ``mj_setConst``: how soft contacts, limits, friction losses and equalities are, by what
          muscles scale, and where cameras follow (``derived.constants``). As there, a servo with
          dampratio keeps the damping of the compiled model, and a muscle keeps its
          ``actuator_lengthrange``. To move the center of mass (``body_ipos``) of a body whose frame
          is there, write ``<body simple="false">``; else this raises ``UnsupportedError``.
        """
        return {}

    def memory(self, rng: jax.Array, data: View) -> dict[str, Any]:
        """Draws what an episode remembers at its start; by default nothing. Consumes the key.

        Args:
          rng: one key an episode.
          data: the simulation at the start, with ``data.episode``.

        Returns:
          Numbers and arrays by name, which change from env step to env step, such as the last
          actions, a command, or the noise of a step. ``actuate`` and ``push`` read them as
          ``before.memory["command"]``, ``observe`` as ``data.memory["command"]``, and ``outcome``
          as both.
        """
        return {}

    def remember(self, rng: jax.Array, data: View, action: jax.Array) -> dict[str, Any]:
        """Returns what an episode remembers after an env step; by default what it did before.

        This is before ``outcome`` and ``observe``, which see what it returns.

        Args:
          rng: one key an env step; consumed.
          data: the simulation after the env step; ``data.memory`` is that of before.
          action: [A] as the policy gave it.

        Returns:
          All that ``memory`` returns, in the same shapes and dtypes.
        """
        return data.memory

    def actuate(self, before: Before, action: jax.Array) -> jax.Array:
        """Returns the controls [nu] of an env step; by default ``control(action)``.

        For controls that depend on more than the action, such as one that comes late:
        ``self.control(before.memory["actions"][0])``.

        Args:
          before: the simulation at the start of the env step, as in ``outcome``.
          action: [A] as the policy gave it.
        """
        return self.control(action)

    def push(self, before: Before) -> jax.Array:
        """Returns the change of the velocities [nv] with which an env step begins (m/s, rad/s).

        By default there is none. ``before.qvel`` is that without it.
        """
        return jnp.zeros(self.mj_model.nv)

    def observe(self, data: View) -> jax.Array:
        """Returns the observation; by default qpos, then qvel.

        A policy sees the last ``frames`` of them [O], with the noise that they had.
        """
        return jnp.concatenate([data.qpos, data.qvel])

    def reset(self, rng: jax.Array) -> State:
        """Returns the start of an episode; consumes the key."""
        memory_rng, rng = self.split_rng(rng)
        episode, start = self.draw(rng)
        if not self.settle_steps:
            return self.set_state(**start, episode=episode, rng=memory_rng)
        if self._is_played_by_c():
            return self._in_c_mujoco.settled(start, episode, memory_rng, jnp.array(True))
        begin = self._settled_state if is_kept_whole() else self._settled_start
        return begin(start, episode, memory_rng)

    @property
    def has_memory(self) -> bool:
        """Whether the task's episodes remember something."""
        # Of ``remember`` alone, ``check_memory`` says that there is nothing to take the place of.
        task = type(self)
        methods = (MujocoEnv.memory, MujocoEnv.remember)
        return (task.memory, task.remember) != methods

    @property
    def has_pushes(self) -> bool:
        """Whether env steps of the task begin with other velocities than the last one left."""
        return type(self).push is not MujocoEnv.push

    def split_rng(self, rng: jax.Array) -> tuple[jax.Array | None, jax.Array]:
        """Returns the key of an episode's memory, and that for ``draw``; consumes the key."""
        # Starts of a task that remembers nothing are those of ``rng``.
        if not self.has_memory:
            return None, rng
        memory_rng, draw_rng = jax.random.split(rng)
        return memory_rng, draw_rng

    def draw(self, rng: jax.Array) -> tuple[dict[str, jax.Array], dict[str, jax.Array]]:
        """Returns what ``randomize`` and ``initial`` return, checked; consumes the key.

        The start is by mjData's names, "qpos" and "qvel" among them.
        """
        name = type(self).__name__
        episode = {}
        # A task that draws nothing consumes no key for it, so that its starts are those of ``rng``.
        if type(self).randomize is not MujocoEnv.randomize:
            key, rng = jax.random.split(rng)
            episode = check_episode(name, self.randomize(key), self.mj_model)
            if "body_ipos" in episode:
                check_centers(name, self.randomize, self.mj_model.body_ipos, self.mj_model)
        start = self.initial(rng)
        if isinstance(start, str):
            start = self.key_frame(start)
        fields = check_start(name, start, start_shapes(self.mj_model))
        return episode, at_rest(self.mj_model) | fields

    def set_state(
        self,
        qpos: jax.Array,
        qvel: jax.Array,
        episode: dict[str, jax.Array] | None = None,
        rng: jax.Array | None = None,
        **fields: jax.Array,
    ) -> State:
        """Returns the state at given positions and velocities, as Gymnasium's ``set_state``.

        Args:
          qpos: [nq] generalized positions (m, rad).
          qvel: [nv] generalized velocities (m/s, rad/s).
          episode: what the task's ``randomize`` returns, where it has one.
          rng: the key of the episode's memory; consumed. By default that of seed 0.
          **fields: what else ``initial`` may return, as ``ctrl`` [nu]; by default as the model has.
        """
        shapes = start_shapes(self.mj_model)
        for field, value in {"qpos": qpos, "qvel": qvel, **fields}.items():
            check_name("field of a start", field, shapes)
            check_shape(field, value, shapes[field])
        # What MJX refuses, C MuJoCo plays, whoever asks.
        if self._is_played_by_c():
            return self._in_c_mujoco.set_state(qpos, qvel, episode, rng, **fields)
        # Whether the physics stays whole is asked during tracing, and the jitted start may have
        # been traced where it does not.
        start = self._forward_state if is_kept_whole() else self._start
        return start(qpos, qvel, episode or {}, fields, rng)

    @property
    def model(self) -> mjx.Model:
        """MJX's version of the model.

        Raises:
          UnsupportedError: MJX cannot simulate it as C MuJoCo does; the message has every reason.
        """
        if self._model is None:
            raise refusals.UnsupportedError(self.refusal)
        return self._model

    # Tracing the physics takes a second of Python; jit does it once.
    @functools.cached_property
    def _forward(self) -> Callable[..., Any]:
        return jax.jit(functools.partial(_forward, self.model))

    @functools.cached_property
    def _physics_step(self) -> Callable[..., Any]:
        return jax.jit(_step_of(self.model, self._forward))

    def in_c_mujoco(self) -> Env:
        """Returns this task with its physics computed by C MuJoCo, on all cores of the CPU.

        Raises:
          ValueError: the task has a ``reset`` or ``step`` of its own, or reads what C MuJoCo has in
            no array of a fixed size.
        """
        task = type(self)
        if (task.reset, task.step) != (MujocoEnv.reset, MujocoEnv.step):
            raise ValueError(f"{task.__name__} has steps of its own, which MuJoCo does not know")
        return self._in_c_mujoco

    @functools.cached_property
    def _in_c_mujoco(self) -> in_batch.InBatch:
        return in_batch.InBatch(self)

    @functools.cached_property
    def best_in_c_mujoco(self) -> str | None:
        """Why nothing simulates this model faster than C MuJoCo, in a few words; None if else."""
        return refusals.best_in_c(self.mj_model)

    def _model_of(
        self, episode: dict[str, jax.Array], constants: dict[str, jax.Array]
    ) -> mjx.Model:
        """Returns the model as it is in an episode: drawn fields, and constants that follow."""
        return self.model.replace(**models.replaced(episode), **constants)

    def _physics_of(
        self, episode: dict[str, jax.Array], constants: dict[str, jax.Array]
    ) -> tuple[Any, Any]:
        """Returns the forward pass and the step of the model as it is in an episode."""
        if not models.replaced(episode):
            return self._forward, self._physics_step
        # Not jitted: they close over this episode's fields, so no trace could be used again.
        model = self._model_of(episode, constants)
        forward = functools.partial(_forward, model)
        return forward, _step_of(model, forward)

    def _forward_state(
        self,
        qpos: jax.Array,
        qvel: jax.Array,
        episode: dict[str, jax.Array],
        fields: dict[str, jax.Array],
        rng: jax.Array | None,
    ) -> State:
        """Returns the state at positions, velocities and other fields, from one forward pass."""
        start_data = models.make_data(self.mj_model).replace(qpos=qpos, qvel=qvel, **fields)
        constants = derived.constants(self.mj_model, episode)
        # MJX normalizes quaternions in qpos itself; MuJoCo does so when it steps.
        if self._stays_whole(episode):
            data, _ = self._whole("start", start_data, episode, constants)
        else:
            forward, _ = self._physics_of(episode, constants)
            data = physics.like(forward(start_data).replace(qpos=qpos), start_data)
        recollect = functools.partial(recollect_start, self, rng)
        return self._state_at(data, start_data, episode, constants, _mocap(fields), recollect)

    def _settled_state(
        self,
        start: dict[str, jax.Array],
        episode: dict[str, jax.Array],
        rng: jax.Array | None,
    ) -> State:
        """Returns the state after ``settle_steps`` physics steps from fields of a start."""
        # A kernel of teams has the physics of env steps alone: what settles is always traced.
        start_data = models.make_data(self.mj_model).replace(**start)
        constants = derived.constants(self.mj_model, episode)
        forward, physics_step = self._physics_of(episode, constants)
        data = physics.like(forward(start_data), start_data)

        def settle(_: int, data: mjx.Data) -> mjx.Data:
            """Makes one physics step."""
            return physics.like(physics_step(data), data)

        data = jax.lax.fori_loop(0, self.settle_steps, settle, data)
        data = data.replace(time=jnp.zeros_like(data.time))
        recollect = functools.partial(recollect_start, self, rng)
        return self._state_at(data, data, episode, constants, _mocap(start), recollect)

    def _state_at(
        self,
        data: Any,
        start_data: mjx.Data,
        episode: dict[str, jax.Array],
        constants: dict[str, jax.Array],
        mocap: dict[str, jax.Array],
        recollect: Callable[[View], Recollection],
    ) -> State:
        """Returns the state of an episode that begins with a simulation.

        Args:
          data: the simulation.
          start_data: what no physics changes of it.
          episode: what ``randomize`` returned.
          constants: what MuJoCo derives from that.
          mocap: the poses of mocap bodies that are not as the model has them.
          recollect: returns what the episode remembers at its start.
        """
        dtype = start_data.qpos.dtype
        view = View(data, self.mj_model, episode)
        state = self._physics(data, episode, constants, mocap, recollect(view))
        # No env step was made: the outcome says only which terms there are, each 0 so far. Wrappers
        # and loops need a state of one structure from the first step on.
        zero = jnp.zeros((), dtype)
        action = jnp.zeros(self.action_size, dtype)
        terms = self._outcome(self._before(state, start_data), view, action)[2]
        metrics = dict.fromkeys(terms, zero)
        return State(cast(Any, state), observed(self, view), zero, zero, metrics)

    def step(self, state: State, action: jax.Array) -> State:
        """Returns the state one env step later under ``action`` [A].

        The reward is NaN where C MuJoCo would have reset the simulation, see ``_is_sound``.
        """
        check_shape("the action", action, (self.action_size,))
        if self._is_played_by_c():
            return self._in_c_mujoco.step(state, action)
        before = cast(Any, state.pipeline_state)
        # All else in mjData follows from what is carried, or stays as the model has it.
        mocap = _mocap(before.carried)
        start_data = models.make_data(self.mj_model).replace(**_carried(before), **mocap)
        name = type(self).__name__
        before_view = self._before(before, start_data)
        control = check_control(name, self.actuate(before_view, action), action, self.mj_model.nu)
        start_data = start_data.replace(ctrl=jnp.asarray(control, start_data.ctrl.dtype))
        if self.has_pushes:
            push = check_push(name, self.push(before_view), self.mj_model.nv)
            start_data = start_data.replace(qvel=start_data.qvel + push)
        if self._stays_whole(before.episode):
            data, is_sound = self._whole("physics", start_data, before.episode, before.constants)
        else:
            data, is_sound = self._advance(before, start_data)
            # Once an env step, as Gymnasium's ``do_simulation`` calls it after the last mj_step.
            if self.contact_forces:
                model = self._model_of(before.episode, before.constants)
                data = sensors.rne_postconstraint(model, data)
        view = View(data, self.mj_model, before.episode)
        recollection = recollect_step(self, before, view, action)
        reward, terminated, terms = self._outcome(before_view, view, action)
        dtype = state.reward.dtype
        return dataclasses.replace(
            state,
            pipeline_state=self._physics(
                data, before.episode, before.constants, mocap, recollection
            ),
            obs=observed(self, view, cast(jax.Array, state.obs)),
            reward=jnp.where(is_sound, jnp.asarray(reward, dtype), jnp.nan),
            done=jnp.asarray(terminated, dtype),
            metrics=state.metrics | jax.tree.map(lambda x: jnp.asarray(x, dtype), terms),
        )

    def _advance(self, before: Physics, start: mjx.Data) -> tuple[mjx.Data, jax.Array]:
        """Returns the simulation after an env step's physics steps, and whether it is sound []."""
        _, physics_step = self._physics_of(before.episode, before.constants)

        def advance(_: int, carry: tuple[mjx.Data, jax.Array]) -> tuple[mjx.Data, jax.Array]:
            """One physics step; sound until the first that C MuJoCo would not have made."""
            data, is_sound = carry
            data = physics.like(physics_step(data), data)
            return data, is_sound & _is_sound(data)

        return jax.lax.fori_loop(0, self.frame_skip, advance, (start, jnp.array(True)))

    def physics_model(self) -> PhysicsModel:
        """Returns what an env step simulates, for engines that compute the physics themselves."""
        digest = " ".join([self._model_digest, str(self.frame_skip), *self._random_fields])
        return PhysicsModel(self.mj_model, self.frame_skip, digest, self._random_fields)

    @functools.cached_property
    def _model_digest(self) -> str:
        """The model's hash, computed once: with large meshes that takes long, each trace asks."""
        return models.digest(self.mj_model)

    @functools.cached_property
    def _random_fields(self) -> tuple[str, ...]:
        """The names of the model's fields that ``randomize`` replaces."""
        if type(self).randomize is MujocoEnv.randomize:
            return ()
        name = type(self).__name__
        episode = jax.eval_shape(
            lambda key: check_episode(name, self.randomize(key), self.mj_model), jax.random.key(0)
        )
        return tuple(field for field in models.RANDOM if field in episode)

    def _is_played_by_c(self) -> bool:
        """Returns whether neither MJX nor the device code that asks simulates this model."""
        # What settles is no part of the device code.
        has_kernel = is_kept_whole() and not self.settle_steps and self._has_device_code
        return self.refusal is not None and not has_kernel

    @functools.cached_property
    def _has_device_code(self) -> bool:
        """Whether teams of lanes simulate a model that MJX refuses, and MJX has its data."""
        return self._is_in_device_code and models.has_data(self.mj_model)

    @functools.cached_property
    def _is_in_device_code(self) -> bool:
        """Whether the device code has the model and the fields of it that are random."""
        return supported.why(self.mj_model, self._random_fields) is None

    def _stays_whole(self, episode: dict[str, jax.Array]) -> bool:
        """Returns whether the physics is to stay one operation, which device code computes."""
        fields = models.replaced(episode)
        if not is_kept_whole() or not fields:
            return is_kept_whole()
        return fields.keys() <= {*self._random_fields} and self._is_in_device_code

    @functools.cached_property
    def _shown(self) -> Callable[..., Any]:
        # What contacts do is in the data already; of what MJX refuses, it knows all else.
        known = self._model or models.without_contacts(self.mj_model)

        def completed_data(fields: dict[str, jax.Array], data: mjx.Data, touch: jax.Array) -> Any:
            model = known.replace(**fields)
            return last_pass.completed_data(self.mj_model, model, data, touch)

        return jax.jit(completed_data)

    def _whole(
        self,
        name: str,
        start: mjx.Data,
        episode: dict[str, jax.Array],
        constants: dict[str, jax.Array],
    ) -> tuple[Any, jax.Array]:
        """Returns what an operation of the device code makes of a simulation; whether it is sound.

        Args:
          name: "physics", the steps of an env step, or "start", a forward pass.
          start: the simulation before it.
          episode: what ``randomize`` returned.
          constants: what MuJoCo derives from that.
        """
        paths, tree = jax.tree_util.tree_flatten_with_path(start)
        results = {jax.tree_util.keystr(path): leaf for path, leaf in paths}
        sound = jax.ShapeDtypeStruct((), bool)
        operands = [getattr(start, field) for field in ("ctrl", *models.CARRIED)]
        fields = models.replaced(episode) | constants
        if (self._random_fields or self.mj_model.nmocap) and self._is_in_device_code:
            drawn = fields | {name: getattr(start, name) for name in MOCAP}
            operands.append(tables.drawn_numbers(self.mj_model, self._random_fields, drawn))
        digest = self.physics_model().digest
        touch = jnp.zeros(len(last_pass.touch_sensors(self.mj_model)), start.qpos.dtype)
        last = {"pass_qpos": start.qpos, "pass_qvel": start.qvel, "pass_qacc": start.qacc}
        last |= {"touch": touch, "sound": sound}
        outputs = whole(name, results | last, *operands, model=digest)
        # In the order of ``results``, which is that of the tree's leaves.
        *leaves, qpos, qvel, qacc, touch, is_sound = outputs.values()
        data = tree.unflatten(leaves).replace(**_constant(start))
        last_data = start.replace(qpos=qpos, qvel=qvel, qacc=qacc)
        last_data = mjx_internals.with_fields(last_data, cfrc_ext=Simulation(data).cfrc_ext)

        def complete() -> mjx.Data:
            """Computes the rest; MJX has to know the model only where the task reads of that."""
            return self._shown(fields, last_data, touch)

        return last_pass.Completed(self.mj_model, data, complete), is_sound

    def _before(self, state: Physics, start: mjx.Data) -> Before:
        """Returns what a task knows of the start of an env step."""
        # The state's own come last: a task may have asked to carry one of these, too.
        state_fields = _constant(start) | state.carried | _carried(state)
        return Before(state_fields, self.mj_model, state.episode, state.memory)

    def _outcome(self, before: Before, data: View, action: jax.Array) -> Any:
        """Returns what ``outcome`` returns, or raises ValueError where it is no outcome."""
        return check_outcome(type(self).__name__, self.outcome(before, data, action))

    def _physics(
        self,
        data: mjx.Data,
        episode: dict[str, jax.Array],
        constants: dict[str, jax.Array],
        mocap: dict[str, jax.Array],
        recollection: Recollection,
    ) -> Physics:
        """Returns what the next env step needs to know of a simulation.

        Args:
          data: the simulation.
          episode: what ``randomize`` returned.
          constants: what MuJoCo derives from that, see ``derived.constants``.
          mocap: the poses of mocap bodies that are not as the model has them.
          recollection: what the episode remembers.
        """
        # ``Simulation`` has MuJoCo's names, wherever MJX keeps the fields.
        carried_fields = {name: getattr(Simulation(data), name) for name in self.carried}
        return Physics(
            **_carried(data),
            carried=carried_fields | mocap,
            episode=episode,
            constants=constants,
            **recollection._asdict(),
        )

    @property
    def dt(self) -> float:
        """The duration of one env step (s)."""
        return self.frame_skip * self.mj_model.opt.timestep

    @property
    def observation_size(self) -> int:
        """The number O of entries that a policy sees, of all ``frames``."""
        return observation_size(self)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({changed_fields(self.settings)})"

    @property
    def action_size(self) -> int:
        """The number A of entries of an action: as the action space says, by default nu."""
        # A task may have replaced it by what is no such space, which ``check_environment`` names.
        space: Any = self.action_space
        shape = np.shape(getattr(space, "low", ()))
        return shape[0] if len(shape) == 1 else self.mj_model.nu

    @property
    def backend(self) -> str:
        """The physics engine, for brax's interface."""
        return "mjx"


class NearPose(MujocoEnv):
    """A task that starts near its model's pose."""

    @dataclasses.dataclass(frozen=True, kw_only=True)
    class Settings(MujocoEnv.Settings):
        """Arguments of these tasks."""

        max_episode_steps: int = 1000
        reset_noise_scale: float
        """Half the width of the start distribution where it is uniform, its standard deviation
        where it is normal (m, rad, m/s, rad/s)."""

        def __post_init__(self):
            """Raises ValueError for a value that is out of its range."""
            super().__post_init__()
            check_number("reset_noise_scale", self.reset_noise_scale)

    settings: Settings
    #: Whether the starting velocities are normal; otherwise they are uniform.
    normal_velocity = False

    def initial(self, rng):
        """Draws qpos [nq] around the model's pose and qvel [nv] around rest."""
        qpos_key, qvel_key = jax.random.split(rng)
        model = self.mj_model
        noise = self.settings.reset_noise_scale
        qpos = jax.random.uniform(qpos_key, (model.nq,), minval=-noise, maxval=noise)
        if self.normal_velocity:
            qvel = noise * jax.random.normal(qvel_key, (model.nv,))
        else:
            qvel = jax.random.uniform(qvel_key, (model.nv,), minval=-noise, maxval=noise)
        return jnp.asarray(model.qpos0, qpos.dtype) + qpos, qvel
