"""The text of an ``MjSpec``, from which MuJoCo compiles the same model again."""

import os
from pathlib import Path
from typing import Any

from mjx_reinforce.engine.base import MjSpec

#: Elements with a file, what numbers their paths in a model, and what names their folder in MJCF.
_FILES = (
    ("meshes", "mesh_pathadr", "meshdir"),
    ("hfields", "hfield_pathadr", "meshdir"),
    ("skins", "skin_pathadr", "meshdir"),
    ("textures", "tex_pathadr", "texturedir"),
)
#: A density (kg/m^3) that is not zero. With it, ``to_xml`` writes that a geom has no mass.
_DENSITY = 1000.0


def text(spec: MjSpec, folder: Path) -> str:
    """Returns the MJCF of a model for a file in a folder; changes the model for that.

    MuJoCo's ``to_xml`` forgets two things: the folder of files that an attached model names, and
    that a geom has no mass if a default class says so by both its mass and its density.
    """
    mj_spec: Any = spec
    model = mj_spec.compile()
    for geom in mj_spec.geoms:
        default = geom.classname.geom
        if default.mass == 0:
            default.density = _DENSITY
    paths: dict[str, str] = {}
    for elements, addresses, directory in _FILES:
        start = folder / getattr(mj_spec, directory)
        for element in getattr(mj_spec, elements):
            if element.file:
                address = getattr(model, addresses)[element.id]
                path = os.path.abspath(model.paths[address:].split(b"\0")[0].decode())
                # MuJoCo reads the file once more, from where it is, before it writes.
                element.file = path
                paths[path] = os.path.relpath(path, start)
    mjcf = mj_spec.to_xml()
    for path, relative in paths.items():
        mjcf = mjcf.replace(f'file="{path}"', f'file="{relative}"')
    return mjcf
