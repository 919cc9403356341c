"""Model files that others wrote, as C MuJoCo loads them, and where their episodes begin."""

import hashlib
import importlib
import re
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

mujoco: Any = importlib.import_module("mujoco")  # pyright does not know what is in it

#: What C MuJoCo says where a mesh or a texture is in no file.
_ABSENT = "(?i)opening file|resource not found|file not found|no decoder|does not exist"
#: The mesh in the place of one that is not there: a tetrahedron (m).
_TETRAHEDRON = 0.02 * np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1.0]])
#: What moves a model; how it looks is not in it.
_MECHANICS = """
    body_mass body_inertia body_pos body_quat body_parentid jnt_type jnt_axis jnt_range jnt_pos
    dof_damping dof_armature dof_frictionloss geom_type geom_size geom_pos geom_contype
    geom_conaffinity geom_friction geom_solref actuator_gainprm actuator_biasprm actuator_trntype
    actuator_trnid eq_type eq_data tendon_range tendon_stiffness key_qpos sensor_type
    """
_OPTIONS = ("integrator", "solver", "cone", "timestep", "disableflags", "enableflags", "iterations")
#: A model falls and comes to rest for so long (s) before an episode, in at most so many steps.
_SETTLING = 0.4
_MAX_SETTLING_STEPS = 200


class Start(NamedTuple):
    """Where an episode of a model begins, and how it is controlled.

    qpos, qvel: [nq], [nv] after the model has come to rest on what is under it
    control: [nu] the middle of the control, that of key frame 0 or zero, within ``ctrlrange``
    amplitude: [nu] of the sine around it: a tenth of ``ctrlrange``, or 0.1
    """

    qpos: np.ndarray
    qvel: np.ndarray
    control: np.ndarray
    amplitude: np.ndarray


def files(folder: Path) -> list[Path]:
    """Returns the files of a folder that are models by their first element, MJCF and URDF."""
    roots = {".xml": r"<mujoco[\s>]", ".urdf": r"<robot[\s>]"}
    paths = sorted(path for suffix in roots for path in folder.rglob(f"*{suffix}"))
    return [
        path for path in paths if re.search(roots[path.suffix], path.read_text("utf-8", "replace"))
    ]


def load(path: Path) -> tuple[Any, str]:
    """Returns a model, and what took the place of meshes and textures that are not there.

    Raises:
      ValueError: C MuJoCo cannot load it.
    """
    num_tetrahedra = 0
    spec = mujoco.MjSpec.from_file(str(path))
    while True:
        try:
            model = spec.compile()
        except ValueError as error:
            absent = _absent_meshes(spec, str(error))
            if not absent:
                raise
        else:
            return model, f"{num_tetrahedra} meshes are tetrahedra" if num_tetrahedra else ""
        num_tetrahedra += len(absent)
        for mesh in absent:
            mesh.file = ""
            mesh.uservert = _TETRAHEDRON.ravel()
            mesh.scale = [1, 1, 1]
        _remove_looks(spec)


def _absent_meshes(spec: Any, message: str) -> list[Any]:
    """Returns the meshes of the file that C MuJoCo does not find, all if it names none."""
    if not re.search(_ABSENT, message):
        return []
    meshes = [mesh for mesh in spec.meshes if mesh.file]
    named = [mesh for mesh in meshes if re.search(rf"[/']{re.escape(mesh.file)}'", message)]
    longest = max((mesh.file for mesh in named), key=len, default="")
    return [mesh for mesh in named if mesh.file == longest] or meshes


def _remove_looks(spec: Any) -> None:
    """Puts plain colors in the place of textures, and deletes skins."""
    for texture in spec.textures:
        texture.file = ""
        texture.cubefiles = [""] * len(texture.cubefiles)
        texture.builtin = mujoco.mjtBuiltin.mjBUILTIN_FLAT
        texture.width = texture.height = 8
        texture.gridsize = [1, 1]
    for skin in [*spec.skins]:
        spec.delete(skin)


def mechanism(model: Any) -> str:
    """Returns a hash of what moves a model."""
    numbers = hashlib.sha1(repr([getattr(model.opt, name) for name in _OPTIONS]).encode())
    numbers.update(repr((model.nplugin, model.nflex)).encode())
    for name in _MECHANICS.split():
        numbers.update(np.round(np.asarray(getattr(model, name), float), 9).tobytes())
    return numbers.hexdigest()[:8]


def start_of(model: Any) -> Start:
    """Returns where an episode begins: key frame 0 or qpos0, after a moment by C MuJoCo."""
    data = mujoco.MjData(model)
    if model.nkey and np.isfinite(model.key_qpos[0]).all():
        mujoco.mj_resetDataKeyframe(model, data, 0)
    pose = data.qpos.copy()
    low, high = model.actuator_ctrlrange.T
    is_limited = model.actuator_ctrllimited.astype(bool)
    control = np.where(is_limited, np.clip(data.ctrl, low, high), data.ctrl)
    amplitude = np.where(is_limited, 0.1 * (high - low), 0.1)
    data.ctrl[:] = control
    num_steps = min(round(_SETTLING / model.opt.timestep), _MAX_SETTLING_STEPS)
    try:
        mujoco.mj_step(model, data, num_steps)
    except mujoco.FatalError:
        return Start(pose, np.zeros(model.nv), control, amplitude)
    if any(warning.number for warning in data.warning):
        return Start(pose, np.zeros(model.nv), control, amplitude)
    return Start(data.qpos.copy(), data.qvel.copy(), control, amplitude)
