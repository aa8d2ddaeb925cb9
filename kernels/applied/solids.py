"""Tables of the polyhedra that bound permanent bodies; they belong to shapes, and serve all bodies of that shape.

    shape: First row and number of edges, of faces, first entry of ``begin``, first corner, first and number of points
        on edges and on faces, shape [shapes, 10].
    edge, face, corner, begin: See ``polyhedron.h``; flat.
    edge_point, face_point: Points on edges and faces (``warpmag.shapes.polyhedra``), rows of ``native.CHUNK`` side by
        side, those of each shape filled up with points of no weight; flat.

Bodies refer to them:

    body: Shape, first moment, number of moments of each, and whether it yields to fields, shape [bodies, 4].
    size: 1/V of its first moment [1/m³], or its response if it yields, reach, radius of the ball around it, middle and
        half sides of its box [m], shape [bodies, 9].
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from warpmag.kernels.shared.native import CHUNK

INTEGER_TABLES = ("shape", "begin", "body")
"""Tables of whole numbers; the others have the scalar type of the moments."""


@dataclass(frozen=True)
class SolidMagnet:
    """A permanent body that is uniformly magnetized, or nearly: one that yields to fields has moments that induction
    solves for, and the closed form stands for what its remanence alone would make of a ball.

    Attributes:
        first, count: Its moments.
        volume: Volume of the first of them [m³].
        world: Its world.
        reach: Distance up to which the closed form counts [m].
        shape: The ``warpmag.shapes.polyhedra.Polyhedron`` that bounds it, in the frame of its body.
        movable: Whether the force on it is wanted.
        response: k = 3χ/(3 + χ) of one that yields to fields; 0 of others.
    """

    first: int
    count: int
    volume: float
    world: int
    reach: float
    shape: Any
    movable: bool
    response: float = 0.0

    def size(self) -> list[float]:
        """Return its row of ``size``."""
        lower, upper = self.shape.corners.min(axis=0), self.shape.corners.max(axis=0)
        middle = 0.5 * (lower + upper)
        radius = np.linalg.norm(self.shape.corners - middle, axis=1).max()
        return [
            self.response or 1.0 / self.volume,
            self.reach,
            radius,
            *middle,
            *(0.5 * (upper - lower)),
        ]


def tables_of(solids, *, fine: bool = False) -> dict[str, np.ndarray]:
    """Return the tables of the bodies' shapes, with more points on faces if ``fine``, and of the bodies."""
    shapes = {id(one.shape): one.shape for one in solids}
    number = {key: k for k, key in enumerate(shapes)}
    rows, tables = _tables(shapes.values(), fine)
    tables["shape"] = rows
    tables["body"] = np.array(
        [(number[id(one.shape)], one.first, one.count, one.response > 0.0) for one in solids], np.int32
    )
    tables["size"] = np.array([one.size() for one in solids])
    return tables


def _in_chunks(points) -> np.ndarray:
    """Points of a shape as rows of CHUNK side by side, filled up with the first point of no weight, flat."""
    count = -(-len(points) // CHUNK) * CHUNK
    filled = np.concatenate([points, np.repeat(points[:1], count - len(points), axis=0)])
    filled[len(points) :, -1] = 0.0
    return filled.reshape(-1, CHUNK, points.shape[1]).transpose(0, 2, 1)


def _tables(shapes, fine: bool):
    """Rows of the shapes' table, and what stands in the others."""
    rows, parts = [], {name: [] for name in ("edge", "face", "corner", "begin", "edge_point", "face_point")}
    counts = np.zeros(6, int)  # edges, faces, entries of begin, corners, points on edges, points on faces
    for shape in shapes:
        edges, faces = shape.edge_rows(), shape.normals
        begin = np.append(0, np.cumsum([len(face) for face in shape.faces]))
        on_edges, on_faces = _in_chunks(shape.edge_points()), _in_chunks(shape.face_points(fine=fine))
        points = CHUNK * len(on_edges), CHUNK * len(on_faces)
        start = counts.tolist()
        rows.append([
            start[0], len(edges), start[1], len(faces), start[2], start[3], start[4], points[0], start[5], points[1],
        ])  # fmt: skip
        corners = shape.corners[np.concatenate([np.asarray(face) for face in shape.faces])]
        for name, part in zip(parts, (edges, faces, corners, begin, on_edges, on_faces), strict=True):
            parts[name].append(np.asarray(part).reshape(-1))
        counts += [len(edges), len(faces), len(begin), len(corners), *points]
    return np.array(rows, np.int32), {name: np.concatenate(part) for name, part in parts.items()}
