"""The physics of a model: traced with MJX, or one operation that device code computes.

Of a task this knows nothing: ``base`` has what one does before and after its physics.
"""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from mujoco import mjMAXVAL, mjx  # pyright: ignore[reportAttributeAccessIssue] (a C extension)

from mjx_reinforce.engine.base import MjModel, PhysicsModel, is_for_shapes, is_kept_whole
from mjx_reinforce.engine.physics import mjx_internals, sensors
from mjx_reinforce.engine.physics import step as physics
from mjx_reinforce.engine.physics.mjx_internals import Simulation
from mjx_reinforce.engine.scalar import whole
from mjx_reinforce.engine.team import last_pass, supported, tables
from mjx_reinforce.envs import models
from mjx_reinforce.envs.models import Fields
from mjx_reinforce.envs.refusals import UnsupportedError
from mjx_reinforce.envs.starts import MOCAP

#: A forward pass of C MuJoCo 4.0.
_forward = mjx_internals.fenced(physics.forward)


def _step_of(model: mjx.Model, forward: Callable[..., Any]) -> Callable[..., Any]:
    """Returns a physics step of a model, of which ``forward`` is the forward pass."""
    return functools.partial(physics.step, model, evaluate=forward)


def _is_sound(data: mjx.Data) -> jax.Array:
    """Returns whether C MuJoCo would go on [], and not reset: ``mj_checkPos``, ``Vel`` and ``Acc``.

    C looks at positions and velocities when the next step begins, which may be one step later.
    """
    arrays = data.qpos, data.qvel, data.qacc
    return functools.reduce(jnp.logical_and, (jnp.all(jnp.abs(x) <= mjMAXVAL) for x in arrays))


