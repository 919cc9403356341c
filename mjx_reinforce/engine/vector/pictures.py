"""MuJoCo's pictures of a model at positions of its joints."""

import copy
import ctypes.util
import os
import sys
import warnings
import weakref
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from mjx_reinforce.engine.base import MjModel

#: A floor's normal points upward by this much at least, [0, 1]: slopes of up to 60 degrees.
_MIN_UPWARD = 0.5
#: The length of an arrow of 1 m/s, its width, and how far it lies above the robot or another arrow,
#: in radii of the robot.
_ARROW_LENGTH = 1.5
_ARROW_WIDTH = 0.04
_ARROW_GAP = 0.3
#: How far a camera is from the robot's center at least, in radii, to show the arrows.
_CAMERA_DISTANCE = 5.0
#: A slower robot (m/s) has no arrow: it would be a head without a shaft.
_MIN_SPEED = 0.05


class Arrow(NamedTuple):
    """A velocity that is drawn above the robot.

    velocity: [3] in the world (m/s)
    color: red, green, blue, in [0, 255]
    """

    velocity: np.ndarray
    color: tuple[int, int, int]


class Renderer:
    """Draws a model at given positions, through its camera "track" if it has one.

    Otherwise the picture goes with the robot, the body of the first joint, if nothing ties that to
    its place. Below a robot that goes, floors have no end.
    """

    def __init__(self, model: "MjModel", width: int, height: int):
        """Opens MuJoCo's renderer for pictures of so many pixels; see ``check_drawing``."""
        mujoco = import_mujoco()
        # A picture needs other sizes and lights than its model, which is left as it is.
        model = copy.copy(model)
        model.vis.global_.offwidth = max(model.vis.global_.offwidth, width)
        model.vis.global_.offheight = max(model.vis.global_.offheight, height)
        # Brighter than MuJoCo's own, of 0.1 and 0.4: also what is in the shade is seen.
        model.vis.headlight.ambient[:] = 0.4
        model.vis.headlight.diffuse[:] = 0.6
        # Without a GPU smooth edges take half the time of a picture, and show no better in it.
        model.vis.quality.offsamples = 0
        # Without a GPU a fine shadow takes half the time of a picture, and shows no better in it.
        model.vis.quality.shadowsize = min(model.vis.quality.shadowsize, max(width, height))
        self._robot = _traveler(model)
        self._camera = _camera(model)
        is_extended = self._robot is not None and _lay_endless_floors(model)
        self._model = model
        self._data = mujoco.MjData(model)
        self._renderer = mujoco.Renderer(model, height, width)
        if is_extended:  # without a white line at the horizon, which nobody asked for
            self._renderer.scene.flags[mujoco.mjtRndFlag.mjRND_HAZE] = False
        # Without this it closes itself when Python ends, too late for its own modules.
        self.close = weakref.finalize(self, self._renderer.close)

    def draw(self, qpos: np.ndarray, arrows: Sequence[Arrow] = ()) -> np.ndarray:
        """Returns a picture [height, width, 3] uint8.

        Args:
          qpos: [nq] generalized positions.
          arrows: of a robot that goes, the lowest first.
        """
        mujoco = import_mujoco()
        model = self._model
        data = self._data
        data.qpos[:] = qpos
        mujoco.mj_forward(model, data)
        if self._robot is not None:
            center = data.subtree_com[self._robot]
            if self._camera.type == mujoco.mjtCamera.mjCAMERA_FREE:
                self._camera.lookat[:] = center
            # Where a sun is decides only how far its shadows reach.
            suns = model.light_type == mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
            data.light_xpos[suns, :2] += center[:2]
            if len(arrows):
                self._step_back(self._robot)
        # MuJoCo lays an endless floor around the camera of the scene before, which may be far away.
        mujoco.mjv_updateCamera(model, data, self._camera, self._renderer.scene)
        self._renderer.update_scene(data, self._camera)
        if self._robot is not None and len(arrows):
            self._lay_arrows(self._robot, arrows)
        return self._renderer.render()

    def _radius(self, robot: int) -> float:
        """Returns how far a robot's geoms reach from its center of mass at most (m)."""
        model = self._model
        geoms = model.body_rootid[model.geom_bodyid] == model.body_rootid[robot]
        offsets = self._data.geom_xpos[geoms] - self._data.subtree_com[robot]
        return float(np.max(np.linalg.norm(offsets, axis=1) + model.geom_rbound[geoms]))

    def _step_back(self, robot: int) -> None:
        """Moves a camera that is not the model's so far away that arrows are in the picture."""
        # It never comes nearer again: the picture would sway with the robot's legs.
        distance = _CAMERA_DISTANCE * self._radius(robot)
        self._camera.distance = max(self._camera.distance, distance)

    def _lay_arrows(self, robot: int, arrows: Sequence[Arrow]) -> None:
        """Adds arrows to the scene, the lowest first, one above the other."""
        mujoco = import_mujoco()
        model = self._model
        scene = self._renderer.scene
        radius = self._radius(robot)
        geoms = model.body_rootid[model.geom_bodyid] == model.body_rootid[robot]
        start = self._data.subtree_com[robot].copy()
        start[2] = np.max(self._data.geom_xpos[geoms, 2] + model.geom_rbound[geoms])
        for arrow in arrows:
            start[2] += _ARROW_GAP * radius
            if np.linalg.norm(arrow.velocity) < _MIN_SPEED:
                continue
            geom = scene.geoms[scene.ngeom]
            rgba = np.array([*arrow.color, 255], np.float32) / 255
            kind = mujoco.mjtGeom.mjGEOM_ARROW
            mujoco.mjv_initGeom(geom, kind, np.zeros(3), np.zeros(3), np.zeros(9), rgba)
            end = start + _ARROW_LENGTH * radius * arrow.velocity
            mujoco.mjv_connector(geom, kind, _ARROW_WIDTH * radius, start, end)
            # Hardly shaded, so that its color is that of its name below the picture.
            geom.emission = 0.3
            scene.ngeom += 1


