"""Cells of inducible bodies, for the fields of permanent bodies near them, and their arrays on a device.

``near_cells.h`` describes what is computed. Cells are listed in the order of their moments, and so of their worlds.
"""

from collections.abc import Sequence
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import warp as wp

FACE_SPLIT = 4  # squares along each side of a face
FACE_POINTS = FACE_SPLIT**2  # points of a face; as in ``near_cells.h``
CELL_REACH = 0.75, 1.25
"""Distances from a body's box at which averages start to turn into the field at the center, and are it, in longest
sides of a cell. At a distance of one side both differ by 2 to 3 %."""


class NearCellBody(NamedTuple):
    """An inducible body of cells."""

    first: int  # first moment
    coupling: Any  # the ``warpmag.shapes.demagnetization.Coupling`` of its cells
    response: np.ndarray  # R of the faces of whole cells [m] (``near_cells.h``), shape [3, FACE_POINTS, FACE_POINTS]
    susceptibility: float  # initial slope χ of its curve


@cache
def cell_arrays_type(dtype):
    """Return the struct of the cells."""
    vec3, quaternion = wp.types.vector(3, dtype), wp.types.quaternion(dtype)

    @wp.struct
    class CellArrays:
        # Cells, shape [cells]:
        cell: wp.array[wp.vec4i]  # moment, index of its body in ``rotation``, range of permanent bodies
        form: wp.array[wp.vec2i]  # bits of the faces on the body's surface (−x, +x, −y, ...), index of its matrices
        box: wp.array2d[dtype]  # half sides [m], and χ/(χ + 2), shape [cells, 4]
        # Bodies, shape [bodies]:
        rotation: wp.array[quaternion]  # from each body's frame to the world
        grid: wp.array2d[dtype]  # axes of the grid in the body's frame, shape [bodies, 9]
        # Tables:
        response: wp.array[dtype]  # R [m] of faces across x, y and z, shape [kinds, 3, FACE_POINTS, FACE_POINTS]
        point: wp.array[dtype]  # points on the faces of a cube of half side 1, shape [3, 6 FACE_POINTS]
        # Moments, shape [n]:
        movable: wp.array[int]
        forces: wp.array[vec3]  # [N], added to
        torques: wp.array[vec3]  # about the moments' positions [N·m], added to
        # Data out:
        change: wp.array[vec3]  # change of the field that exerts torques by the averages [A/m], shape [cells]
        near: wp.array[int]  # 1 for cells near a body that acts on them, shape [cells]
        potential: wp.array[dtype]  # potential of these bodies at the points, faded [A], shape [cells, 6 FACE_POINTS]

    return CellArrays


def unit_points() -> np.ndarray:
    """Return the points on the faces −x, +x, −y, ... of a cube of half side 1, shape [3, 6, FACE_POINTS]."""
    middles = (2.0 * np.arange(FACE_SPLIT) + 1.0) / FACE_SPLIT - 1.0
    u, v = (values.ravel() for values in np.meshgrid(middles, middles, indexing="ij"))
    points = np.empty((3, 6, FACE_POINTS))
    for face in range(6):
        axis, (first, second) = face // 2, [k for k in range(3) if k != face // 2]
        points[axis, face], points[first, face], points[second, face] = 2.0 * (face % 2) - 1.0, u, v
    return points


def _axes(rotation: np.ndarray) -> np.ndarray:
    """Return the axes x, y and z of a frame, from its quaternion (x, y, z, w), shape [9]."""
    vector, w = rotation[:3], rotation[3]
    axes = np.eye(3)
    twice = 2.0 * np.cross(vector, axes)
    return (axes + w * twice + np.cross(vector, twice)).ravel()


def lay_out(arrays, bodies: Sequence[NearCellBody | None], rotations, solid_ranges, movable, dtype, device):
    """Fill the struct ``arrays`` for bodies of cells; None stands for a body that takes no part.

    Args:
        arrays: The struct of :func:`cell_arrays_type`.
        bodies: The bodies, in the order of ``rotations``.
        rotations: Rotation from each body's frame to the world, Warp array, shape [bodies].
        solid_ranges: Range of the permanent bodies in the world of each moment, shape [n, 2].
        movable: True for moments whose force is evaluated, shape [n].
        dtype: Warp scalar type.
        device: Warp device.
    """

    def put(values, kind=wp.int32):
        values = np.ascontiguousarray(values, float if kind == dtype else np.int32)
        return wp.array(values, dtype=kind, device=device)

    cells, forms, boxes, grids, tables = [], [], [], np.zeros((len(bodies), 9)), {}
    for number, body in enumerate(bodies):
        if body is None:
            continue
        coupling, count = body.coupling, len(body.coupling.radii)
        table = tables.setdefault(id(coupling), (len(tables), body.response))
        moments = body.first + np.arange(count)
        cells.append(np.column_stack([moments, np.full(count, number), solid_ranges[moments]]))
        bits = coupling.outer_faces @ (1 << np.arange(6))
        forms.append(np.column_stack([bits, np.full(count, table[0])]))
        factor = body.susceptibility / (body.susceptibility + 2.0) if np.isfinite(body.susceptibility) else 1.0
        boxes.append(np.column_stack([coupling.half_sides, np.full(count, factor)]))
        grids[number] = _axes(coupling.grid_rotation)
    order = np.argsort(np.concatenate([rows[:, 0] for rows in cells]), kind="stable")
    arrays.cell = put(np.concatenate(cells)[order], wp.vec4i)
    arrays.form = put(np.concatenate(forms)[order], wp.vec2i)
    arrays.box, arrays.grid = put(np.concatenate(boxes)[order], dtype), put(grids, dtype)
    arrays.rotation, arrays.point = rotations, put(unit_points().ravel(), dtype)
    arrays.response = put(np.concatenate([matrices.ravel() for _, matrices in tables.values()]), dtype)
    arrays.movable = put(movable)
    arrays.near = wp.zeros(len(order), dtype=wp.int32, device=device)
    arrays.change = wp.zeros(len(order), dtype=wp.types.vector(3, dtype), device=device)
    arrays.potential = wp.zeros(len(order) * 6 * FACE_POINTS, dtype=dtype, device=device)


def energies(arrays) -> np.ndarray:
    """Return the energies over μ0 of the charges on the faces of cells, −½ φᵀ R φ, shape [cells]."""
    near = np.flatnonzero(arrays.near.numpy())
    forms, factors = arrays.form.numpy()[near], arrays.box.numpy()[near, 3].astype(float)
    potentials = arrays.potential.numpy().reshape(-1, 6, FACE_POINTS)[near].astype(float)
    matrices = arrays.response.numpy().reshape(-1, 3, FACE_POINTS, FACE_POINTS)[forms[:, 1]].astype(float)
    of_faces = np.einsum("cfi,cfij,cfj->cf", potentials, np.repeat(matrices, 2, axis=1), potentials)
    result = np.zeros(len(arrays.near))
    result[near] = -0.5 * factors * (of_faces * (forms[:, :1] >> np.arange(6) & 1)).sum(axis=1)
    return result
