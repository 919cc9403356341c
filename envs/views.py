"""Parts of a simulation by their names in the model, such as ``data.site("tip")``."""

from typing import Any

import jax

from mjx_reinforce.engine.base import MjModel
from mjx_reinforce.engine.checks import check_name
from mjx_reinforce.engine.physics.mjx_internals import Simulation

#: Kind -> how many of it a model has, and what comes before the name of a field of mjData, such as
#: in ``site_xpos``; the fields of joints and sensors are found in other ways.
_KINDS = {
    "body": ("nbody", ""),
    "geom": ("ngeom", "geom_"),
    "site": ("nsite", "site_"),
    "camera": ("ncam", "cam_"),
    "tendon": ("ntendon", "ten_"),
    "actuator": ("nu", "actuator_"),
    "joint": ("njnt", ""),
    "sensor": ("nsensor", "sensor"),
}
#: Fields of mjData with a row for each joint; others that a joint has are those of its dofs.
_JOINT_FIELDS = ("xanchor", "xaxis")


class Part:
    """A body, joint, geom, ... of a simulation: its rows of the fields of mjData."""

    def __init__(self, data: Any, model: MjModel, kind: str, name: str):
        """Finds the part; raises ValueError for a name that the model has not."""
        size, self._prefix = _KINDS[kind]
        part_names = [getattr(model, kind)(i).name for i in range(getattr(model, size))]
        # A message lists the names that there are; parts without one have an empty name.
        check_name(kind, name, dict.fromkeys(filter(None, part_names)))
        self._data = data
        self._model = model
        self._kind = kind
        self.id = part_names.index(name)

    def __getattr__(self, field: str) -> jax.Array:
        """Returns the part's rows of a field: one, or of a joint or sensor as many as it has."""
        # One row of xanchor or xaxis, but several of qpos, or of a field of the degrees of freedom.
        if self._kind == "joint" and field not in _JOINT_FIELDS:
            return getattr(self._data, field)[self._rows(field)]
        # The controls are the only field of actuators without a prefix.
        full_name = "ctrl" if field == "ctrl" else f"{self._prefix}{field}"
        rows = getattr(self._data, full_name)
        if self._kind == "sensor":
            start = int(self._model.sensor_adr[self.id])
            return rows[start : start + int(self._model.sensor_dim[self.id])]
        return rows[self.id]

    def _rows(self, field: str) -> slice:
        """Returns the rows of a joint in ``qpos``, or in a field of the degrees of freedom."""
        # A quaternion has four numbers in qpos, but three velocities: nq and nv differ.
        starts = self._model.jnt_dofadr
        size = self._model.nv
        if field == "qpos":
            starts = self._model.jnt_qposadr
            size = self._model.nq
        ends = [*starts[1:], size]
        return slice(int(starts[self.id]), int(ends[self.id]))


class Named:
    """Has the fields of mjData; their rows by name, and what belongs to the episode.

    mj_model: whose names they are
    episode: what ``MujocoEnv.randomize`` returned for this episode
    memory: what the episode remembers, see ``MujocoEnv.memory``
    """

    mj_model: MjModel
    episode: dict[str, Any]
    memory: dict[str, Any]

    def body(self, name: str) -> Part:
        """Returns a body: ``xpos`` [3], ``xquat`` [4], ``xmat``, ``cvel``, ..., as in mjData."""
        return Part(self, self.mj_model, "body", name)

    def joint(self, name: str) -> Part:
        """Returns a joint: ``qpos`` [1], [4] or [7], ``qvel`` [1], [3] or [6], ``xaxis``, ..."""
        return Part(self, self.mj_model, "joint", name)

    def geom(self, name: str) -> Part:
        """Returns a geom: ``xpos`` [3], ``xmat`` [3, 3]."""
        return Part(self, self.mj_model, "geom", name)

    def site(self, name: str) -> Part:
        """Returns a site: ``xpos`` [3], ``xmat`` [3, 3]."""
        return Part(self, self.mj_model, "site", name)

    def camera(self, name: str) -> Part:
        """Returns a camera: ``xpos`` [3], ``xmat`` [3, 3]."""
        return Part(self, self.mj_model, "camera", name)

    def tendon(self, name: str) -> Part:
        """Returns a tendon: ``length`` [], ``velocity`` []."""
        return Part(self, self.mj_model, "tendon", name)

    def actuator(self, name: str) -> Part:
        """Returns an actuator: ``ctrl`` [], ``force`` [], ``length`` [], ``velocity`` []."""
        return Part(self, self.mj_model, "actuator", name)

    def sensor(self, name: str) -> Part:
        """Returns a sensor: ``data`` [n]."""
        return Part(self, self.mj_model, "sensor", name)


class View(Named, Simulation):
    """A simulation as a task reads it: every field of mjData, and parts by their names."""

    def __init__(
        self,
        data: Any,
        mj_model: MjModel,
        episode: dict[str, Any],
        memory: dict[str, Any] | None = None,
    ):
        """Shows an ``mjx.Data``."""
        super().__init__(data)
        self.mj_model = mj_model
        self.episode = episode
        self.memory = dict(memory or {})
