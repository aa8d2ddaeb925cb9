"""Tables of permanent bodies, and of the polyhedra that bound them.

Bodies of one shape share its tables:

    shape: First row and number of edges and of faces, first entry of ``begin``, first corner, first and number of
        points on edges and on faces, first entry and number of the moments, first number in ``cylinder`` or -1, first
        and number of points on the rims and on the ends of the cylinder, shape [shapes, 17].
    edge, face, corner, begin: As in ``polyhedron.h``; flat.
    edge_point, face_point: Quadrature points on edges and faces, and on rims and ends of cylinders
        (``warpmag.shapes.polyhedra``), in chunks of ``native.CHUNK`` side by side. Chunks are filled up with points of
        weight 0; flat.
    moment: Positions [m] and volumes [m³] of the moments that replace the closed form at a distance, in the frame of
        the body, in the same chunks; flat.

    cylinder: Center, axis, radius R, and half height h [m] of the cylinder that a polyhedron replaces; flat.

Each body has a row in two tables:

    body: Shape, first moment, number of moments, and 1 if it responds to fields, shape [bodies, 4].
    size: 1/V of its first moment [1/m³], or the response k of a body that responds. Then both reaches, radius of the
        bounding sphere, center and half sides of the box [m], shape [bodies, 10].
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from warpmag.kernels.shared.native import CHUNK

INTEGER_TABLES = ("shape", "begin", "body")  # tables of integers; the others have the scalar type of the moments


@dataclass(frozen=True)
class SolidMagnet:
    """A permanent body whose field near it has a closed form.

    The body is uniformly magnetized, or responds to fields. If it responds, induction solves for its moments, and the
    closed form has the magnetization of a ball by the remanence alone.

    The system has as many moments as the body needs far away. Nearer than ``far_reach`` the body acts as ``moments``,
    nearer than ``reach`` as the closed form.
    """

    first: int  # first moment
    count: int  # number of moments
    volume: float  # volume of the first moment [m³]
    world: int  # its world
    reach: float  # distance up to which the closed form is used [m]
    shape: Any  # the ``warpmag.shapes.polyhedra.Polyhedron`` that bounds it, in the frame of its body
    moments: Any  # the ``polyhedra.Moments`` that replace it at a distance, in that frame
    movable: bool  # true if the force on it is computed
    response: float = 0.0  # k = 3χ/(3 + χ) if it responds to fields, else 0
    far_reach: float = 0.0  # distance from which on its moments in the system act alone [m], at least ``reach``
    potential: Any = None  # its ``shape.potential_table()`` from a cache; None to compute it where cells are near

    @property
    def has_few_moments(self) -> bool:
        """True if the system has fewer moments than ``moments``."""
        return self.count < len(self.moments.volumes)

    def size(self) -> list[float]:
        """Return the body's row of ``size``."""
        reaches = self.reach, max(self.reach, self.far_reach)
        return [self.response or 1.0 / self.volume, *reaches, *self.shape.bounds]


def of_each_shape(solids) -> dict[int, SolidMagnet]:
    """Return a body of each shape by the identity of the shape, in the order of the table ``shape``."""
    return {id(solid.shape): solid for solid in solids}


def tables_of(solids, *, fine: bool = False) -> dict[str, np.ndarray]:
    """Return all tables of the bodies ``solids``, with more points on faces if ``fine``."""
    shapes = of_each_shape(solids)
    number = {key: k for k, key in enumerate(shapes)}
    rows, tables = _shape_tables(shapes.values(), fine)
    tables["shape"] = rows
    tables["body"] = np.array(
        [(number[id(solid.shape)], solid.first, solid.count, solid.response > 0.0) for solid in solids], np.int32
    )
    tables["size"] = np.array([solid.size() for solid in solids])
    return tables


def _in_chunks(points) -> np.ndarray:
    """Return a shape's points in chunks side by side, filled up with the first point at weight 0, flat."""
    count = -(-len(points) // CHUNK) * CHUNK
    filled = np.concatenate([points, np.repeat(points[:1], count - len(points), axis=0)])
    filled[len(points) :, -1] = 0.0
    return filled.reshape(-1, CHUNK, points.shape[1]).transpose(0, 2, 1)


def _shape_tables(solids, fine: bool):
    """Return the table ``shape`` of the shapes of ``solids``, and the other tables by name."""
    names = "edge", "face", "corner", "begin", "edge_point", "face_point", "moment", "cylinder"
    rows, parts = [], {name: [] for name in names}
    # edges, faces, entries of begin, corners, points on edges and on faces, moments, numbers of cylinders
    counts = np.zeros(8, int)
    for shape, moments in ((solid.shape, solid.moments) for solid in solids):
        edges, faces = shape.edge_rows(), shape.normals
        replacing = np.c_[moments.positions, moments.volumes]
        begin = np.append(0, np.cumsum([len(face) for face in shape.faces]))
        on_edges, on_faces = _in_chunks(shape.edge_points()), _in_chunks(shape.face_points(fine=fine))
        on_rims, on_ends = map(_in_chunks, shape.end_points(fine=fine))
        in_body = _in_chunks(replacing)
        edge_points, face_points, rim_points, end_points, moment_points = (
            CHUNK * len(chunks) for chunks in (on_edges, on_faces, on_rims, on_ends, in_body)
        )
        exact, start = shape.cylinder, counts.tolist()
        place = [] if exact is None else [*exact.center, *exact.axis, exact.radius, exact.half_height]
        rows.append([
            start[0], len(edges), start[1], len(faces), start[2], start[3],
            start[4], edge_points, start[5], face_points,
            start[6], len(replacing), start[7] if len(place) else -1,
            start[4] + edge_points, rim_points, start[5] + face_points, end_points,
        ])  # fmt: skip
        corners = shape.corners[np.concatenate([np.asarray(face) for face in shape.faces])]
        edge_tables, face_tables = np.concatenate([on_edges, on_rims]), np.concatenate([on_faces, on_ends])
        values = edges, faces, corners, begin, edge_tables, face_tables, in_body, place
        for name, part in zip(parts, values, strict=True):
            parts[name].append(np.asarray(part).reshape(-1))
        points = edge_points + rim_points, face_points + end_points, moment_points
        counts += [len(edges), len(faces), len(begin), len(corners), *points, len(place)]
    return np.array(rows, np.int32), {name: np.concatenate(part) for name, part in parts.items()}
