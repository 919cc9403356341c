"""Simulations that ``mujoco.batch.Batch`` steps, many at once on all cores of the CPU."""

import contextlib
import functools
import logging
import threading
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import mujoco
import numpy as np
from mujoco.batch import Batch, SimulationError

from mjx_reinforce.engine.base import MjModel
from mjx_reinforce.engine.memory import gigabytes, host_memory, num_cores

#: MuJoCo's own names; it is a C extension without stubs.
_C: Any = mujoco
_LOG = logging.getLogger(__name__)
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
#: What C computes after a step by ``mj_rnePostConstraint``, which ``mj_step`` does not call.
_CONTACT_FORCES = ("cacc", "cfrc_ext", "cfrc_int")
#: XLA may make several calls at once. A batch is used by one thread at a time, and has all cores;
#: what MuJoCo prints is a setting of the process.
_LOCK = threading.Lock()
#: Simulations of models that need an MjData each keep it for this many sizes of a batch.
_KEPT_BATCHES = 3


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