class Dynamics:
    """The physics of one model, of which an episode may have fields of its own.

    These are the arguments ``drawn``: the fields that the episode draws, and what MuJoCo derives
    from them (``derived.constants``).

    refusal: why MJX cannot simulate it as C MuJoCo does, every reason; None if it can
    """

    def __init__(self, mj_model: MjModel, source: models.ModelSource):
        """Converts the model to MJX.

        Args:
          mj_model: of ``models.load_model``.
          source: where it came from, for messages.

        Raises:
          BadEnvironmentError: MJX fails where it should not.
        """
        self._mj_model = mj_model
        self._model = None
        self.refusal = None
        try:
            self._model = models.to_mjx(mj_model, source)
        except UnsupportedError as error:  # C MuJoCo may play it
            self.refusal = str(error)
        # Why the device code cannot, by the names of the fields that are random. No
        # ``functools.cache``, which cloudpickle, and so Ray, could not send to another process.
        self._code_refusals: dict[tuple[str, ...], str | None] = {}

    @property
    def model(self) -> mjx.Model:
        """MJX's version of the model.

        Raises:
          UnsupportedError: MJX cannot simulate it as C MuJoCo does; the message has every reason.
        """
        if self._model is None:
            raise UnsupportedError(self.refusal)
        return self._model

    # Tracing the physics takes a second of Python; jit does it once.
    @functools.cached_property
    def forward(self) -> Callable[..., Any]:
        """The forward pass of the model as it is compiled: simulation -> simulation."""
        return jax.jit(functools.partial(_forward, self.model))

    @functools.cached_property
    def physics_step(self) -> Callable[..., Any]:
        """The physics step of the model as it is compiled: simulation -> simulation."""
        return jax.jit(_step_of(self.model, self.forward))

    @functools.cached_property
    def digest(self) -> str:
        """The model's hash, computed once: with large meshes that takes long, each trace asks."""
        return models.digest(self._mj_model)

    @functools.cached_property
    def has_data(self) -> bool:
        """Whether MJX has a simulation of the model, which it need not be able to step."""
        return models.has_data(self._mj_model)

    def is_in_device_code(self, random: tuple[str, ...]) -> bool:
        """Returns whether the device code has the model and the fields of it that are random."""
        if random not in self._code_refusals:
            self._code_refusals[random] = supported.why(self._mj_model, random)
        return self._code_refusals[random] is None

    def start(self, data: mjx.Data, drawn: Fields, simulated: PhysicsModel) -> Any:
        """Returns the simulation at the start of an episode, by one forward pass.

        Args:
          data: positions, velocities and all else that the episode starts with.
          drawn: the fields of the model that the episode has of its own.
          simulated: what an env step simulates.
        """
        if self._stays_whole(drawn, simulated):
            return self._whole("start", data, drawn, simulated)[0]
        forward, _ = self._passes(drawn)
        # MJX normalizes quaternions in qpos itself; MuJoCo does so when it steps.
        return physics.like(forward(data).replace(qpos=data.qpos), data)

    def settled(self, data: mjx.Data, drawn: Fields, num_steps: int) -> mjx.Data:
        """Returns the simulation after physics steps that come before an episode, its time 0.

        A kernel of teams has the physics of env steps alone: what settles is always traced.
        """
        forward, physics_step = self._passes(drawn)
        data = physics.like(forward(data), data)

        def settle(_: int, data: mjx.Data) -> mjx.Data:
            """Makes one physics step."""
            return physics.like(physics_step(data), data)

        data = jax.lax.fori_loop(0, num_steps, settle, data)
        return data.replace(time=jnp.zeros_like(data.time))

    def advance(
        self, data: mjx.Data, drawn: Fields, simulated: PhysicsModel, *, contact_forces: bool
    ) -> tuple[Any, jax.Array]:
        """Returns the simulation after an env step's physics steps, and whether it is sound [].

        Args:
          data: the simulation before them.
          drawn: the fields of the model that the episode has of its own.
          simulated: what an env step simulates.
          contact_forces: whether the simulation is to have ``cfrc_ext``.
        """
        if self._stays_whole(drawn, simulated):
            return self._whole("physics", data, drawn, simulated)
        _, physics_step = self._passes(drawn)

        def advance(_: int, carry: tuple[mjx.Data, jax.Array]) -> tuple[mjx.Data, jax.Array]:
            """One physics step; sound until the first that C MuJoCo would not have made."""
            data, is_sound = carry
            data = physics.like(physics_step(data), data)
            return data, is_sound & _is_sound(data)

        carry = (data, jnp.array(True))
        data, is_sound = jax.lax.fori_loop(0, simulated.frame_skip, advance, carry)
        # Once an env step, as Gymnasium's ``do_simulation`` calls it after the last mj_step.
        if contact_forces:
            data = sensors.rne_postconstraint(self.model.replace(**drawn), data)
        return data, is_sound

    def _passes(self, drawn: Fields) -> tuple[Callable[..., Any], Callable[..., Any]]:
        """Returns the forward pass and the step of the model as it is in an episode."""
        if not drawn:
            return self.forward, self.physics_step
        # Not jitted: they close over this episode's fields, so no trace could be used again.
        model = self.model.replace(**drawn)
        forward = functools.partial(_forward, model)
        return forward, _step_of(model, forward)

    def _stays_whole(self, drawn: Fields, simulated: PhysicsModel) -> bool:
        """Returns whether the physics is to stay one operation, which device code computes."""
        fields = models.replaced(drawn)
        if not is_kept_whole() or not fields or is_for_shapes():
            return is_kept_whole()
        return fields.keys() <= {*simulated.random} and self.is_in_device_code(simulated.random)

    @functools.cached_property
    def _shown(self) -> Callable[..., Any]:
        # What contacts do is in the data already; of what MJX refuses, it knows all else.
        known = self._model or models.without_contacts(self._mj_model)

        def completed_data(drawn: Fields, data: mjx.Data, touch: jax.Array) -> Any:
            return last_pass.completed_data(self._mj_model, known.replace(**drawn), data, touch)

        return jax.jit(completed_data)

    def _whole(
        self, name: str, start: mjx.Data, drawn: Fields, simulated: PhysicsModel
    ) -> tuple[Any, jax.Array]:
        """Returns what an operation of the device code makes of a simulation; whether it is sound.

        Args:
          name: "physics", the steps of an env step, or "start", a forward pass.
          start: the simulation before it.
          drawn: the fields of the model that the episode has of its own.
          simulated: what an env step simulates.
        """
        paths, tree = jax.tree_util.tree_flatten_with_path(start)
        results = {jax.tree_util.keystr(path): leaf for path, leaf in paths}
        sound = jax.ShapeDtypeStruct((), bool)
        operands = [getattr(start, field) for field in ("ctrl", *models.CARRIED)]
        if (simulated.random or self._mj_model.nmocap) and self.is_in_device_code(simulated.random):
            numbers = drawn | models.fields_of(start, MOCAP)
            operands.append(tables.drawn_numbers(self._mj_model, simulated.random, numbers))
        touch = jnp.zeros(len(last_pass.touch_sensors(self._mj_model)), start.qpos.dtype)
        last = {"pass_qpos": start.qpos, "pass_qvel": start.qvel, "pass_qacc": start.qacc}
        last |= {"touch": touch, "sound": sound}
        outputs = whole(name, results | last, *operands, model=simulated.digest)
        # In the order of ``results``, which is that of the tree's leaves.
        *leaves, qpos, qvel, qacc, touch, is_sound = outputs.values()
        data = tree.unflatten(leaves).replace(**models.fields_of(start, models.CONSTANT))
        last_data = start.replace(qpos=qpos, qvel=qvel, qacc=qacc)
        last_data = mjx_internals.with_fields(last_data, cfrc_ext=Simulation(data).cfrc_ext)

        def complete() -> mjx.Data:
            """Computes the rest; MJX has to know the model only where the task reads of that."""
            return self._shown(drawn, last_data, touch)

        return last_pass.Completed(self._mj_model, data, complete), is_sound