def _traveler(model: "MjModel") -> int | None:
    """Returns the body of the first joint, the robot, if nothing ties it to its place.

    What lies about comes later in a model.
    """
    mujoco = import_mujoco()
    robot = model.jnt_bodyid[0] if model.njnt else -1
    # A free joint goes anywhere, and so does a slider without an end, as a planar walker's.
    is_traveling = (model.jnt_type == mujoco.mjtJoint.mjJNT_FREE) | (
        (model.jnt_type == mujoco.mjtJoint.mjJNT_SLIDE) & (model.jnt_limited == 0)
    )
    if not is_traveling[model.jnt_bodyid == robot].any():
        return None
    return int(robot)


def _camera(model: "MjModel") -> Any:
    """Returns an ``MjvCamera``: the model's "track", or one that looks at all of it."""
    mujoco = import_mujoco()
    camera = mujoco.MjvCamera()
    mujoco.mjv_defaultFreeCamera(model, camera)
    for number in range(model.ncam):
        if model.camera(number).name == "track":
            camera.type = mujoco.mjtCamera.mjCAMERA_FIXED
            camera.fixedcamid = number
    return camera


def _lay_endless_floors(model: "MjModel") -> bool:
    """Takes the ends off a model's floors, as contacts know none, and returns whether any had some.

    A floor is a plane of the world that faces upward. Its texture keeps its scale.
    """
    mujoco = import_mujoco()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    # A plane with sizes of 0 has no ends already.
    planes = (model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE) & (model.geom_size[:, :2] > 0).any(1)
    is_world_geom = model.body_weldid[model.geom_bodyid] == 0
    floors = planes & is_world_geom & (data.geom_xmat[:, 8] > _MIN_UPWARD)
    if not floors.any():
        return False
    textured = floors & (model.geom_matid >= 0)
    # Floors may share a material, whose texture has one scale: that of the first of them.
    materials, indices = np.unique(model.geom_matid[textured], return_index=True)
    sizes = model.geom_size[textured][indices, :2]
    # A texture is repeated so often from side to side, or, without sides, every two meters.
    is_sized = ~model.mat_texuniform[materials]
    model.mat_texrepeat[materials[is_sized]] /= np.where(sizes > 0, sizes, 1)[is_sized]
    model.geom_size[floors, :2] = 0
    model.vis.headlight.specular[:] = 0  # an endless floor is of large pieces that would flash
    return True


def import_mujoco() -> Any:
    """Returns MuJoCo; without a screen it is told to draw through EGL, where that is installed."""
    is_headless = not os.environ.get("DISPLAY") and ctypes.util.find_library("EGL")
    # MuJoCo reads the variable once, when it is imported.
    if is_headless and "mujoco" not in sys.modules:
        os.environ.setdefault("MUJOCO_GL", "egl")
    import mujoco

    return mujoco


def check_drawing() -> None:
    """Raises ValueError, with what to do, where MuJoCo cannot draw; it takes a moment."""
    try:
        with warnings.catch_warnings(action="ignore"):  # GLFW's, before it fails
            mujoco = import_mujoco()
            mujoco.Renderer(mujoco.MjModel.from_xml_string("<mujoco/>"), 8, 8).close()
    except Exception as error:  # each of MuJoCo's backends has its own
        backend = os.environ.get("MUJOCO_GL")
        how = f"with MUJOCO_GL={backend}" if backend else "here"
        raise ValueError(
            f"MuJoCo cannot draw {how} ({error}); set MUJOCO_GL=egl, or MUJOCO_GL=osmesa without a "
            "GPU, and install what is missing (Debian: apt install libegl1 libosmesa6)"
        ) from error
