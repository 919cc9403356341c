"""Convex hulls of meshes, as C++ tables in memory: they are too large for what the lanes share."""

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np

from mjx_reinforce.engine.team.supported import MESH

#: MuJoCo's mjMESH_HILLCLIMB_MIN: of fewer vertices, C looks at each.
_MIN_CLIMBED = 10
#: The last entry of a list.
_END = -1


class Hulls(NamedTuple):
    """The hulls of a model: the structs of ``device/hulls.h`` and the lists that they name.

    Hulls, vertices and faces are numbered across all meshes.

    places: [V, 3] of vertices in the frames of their meshes (m)
    vertex_neighbors, vertex_faces: [V] where a vertex's list begins
    neighbors, faces: such lists, of vertices and of faces, each up to ``_END``
    face_normals: [F, 3]
    face_corners: [F, 2] where a face's list begins, and how many corners it has
    corners: such lists, of vertices in their order around a face
    hulls: [H, 29] first vertex, how many are searched one by one, the vertices to climb from
    numbers: the number of the hull of each mesh that a geom has
    """

    places: list[Sequence[float]]
    vertex_neighbors: list[int]
    vertex_faces: list[int]
    neighbors: list[int]
    faces: list[int]
    face_normals: list[np.ndarray]
    face_corners: list[tuple[int, int]]
    corners: list[int]
    hulls: list[Sequence[int]]
    numbers: dict[int, int]


def of_geoms(model: Any, geoms: Iterable[int]) -> Hulls:
    """Returns the hulls of geoms that are meshes; equal ones once."""
    hulls = Hulls([], [], [], [], [], [], [], [], [], {})
    known: dict[bytes, int] = {}
    meshes = {int(model.geom_dataid[x]) for x in geoms if model.geom_type[x] == MESH}
    for mesh in sorted(meshes):
        vertex_count = model.mesh_vertnum[mesh]
        places = model.mesh_vert[model.mesh_vertadr[mesh] :][:vertex_count]
        graph = model.mesh_graph[model.mesh_graphadr[mesh] :]
        # Up to the end of the neighbors; triangles follow.
        graph = graph[: 2 + 3 * graph[0] + 3 * graph[1]]
        key = places.tobytes() + graph.tobytes()
        if key not in known:
            known[key] = len(hulls.hulls)
            _add(hulls, model, mesh, places, graph)
        hulls.numbers[mesh] = known[key]
    return hulls


def _add(hulls: Hulls, model: Any, mesh: int, places: np.ndarray, graph: np.ndarray) -> None:
    """Adds the hull of a mesh.

    Args:
      hulls: to which it is added.
      model: the model.
      mesh: the mesh.
      places: [n, 3] of all its vertices.
      graph: MuJoCo's mesh_graph from where that of the mesh begins: numbers of vertices and
        triangles, where the neighbors of a vertex begin, the mesh's number of a vertex, neighbors.
    """
    parts = np.split(graph[2:], [graph[0], 2 * graph[0]])
    starts, mesh_ids, neighbors = (x.tolist() for x in parts)
    rank = {x: n for n, x in enumerate(mesh_ids)}
    # As C looks at all vertices of a small mesh, in their order, these are not the hull's alone.
    is_searched = len(places) < _MIN_CLIMBED
    vertices = range(len(places)) if is_searched else mesh_ids
    first = len(hulls.places)
    first_face = len(hulls.face_corners)
    number_of = {x: first + n for n, x in enumerate(vertices)}
    for vertex in vertices:
        hulls.places.append(places[vertex])
        hulls.vertex_neighbors.append(len(hulls.neighbors))
        if vertex in rank:
            start = starts[rank[vertex]]
            row = neighbors[start : neighbors.index(_END, start)]
            hulls.neighbors.extend(number_of[mesh_ids[x]] for x in row)
        hulls.neighbors.append(_END)
        hulls.vertex_faces.append(len(hulls.faces))
        entry = model.mesh_vertadr[mesh] + vertex
        row = model.mesh_polymap[model.mesh_polymapadr[entry] :][: model.mesh_polymapnum[entry]]
        hulls.faces.extend([*(first_face + row), _END])
    for face in model.mesh_polyadr[mesh] + np.arange(model.mesh_polynum[mesh]):
        hulls.face_normals.append(model.mesh_polynormal[face])
        row = model.mesh_polyvert[model.mesh_polyvertadr[face] :][: model.mesh_polyvertnum[face]]
        hulls.face_corners.append((len(hulls.corners), len(row)))
        hulls.corners.extend(number_of[int(x)] for x in row)
    seeds = [number_of[mesh_ids[x]] for x in model.mesh_extrema[mesh]]
    hulls.hulls.append((first, len(places) if is_searched else 0, *seeds))


def degree(hulls: Hulls) -> int:
    """Returns the largest number of faces around a vertex."""
    ends = [n for n, x in enumerate(hulls.faces) if x == _END]
    return max(
        (end - start for start, end in zip(hulls.vertex_faces, ends, strict=True)), default=0
    )


def text(hulls: Hulls) -> list[str]:
    """Returns the C++ of hulls; arrays that nothing reads where there are none."""
    vertices = [
        f"{{{{{','.join(f'{np.float32(x)}f' for x in place)}}},{neighbors},{faces}}}"
        for place, neighbors, faces in zip(
            hulls.places, hulls.vertex_neighbors, hulls.vertex_faces, strict=True
        )
    ]
    faces = [
        f"{{{{{','.join(map(repr, normal.tolist()))}}},{start},{count}}}"
        for normal, (start, count) in zip(hulls.face_normals, hulls.face_corners, strict=True)
    ]
    rows = [
        f"{{{first},{count},{{{','.join(map(str, seeds))}}}}}"
        for first, count, *seeds in hulls.hulls
    ]
    tables = {
        ("Hull", "hulls"): rows,
        ("HullVertex", "hull_vertex"): vertices,
        ("HullFace", "hull_face"): faces,
        ("int", "hull_neighbor"): map(str, hulls.neighbors),
        ("int", "hull_faces_of"): map(str, hulls.faces),
        ("int", "hull_corner"): map(str, hulls.corners),
    }
    return [
        f"TABLE {struct} {name}[] = {{{','.join(entries) or '{}'}}};"
        for (struct, name), entries in tables.items()
    ]
