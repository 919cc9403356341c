"""From MJCF to a model that MJX runs, or a clear error."""

import copy
import hashlib
import importlib.resources
import re
import warnings
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, TypeAlias

import jax
import mujoco
import numpy as np
from mujoco import MjModel, MjSpec, mjx  # pyright: ignore[reportAttributeAccessIssue]

from mjx_reinforce.engine.checks import BadEnvironmentError, explain
from mjx_reinforce.engine.physics import contacts
from mjx_reinforce.envs.refusals import check_supported, is_off, listed, may_touch

#: MuJoCo's own names; it is a C extension without stubs.
_C: Any = mujoco
#: Everything that MuJoCo carries from a step to the next, by its names in mjData; mjdata.h lists it
#: as mjtState. Here is what an env step hands to the next.
CARRIED = ("time", "qpos", "qvel", "act", "qacc_warmstart")
#: What stays as the model has it, since no task changes it.
CONSTANT = ("qfrc_applied", "xfrc_applied", "eq_active", "mocap_pos", "mocap_quat", "userdata")
#: Fields of a model that ``MujocoEnv.randomize`` may replace in an episode.
RANDOM = (
    "body_mass",
    "body_inertia",
    "body_ipos",
    "geom_friction",
    "dof_damping",
    "dof_armature",
    "jnt_stiffness",
    "actuator_gainprm",
    "actuator_biasprm",
    "actuator_gear",
)
#: What no step depends on, and MJX refuses: the energy, and a check of the inverse dynamics.
_ONLY_REPORTS = int(_C.mjtEnableBit.mjENBL_ENERGY | _C.mjtEnableBit.mjENBL_FWDINV)
#: Elements of <custom> that MJX reads, by which it drops contacts. To C they are the user's own.
_READ_BY_MJX = ("max_contact_points", "max_geom_pairs")
#: Fields of a model that no step reads: pictures, and what is the user's own.
_UNREAD = re.compile(r"(cam|light|mat|skin)_.*|.*_(rgba|user)|numeric_data|tuple_objprm")
#: Those in which an infinite number means that there is no limit.
_MAY_BE_INFINITE = re.compile(r".*(range|cutoff|lengthspring|yield)")
#: Those that MuJoCo computes of others, which a message names in place of these.
_DERIVED = re.compile(r"stat\..*|body_(margin|subtreemass)|.*(_aabb|[^s]0)")
#: What MuJoCo calls a model without a name.
_NAMELESS = "MuJoCo Model"
#: Arrays by their names: fields of mjData or mjModel, and what else an episode draws or remembers.
Fields = dict[str, jax.Array]
#: The name of a file, an ``MjSpec`` or an ``MjModel``, which MuJoCo does not declare.
ModelSource: TypeAlias = Any


def load_model(xml_file: ModelSource) -> Any:
    """Compiles an MJCF file of the package's assets, or the user's own by a path.

    Args:
      xml_file: the name of an asset, or a path with a folder in it, such as "./mine.xml"; or an
        ``MjSpec`` or ``MjModel``, of which a copy is taken.

    Raises:
      ValueError: there is no such file, MuJoCo cannot compile it, its timestep is not positive, a
        number in it is not finite, or nothing in it can be moved; then the message has all that
        ``to_mjx`` refuses, too.
    """
    if isinstance(xml_file, MjModel):
        model = copy.copy(xml_file)
    else:
        with warnings.catch_warnings():
            # HalfCheetah's total mass is given as Gymnasium gives it, which MuJoCo deprecates.
            warnings.filterwarnings("ignore", ".*'settotalmass' is deprecated")
            model = _compile_model(MjSpec.compile, spec(xml_file), xml_file)
    if not 0 < model.opt.timestep < np.inf:
        raise ValueError(
            f"{_name(xml_file)} has the timestep {model.opt.timestep}; write a finite number of "
            "seconds above 0"
        )
    if places := [*_nonfinite(model)]:
        causes = [place for place in places if not _DERIVED.fullmatch(place.partition(" ")[0])]
        raise ValueError(
            f"{_name(xml_file)} has numbers that are not finite, in {listed(causes or places)}, as "
            "mjModel names them; write finite ones"
        )
    # Said together with all that MJX would refuse, so that the file is mended once.
    if not model.nu:
        fault = "it has no actuators; add an <actuator> element, or call spec.add_actuator"
        check_supported(model, _name(xml_file), fault)
    model.opt.enableflags &= ~_ONLY_REPORTS
    if is_off(model, "constraint"):  # C looks for no contacts then, MJX does
        model.opt.disableflags |= _C.mjtDisableBit.mjDSBL_CONTACT
    for number in range(model.nnumeric):
        if model.numeric(number).name in _READ_BY_MJX:
            model.name_numericadr[number] = len(model.names) - 1  # a name of no letters
    return model


