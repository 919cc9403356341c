"""The tables of one model while they are filled: names, entries, and the numbers of softnesses."""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from mjx_reinforce.engine.team import records
from mjx_reinforce.engine.team.contact_kinds import softness_of
from mjx_reinforce.engine.team.frames import Frame
from mjx_reinforce.engine.team.records import Softness


class Tables:
    """The tables of one model.

    model: the MjModel, without what its flags disable
    random: the names of fields that differ from episode to episode
    constants, real_constants: numbers that the compiler knows, such as sizes of arrays
    functions: tables that the compiler knows, for loops that it writes out
    ints, masks, reals: the arrays of the struct Model, which the lanes read
    softnesses: those that were met, with their numbers
    dof_joint: [nv] the joint of a degree of freedom

    What one part of a model has and others read, filled with the tables of that part:

    frames: of bodies
    parents: of links
    cables: of ``cables.Cable``
    fluid_bodies: the bodies on which a medium acts, in the order of their table
    actuator_order: the numbers of actuators in the order of theirs
    geoms: the numbers of the geoms that may meet
    hulls: of those that are meshes
    """

    def __init__(self, model: Any, random: frozenset[str]):
        """Begins with no table."""
        self.model = model
        self.random = random
        self.constants: dict[str, int] = {}
        self.real_constants: dict[str, float] = {}
        self.functions: dict[str, Iterable[int]] = {}
        self.ints: dict[str, Any] = {}
        self.masks: dict[str, Any] = {}
        self.reals: dict[str, Any] = {}
        self.softnesses: dict[Softness, int] = {}
        self.dof_joint = np.asarray(model.dof_jntid)
        self.frames: list[Frame] = []
        self.parents: list[int] = []
        self.cables: Sequence[Any] = ()
        self.fluid_bodies: Any = None
        self.actuator_order: Any = None
        self.geoms: Any = None
        self.hulls: Any = None

    def add_records(self, name: str, order: Any = slice(None), **columns: np.ndarray) -> None:
        """Makes a table of structs from the columns of their fields, [rows] or [rows, numbers]."""
        field_sizes = records.FIELDS[records.STRUCTS[name]]
        assert {*columns} == {*field_sizes}
        rows = [columns[field].reshape(-1, count) for field, count in field_sizes.items()]
        self.reals[name] = np.hstack(rows)[order]

    def link_number(self, link: int) -> int:
        """Returns the number of a ``Frame.link`` in the state: the world is behind the links."""
        return self.model.njnt - 1 - link if link < 0 else link

    def softness_number(self, solref: np.ndarray, solimp: np.ndarray) -> int:
        """Returns the number of the softness of rows with these parameters."""
        return self.number(softness_of(self.model, solref, solimp))

    def number(self, softness: Softness) -> int:
        """Returns the number of a softness, a new one where it was not met before."""
        return self.softnesses.setdefault(softness, len(self.softnesses))
