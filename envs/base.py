"""A task on a MuJoCo model: what its class defines, and when ``reset`` and ``step`` call it.

The physics between these calls is in ``dynamics``, or, by C MuJoCo, in ``c_mujoco``; what goes from
one env step to the next is in ``state``.
"""

import abc
import dataclasses
import functools
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
from brax.envs.base import Env, State
from mujoco import mjx  # pyright: ignore[reportAttributeAccessIssue] (a C extension)

from mjx_reinforce.engine.base import Box, PhysicsModel, is_kept_whole, observation_size
from mjx_reinforce.engine.checks import changed_fields, check_count, check_name
from mjx_reinforce.engine.contract import check_shape
from mjx_reinforce.engine.scalar import prune
from mjx_reinforce.envs import derived, models, refusals
from mjx_reinforce.envs.c_mujoco import in_batch
from mjx_reinforce.envs.dynamics import Dynamics
from mjx_reinforce.envs.models import Fields
from mjx_reinforce.envs.outcomes import (
    check_centers,
    check_control,
    check_episode,
    check_outcome,
    check_push,
    check_start,
)
from mjx_reinforce.envs.settings import EpisodeSettings, build_settings
from mjx_reinforce.envs.starts import at_rest, key_frame, mocap_poses, start_shapes
from mjx_reinforce.envs.state import (
    Before,
    before_of,
    first_state,
    next_state,
    physics_state,
    recollect_start,
    recollect_step,
)
from mjx_reinforce.envs.views import View


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
    _has_checked_centers = False

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
        self._dynamics = Dynamics(self.mj_model, self.settings.xml_file)
        self.refusal = self._dynamics.refusal
        self._start = jax.jit(prune(self._start_state))
        self._settled_start = jax.jit(prune(functools.partial(self._start_state, settles=True)))
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
            is_used = jnp.array(True)
            return self._in_c_mujoco.begin(start, episode, memory_rng, is_used, self.settle_steps)
        if is_kept_whole():
            return self._start_state(start, episode, memory_rng, settles=True)
        return self._settled_start(start, episode, memory_rng)

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

    def draw(self, rng: jax.Array) -> tuple[Fields, Fields]:
        """Returns what ``randomize`` and ``initial`` return, checked; consumes the key.

        The start is by mjData's names, "qpos" and "qvel" among them.
        """
        name = type(self).__name__
        episode = {}
        # A task that draws nothing consumes no key for it, so that its starts are those of ``rng``.
        if type(self).randomize is not MujocoEnv.randomize:
            key, rng = jax.random.split(rng)
            episode = check_episode(name, self.randomize(key), self.mj_model)
            # Its draws compile as long as the task's own, which is asked dozens of times.
            if "body_ipos" in episode and not self._has_checked_centers:
                check_centers(name, self.randomize, self.mj_model.body_ipos, self.mj_model)
                self._has_checked_centers = True
        start = self.initial(rng)
        if isinstance(start, str):
            start = self.key_frame(start)
        fields = check_start(name, start, start_shapes(self.mj_model))
        return episode, at_rest(self.mj_model) | fields

    def set_state(
        self,
        qpos: jax.Array,
        qvel: jax.Array,
        episode: Fields | None = None,
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
        start = {"qpos": qpos, "qvel": qvel, **fields}
        for field, value in start.items():
            check_name("field of a start", field, shapes)
            check_shape(field, value, shapes[field])
        # What MJX refuses, C MuJoCo plays, whoever asks.
        if self._is_played_by_c():
            return self._in_c_mujoco.set_state(qpos, qvel, episode, rng, **fields)
        # Whether the physics stays whole is asked during tracing, and the jitted start may have
        # been traced where it does not.
        begin = self._start_state if is_kept_whole() else self._start
        return begin(start, episode or {}, rng)

    @property
    def model(self) -> mjx.Model:
        """MJX's version of the model.

        Raises:
          UnsupportedError: MJX cannot simulate it as C MuJoCo does; the message has every reason.
        """
        return self._dynamics.model

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

    def _start_state(
        self, start: Fields, episode: Fields, rng: jax.Array | None, *, settles: bool = False
    ) -> State:
        """Returns the state from one forward pass, or after ``settle_steps`` physics steps.

        Args:
          start: what the episode starts with, by mjData's names.
          episode: what ``randomize`` returned.
          rng: the key of the episode's memory; consumed.
          settles: whether the physics steps are made.
        """
        start_data = models.make_data(self.mj_model).replace(**start)
        constants = derived.constants(self.mj_model, episode)
        drawn = models.replaced(episode) | constants
        if settles:
            data = self._dynamics.settled(start_data, drawn, self.settle_steps)
        else:
            data = self._dynamics.start(start_data, drawn, self.physics_model())
        view = View(data, self.mj_model, episode)
        recollection = recollect_start(self, rng, view)
        physics = physics_state(self, view, constants, mocap_poses(start), recollection)
        return first_state(self, physics, before_of(self.mj_model, physics, start_data), view)

    def step(self, state: State, action: jax.Array) -> State:
        """Returns the state one env step later under ``action`` [A].

        The reward is NaN where C MuJoCo would have reset the simulation.
        """
        check_shape("the action", action, (self.action_size,))
        if self._is_played_by_c():
            return self._in_c_mujoco.step(state, action)
        before = cast(Any, state.pipeline_state)
        # All else in mjData follows from what is carried, or stays as the model has it.
        poses = mocap_poses(before.carried)
        carried = models.fields_of(before, models.CARRIED)
        data = models.make_data(self.mj_model).replace(**carried, **poses)
        before_view = before_of(self.mj_model, before, data)
        name = type(self).__name__
        control = check_control(name, self.actuate(before_view, action), action, self.mj_model.nu)
        data = data.replace(ctrl=jnp.asarray(control, data.ctrl.dtype))
        if self.has_pushes:
            push = check_push(name, self.push(before_view), self.mj_model.nv)
            data = data.replace(qvel=data.qvel + push)
        drawn = models.replaced(before.episode) | before.constants
        data, is_sound = self._dynamics.advance(
            data, drawn, self.physics_model(), contact_forces=self.contact_forces
        )
        view = View(data, self.mj_model, before.episode)
        recollection = recollect_step(self, before, view, action)
        outcome = check_outcome(name, self.outcome(before_view, view, action))
        physics = physics_state(self, view, before.constants, poses, recollection)
        return next_state(self, state, physics, view, outcome, is_sound)

    def physics_model(self) -> PhysicsModel:
        """Returns what an env step simulates, for engines that compute the physics themselves."""
        digest = " ".join([self._dynamics.digest, str(self.frame_skip), *self._random_fields])
        return PhysicsModel(self.mj_model, self.frame_skip, digest, self._random_fields)

    @functools.cached_property
    def _random_fields(self) -> tuple[str, ...]:
        """The names of the model's fields that ``randomize`` replaces."""
        if type(self).randomize is MujocoEnv.randomize:
            return ()
        name = type(self).__name__
        episode = jax.eval_shape(
            lambda: check_episode(name, self.randomize(jax.random.key(0)), self.mj_model)
        )
        return tuple(field for field in models.RANDOM if field in episode)

    def _is_played_by_c(self) -> bool:
        """Returns whether neither MJX nor the device code that asks simulates this model."""
        if self.refusal is None:
            return False
        # What settles is no part of the device code.
        has_kernel = is_kept_whole() and not self.settle_steps and self._dynamics.has_data
        return not (has_kernel and self._dynamics.is_in_device_code(self._random_fields))

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