def c_model(model: Any) -> Any:
    """Returns the model as C MuJoCo is to step it: a copy where something has to differ.

    MuJoCo 4.0.0 factorizes some sparse Hessians of Newton's method wrongly
    (findings/copies_of_five_masses.sh). MJX has another method where constraints are sparse.
    """
    if model.opt.solver != _C.mjtSolver.mjSOL_NEWTON or not _C.mj_isSparse(model):
        return model
    model = copy.copy(model)
    model.opt.jacobian = _C.mjtJacobian.mjJAC_DENSE
    return model


def _nonfinite(model: Any) -> Iterator[str]:
    """Yields where numbers of a model are not finite that a step reads: a field, and whose it is.

    MuJoCo's compiler checks few of them.
    """
    for prefix, owner in (("", model), ("opt.", model.opt), ("stat.", model.stat)):
        for field in dir(owner):
            values = np.atleast_1d(getattr(owner, field))
            if values.dtype.kind != "f" or _UNREAD.fullmatch(field):
                continue
            is_bad = np.isnan(values) if _MAY_BE_INFINITE.fullmatch(field) else ~np.isfinite(values)
            if is_bad.any():
                row = int(np.argwhere(is_bad)[0, 0])
                yield f"{prefix}{field}{_owner(model, field, values, row)}"


def _owner(model: Any, field: str, values: np.ndarray, row: int) -> str:
    """Returns whose row of a field it is, for a message, or nothing where rows are no elements."""
    kind = field.partition("_")[0]
    count = getattr(model, f"n{kind}", None)
    if kind in ("dof", "qpos", "qpos0"):
        first_rows = model.jnt_dofadr if kind == "dof" else model.jnt_qposadr
        row = int(np.searchsorted(first_rows, row, side="right")) - 1
        kind = "jnt"
        count = len(values)
    if not hasattr(model, kind) or count != len(values):
        return ""
    return f" of {getattr(model, kind)(row).name or f'number {row}'}"


def _name(xml_file: ModelSource) -> str:
    """Returns what a message calls a model: its file, the name that it has itself, or neither."""
    if isinstance(xml_file, MjSpec):
        xml_file = xml_file.modelname
    elif isinstance(xml_file, MjModel):
        xml_file = xml_file.names.split(b"\0")[0].decode()
    return "the model" if xml_file == _NAMELESS else f"the model {xml_file!r}"


def is_own(xml_file: ModelSource) -> bool:
    """Returns whether a model is the user's, by a path; raises ValueError where no file is."""
    if not isinstance(xml_file, str):
        return True
    # Assets are named without a folder, whatever is in the current one.
    is_path = "/" in xml_file or "\\" in xml_file
    if is_path and not Path(xml_file).is_file():
        raise ValueError(f"there is no model {xml_file!r} in {Path.cwd()}")
    return is_path


def spec(xml_file: ModelSource) -> Any:
    """Returns a model before it is compiled, an ``MjSpec``; otherwise as ``load_model``."""
    if isinstance(xml_file, MjSpec):
        return xml_file.copy()
    if is_own(xml_file):
        return _compile_model(MjSpec.from_file, xml_file, xml_file)
    return _compile_model(MjSpec.from_string, _asset(xml_file), xml_file)


def _asset(xml_file: str) -> str:
    """Returns the text of a model of the package, or raises ValueError."""
    asset = importlib.resources.files("mjx_reinforce.envs") / "assets" / xml_file
    if not asset.is_file():
        raise ValueError(
            f"the package has no model {xml_file!r}; give a path with a folder for your own, "
            f"such as './{xml_file}'"
        )
    return asset.read_text(encoding="utf-8")


