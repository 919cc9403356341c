"""A floor, a sky and a light for a model that is only drawn; what moves in it is not changed."""

import warnings
from types import ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from mjx_reinforce.types import MjModel, MjSpec

#: Colours from 0 to 1: the sky overhead and at the horizon, and the two kinds of tiles.
_SKY, _HORIZON = (0.30, 0.50, 0.72), (0.86, 0.91, 0.95)
_TILES = (0.40, 0.46, 0.50), (0.50, 0.56, 0.60)
#: Colour of the light, and the angle at which what stands upright is seen (degrees).
_LIGHT, _ELEVATION = (0.45, 0.45, 0.45), -14
#: The size of a plane without an end, and the colour of a geom that was given none.
_ENDLESS, _UNCOLORED = (0, 0, 0.1), (0.5, 0.5, 0.5, 1)
#: Side of a tile, in lengths of the model; the floor's distance below a model that stands on none.
_TILE, _GAP = 0.5, 0.25


def dress(spec: "MjSpec", *, replace: bool) -> Any:
    """Returns a compiled model with a sky, a floor and a light.

    Args:
      spec: the model, an ``MjSpec``; it is changed.
      replace: whether they take the place of the model's own sky and lights and of the colours of
        its planes; otherwise the model gets only what it lacks.
    """
    import mujoco

    kinds: Any = mujoco
    lowest, length, middle = _extent(_compile_scene(spec))
    skies = [x for x in spec.textures if x.type == kinds.mjtTexture.mjTEXTURE_SKYBOX]
    planes = [x for x in spec.geoms if x.type == kinds.mjtGeom.mjGEOM_PLANE]
    if replace:
        for sky in skies:
            spec.delete(sky)
    if replace or not skies:
        spec.add_texture(
            name="mjx_reinforce_sky",
            type=kinds.mjtTexture.mjTEXTURE_SKYBOX,
            builtin=kinds.mjtBuiltin.mjBUILTIN_GRADIENT,
            rgb1=_SKY,
            rgb2=_HORIZON,
            width=64,
            height=384,
        )
    if not planes:
        planes = [spec.worldbody.add_geom(name="mjx_reinforce_floor", contype=0, conaffinity=0)]
        planes[0].type, planes[0].pos = kinds.mjtGeom.mjGEOM_PLANE, (0, 0, lowest - _GAP * length)
        planes[0].size = _ENDLESS
    _add_tiles(spec, kinds, length)
    for plane in planes:
        if replace or (not plane.material and np.allclose(plane.rgba, _UNCOLORED)):
            plane.material, plane.rgba = "mjx_reinforce_tiles", (1, 1, 1, 1)
        if replace:
            plane.size = _ENDLESS
    if replace and middle is not None:
        getattr(spec.visual, "global").elevation = _ELEVATION
        if np.isnan(spec.stat.extent):
            spec.stat.center, spec.stat.extent = middle, 0.8 * length
    if replace:
        for light in list(spec.lights):
            spec.delete(light)
    if not spec.lights:
        _add_light(spec, kinds, length)
    return _compile_scene(spec)


def _compile_scene(spec: "MjSpec") -> Any:
    with warnings.catch_warnings():  # what MuJoCo deprecates in a model
        warnings.simplefilter("ignore")
        return spec.compile()


def _add_light(spec: "MjSpec", kinds: ModuleType, length: float) -> None:
    """Adds a light that goes with the first body, so that its shadow does not end on the way."""
    body = spec.worldbody.first_body() or spec.worldbody
    light = body.add_light(pos=(0, 0, 2 * length), dir=(0, 0, -1))
    light.type, light.mode = (
        kinds.mjtLightType.mjLIGHT_DIRECTIONAL,
        kinds.mjtCamLight.mjCAMLIGHT_TRACK,
    )
    light.diffuse = _LIGHT


def _add_tiles(spec: "MjSpec", kinds: ModuleType, length: float) -> None:
    """Adds the material of a chequered floor to a model of a length (m)."""
    spec.add_texture(
        name="mjx_reinforce_tiles",
        type=kinds.mjtTexture.mjTEXTURE_2D,
        builtin=kinds.mjtBuiltin.mjBUILTIN_CHECKER,
        rgb1=_TILES[0],
        rgb2=_TILES[1],
        width=256,
        height=256,
    )
    repeat = 1 / (2 * _TILE * length)
    tiles = spec.add_material(
        name="mjx_reinforce_tiles", texuniform=True, texrepeat=(repeat, repeat), specular=0
    )
    tiles.textures[kinds.mjtTextureRole.mjTEXROLE_RGB] = "mjx_reinforce_tiles"


def _extent(model: "MjModel") -> tuple[float, float, np.ndarray | None]:
    """Returns of a model in its pose, planes apart, the lowest point (m) and the length (m).

    The third value is the middle [3] (m) of what moves, if that is higher than wide.
    """
    import mujoco

    kinds: Any = mujoco
    data = kinds.MjData(model)
    kinds.mj_forward(model, data)
    axes, box = data.geom_xmat.reshape(-1, 3, 3), model.geom_aabb  # centre, half sides
    centre = data.geom_xpos + np.einsum("gij,gj->gi", axes, box[:, :3])
    half = np.einsum("gij,gj->gi", np.abs(axes), box[:, 3:])
    low, high = centre - half, centre + half
    solid = model.geom_type != kinds.mjtGeom.mjGEOM_PLANE
    moving = solid & (model.geom_bodyid > 0)
    if not moving.any():
        return 0.0, float(model.stat.extent), None
    first, last = low[moving].min(0), high[moving].max(0)
    length = (high[solid].max(0) - low[solid].min(0)).max()
    tall = (last - first)[2] > (last - first)[:2].max()
    return float(low[solid, 2].min()), float(length), (first + last) / 2 if tall else None
