"""Tables of the hulls of meshes."""

from typing import Any

import mujoco
import numpy as np

from mjx_reinforce.engine.team import hulls

_C: Any = mujoco
_MESHES = """
<mujoco>
  <asset>
    <mesh name="ball" builtin="sphere" params="2" scale=".1 .08 .12"/>
    <mesh name="same ball" builtin="sphere" params="2" scale=".1 .08 .12"/>
    <mesh name="box" vertex="0 0 0 1 0 0 1 1 0 0 1 0 0 0 1 1 0 1 1 1 1 0 1 1 .5 .5 .5"/>
    <mesh name="unused" builtin="sphere" params="1"/>
  </asset>
  <worldbody>
    <geom type="mesh" mesh="ball"/>
    <geom type="mesh" mesh="same ball"/>
    <geom type="mesh" mesh="box"/>
    <geom type="mesh" mesh="unused"/>
  </worldbody>
</mujoco>"""


def test_equal_meshes_have_one_hull_and_climbing_ends_at_its_farthest_vertex():
    m = _C.MjModel.from_xml_string(_MESHES)
    tables = hulls.of_geoms(m, [0, 1, 2])
    assert tables.numbers == {0: 0, 1: 0, 2: 1}
    assert len(tables.places) == 162 + 9  # the unused mesh is not there
    places = np.array(tables.places)
    (first, searched, *seeds), (box_first, box_searched, *_) = tables.hulls
    assert (first, searched, box_first, box_searched) == (0, 0, 162, 9)
    for direction in np.random.default_rng(0).normal(size=(20, 3)):
        heights = places[:162] @ direction
        best = seeds[0]
        while True:
            start = tables.vertex_neighbors[best]
            stop = tables.neighbors.index(-1, start)
            near = max(tables.neighbors[start:stop], key=heights.__getitem__)
            if heights[near] <= heights[best]:
                break
            best = near
        assert heights[best] == heights.max()


def test_faces_hold_their_corners():
    m = _C.MjModel.from_xml_string(_MESHES)
    tables = hulls.of_geoms(m, [2])
    places = np.array(tables.places)
    assert len(tables.face_normals) == 6
    rows = zip(tables.face_normals, tables.face_corners, strict=True)
    for face, (normal, (start, count)) in enumerate(rows):
        corners = tables.corners[start : start + count]
        heights = places @ normal
        assert np.isclose(heights[corners], heights.max(), atol=1e-6).all()
        for corner in corners:
            first = tables.vertex_faces[corner]
            assert face in tables.faces[first : tables.faces.index(-1, first)]