def _compile_model(
    compiler: Callable[[Any], Any], source: ModelSource, xml_file: ModelSource
) -> Any:
    """Returns the model, or raises ValueError with the file's name and what MuJoCo says."""
    try:
        return compiler(source)
    except Exception as error:  # mujoco.FatalError is no ValueError
        raise ValueError(f"MuJoCo cannot compile {_name(xml_file)}: {explain(error)}") from error


def digest(model: MjModel) -> str:
    """Returns a hash of all that is in a model, the same in every process."""
    # As MuJoCo writes it to a file of its binary format, MJB: every field of mjModel.
    data = np.empty(_C.mj_sizeModel(model), np.uint8)
    _C.mj_saveModel(model, None, data)
    return hashlib.sha256(data.tobytes()).hexdigest()


def replaced(episode: dict[str, Any]) -> dict[str, Any]:
    """Returns the fields of a model that an episode replaces, see ``MujocoEnv.randomize``.

    Args:
      episode: what ``MujocoEnv.randomize`` returned.
    """
    return {name: value for name, value in episode.items() if name in RANDOM}


def fields_of(source: Any, names: Iterable[str]) -> dict[str, Any]:
    """Returns fields of a simulation, or of what has some of its fields, by their names."""
    return {name: getattr(source, name) for name in names}


def make_data(model: MjModel) -> mjx.Data:
    """Returns MJX's simulation of a model at its start, on this process's own device.

    It has no room for contacts if MJX cannot find those of some pairs of geoms. Device code has
    room of its own.
    """
    device = jax.local_devices()[0]
    try:
        return contacts.make_data(model, device)
    except (NotImplementedError, ValueError):  # as MJX says that it has no such function
        return contacts.make_data(_without_contacts(model), device)


@jax.ensure_compile_time_eval()
def without_contacts(model: MjModel) -> mjx.Model:
    """Returns MJX's version of a model in which nothing touches: all but contacts is the same.

    As of ``to_mjx``, its arrays are constants where it is asked for while something is traced.
    """
    return mjx.put_model(_without_contacts(model), impl="jax", device=jax.local_devices()[0])


def has_data(model: MjModel) -> bool:
    """Returns whether MJX has a simulation of a model, which it need not be able to step."""
    try:
        jax.eval_shape(lambda: make_data(model))
        without_contacts(model)
    except Exception:  # whatever MJX raises of what it does not know
        return False
    return True


@jax.ensure_compile_time_eval()
def to_mjx(model: MjModel, xml_file: ModelSource) -> mjx.Model:
    """Returns MJX's version of a model, of constants also where an environment is made under jit.

    Args:
      model: of ``load_model``.
      xml_file: where it came from, for the message.

    Raises:
      UnsupportedError: it cannot be simulated as by C MuJoCo; the message has every reason.
      BadEnvironmentError: MJX fails where it should not.
    """
    name = _name(xml_file)
    check_supported(model, name)
    try:
        # Not on JAX's first device, which may be another process's.
        device = jax.local_devices()[0]
        mjx_model = mjx.put_model(_without_idle_pairs(model), impl="jax", device=device)
        # Notices what the model alone does not show; its arrays are not made.
        jax.eval_shape(lambda: contacts.make_data(model, device))
    except Exception as error:  # of another library: no refusal
        raise BadEnvironmentError(f"converting {name} to MJX fails: {explain(error)}") from error
    return mjx_model


def _without_contacts(model: MjModel) -> MjModel:
    """Returns a model in which nothing touches."""
    idle_model: Any = copy.copy(model)
    idle_model.opt.disableflags |= _C.mjtDisableBit.mjDSBL_CONTACT
    return _without_idle_pairs(idle_model)


def _without_idle_pairs(model: MjModel) -> MjModel:
    """Returns a model whose geoms meet none if a flag disables contacts: MJX looks at all pairs."""
    if may_touch(model):
        return model
    idle_model = copy.copy(model)
    idle_model.geom_contype[:] = 0
    idle_model.geom_conaffinity[:] = 0
    return idle_model
