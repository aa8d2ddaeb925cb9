"""Cells of inducible bodies, for the fields of permanent bodies near them, and their arrays on a device.

``near_cells.h`` describes what is computed. Cells are listed in the order of their moments, and so of their worlds.
"""

from collections.abc import Sequence
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from warpmag.kernels.applied.solids import of_each_shape
from warpmag.kernels.material.curves import curve_slope, inverse_curve_ratio
from warpmag.kernels.shared.copies import put_copies, repeat_rows
from warpmag.kernels.shared.native import native_options
from warpmag.kernels.shared.reductions import most_blocks

FACE_SPLIT = 4  # squares along each side of a face
FACE_POINTS = FACE_SPLIT**2  # points of a face; as in ``near_cells.h``
COARSE_LENGTH = 16  # points of a cell for differences at a distance, and padding; as in ``near_cells.h``
_WIDEST = 16  # numbers of points are multiples of it, the longest vector of a CPU
NEAR = 2  # value of ``near`` of cells over which fields are averaged; as in ``near_cells.h``
CELL_REACH = 0.75, 1.25
"""Distances from a body's box at which averages start to turn into the field at the center, and are it, in longest
sides of a cell. At a distance of one side both differ by 2 to 3 %."""
STEEP_REACH = 1.5, 2.5
"""The same distances for the difference of the field between the halves of a cell. With 4 and 6 sides forces change by
at most 2 %, and a step with a magnet 5 mm over a plate takes twice the time."""
_THICK = 1e3
"""Depth of cells that have another cell behind each outer face, over the longest side of a face."""
_LEAST_INVERSE_PERMEABILITY = 1e-6


class NearCellBody(NamedTuple):
    """An inducible body of cells."""

    first: int  # first moment
    coupling: Any  # the ``warpmag.shapes.demagnetization.Coupling`` of its cells
    response: np.ndarray  # R of the faces of whole cells [m] (``near_cells.h``), shape [3, FACE_POINTS, FACE_POINTS]


@cache
def cell_arrays_type(dtype):
    """Return the struct of the cells."""
    vec3, quaternion = wp.types.vector(3, dtype), wp.types.quaternion(dtype)

    @wp.struct
    class CellArrays:
        # Cells of a shape, of all shapes one after the other, shape [rows]:
        form: wp.array[wp.vec4i]  # bits of the faces on the body's surface (−x, +x, −y, ...), index of its matrices,
        # first number of its fine points in ``point``, number of these points
        half: wp.array2d[dtype]  # half sides [m], shape [rows, 3]
        neighbor: wp.array2d[int]  # index of the neighbor on each side, less that of the cell, shape [rows, 6]
        weight: wp.array2d[dtype]  # weights of a cell and of its neighbors in its differences, shape [rows, 12]
        layer: wp.array2d[dtype]  # factors of differences across layers (``shared/layer.h``), shape [rows, 3]
        depth: wp.array[dtype]  # depth behind a face over its longest side, ``_THICK`` unless the body ends behind
        # Cells, shape [cells]:
        row: wp.array[int]  # row of the cell in the arrays of shapes
        cell: wp.array[wp.vec4i]  # moment, index of its body in ``rotation``, range of permanent bodies
        factor: wp.array[dtype]  # of the charges on faces of near cells at the last forces (:func:`_image_factor`)
        active: wp.array[int]  # on a GPU the number of cells that are evaluated, then these; None for all
        listed: wp.array[int]  # on a GPU the cells near a body (``listed_cell`` in near_cells.h), shape [cells + 2]
        # Bodies, shape [bodies]:
        rotation: wp.array[quaternion]  # from each body's frame to the world
        grid: wp.array2d[dtype]  # axes of the grid in the body's frame, shape [bodies, 9]
        # Tables:
        response: wp.array[dtype]  # R [m] of faces across x, y and z, shape [kinds, 3, FACE_POINTS, FACE_POINTS]
        point: wp.array[dtype]  # coarse points of a cell, then the fine points of all kinds of outer faces
        cylinder: wp.array[int]  # first number in ``cylinders`` of each permanent shape, -1 for polyhedra
        cylinders: wp.array[dtype]  # places and tables of cylinders (``cylinder.h``)
        # Moments, shape [n]:
        movable: wp.array[int]
        forces: wp.array[vec3]  # [N], added to
        torques: wp.array[vec3]  # about the moments' positions [N·m], added to
        # Data out:
        change: wp.array[vec3]  # change of the field that exerts torques by the averages [A/m], shape [cells]
        steepness: wp.array[vec3]  # half the difference of the field between a cell's halves, as it acts on differences
        # between neighbors (``shared/layer.h``), along the grid [A/m], shape [cells]
        wrench: wp.array2d[
            dtype
        ]  # force/μ0 and torque/μ0 of a source that is the only one [A²], [A² m], shape [cells, 6]
        near: wp.array[int]  # how near a body is that acts on a cell: 0, 1 for differences, NEAR, shape [cells]
        potential: wp.array[
            dtype
        ]  # potential of these bodies at points of outer faces [A], shape [cells · 6 FACE_POINTS]

    return CellArrays


def coarse_points() -> np.ndarray:
    """Return points of a cell for differences at a distance: the centers of its faces, and of itself.

    Rows are the positions in a cube of half side 1, the charges by moments along the axes, which are 0 here, and those
    by differences of the halves along the axes, shape [9, COARSE_LENGTH].
    """
    points = np.zeros((9, COARSE_LENGTH))
    for face in range(6):
        axis = face // 2
        points[axis, face], points[6 + axis, face] = 2.0 * (face % 2) - 1.0, 1.0
        points[6 + axis, 6] = -2.0
    return points


def fine_points(outer: int) -> np.ndarray:
    """Return points of a cell near a magnet, with rows as those of :func:`coarse_points`, shape [9, points].

    ``outer`` has a bit for each face on the body's surface (−x, +x, −y, ...). These faces come first, with the middles
    of FACE_POINTS squares, where charges respond. The other faces, and the planes x, y, z = 0, have four Gauss points:
    they are further from magnets, or the potential varies less over them.
    """
    middles, gauss = (2.0 * np.arange(FACE_SPLIT) + 1.0) / FACE_SPLIT - 1.0, np.array([-1.0, 1.0]) / np.sqrt(3.0)
    faces = sorted(range(6), key=lambda face: not outer >> face & 1)
    blocks = [_square(face // 2, 2.0 * (face % 2) - 1.0, middles if outer >> face & 1 else gauss) for face in faces]
    blocks += [_square(axis, 0.0, gauss) for axis in range(3)]
    points = np.concatenate(blocks, axis=1)
    return np.pad(points, ((0, 0), (0, -points.shape[1] % _WIDEST)))


def _square(axis: int, height: float, line: np.ndarray) -> np.ndarray:
    """Return points across an axis, on the squares of ``line``, and their charges; those of the middle are −2."""
    count = len(line) ** 2
    points = np.zeros((9, count))
    first, second = (k for k in range(3) if k != axis)
    points[axis] = height
    points[first], points[second] = (values.ravel() for values in np.meshgrid(line, line, indexing="ij"))
    points[3 + axis], points[6 + axis] = height / count, (1.0 if height else -2.0) / count
    return points


def _axes(rotation: np.ndarray) -> np.ndarray:
    """Return the axes x, y and z of a frame, from its quaternion (x, y, z, w), shape [9]."""
    vector, w = rotation[:3], rotation[3]
    axes = np.eye(3)
    twice = 2.0 * np.cross(vector, axes)
    return (axes + w * twice + np.cross(vector, twice)).ravel()


def _table(coupling, kind: int, scalar) -> dict[str, np.ndarray]:
    """Return the rows of the cells of the ``kind``-th shape, by the names of arrays in :func:`cell_arrays_type`.

    The columns of ``form`` that refer to points are still 0.
    """
    count = len(coupling.radii)
    bits, zeros = coupling.outer_faces @ (1 << np.arange(6)), np.zeros(count)
    return {
        "form": np.column_stack([bits, np.full(count, kind), zeros, zeros]).astype(np.int32),
        "half": coupling.half_sides.astype(scalar),
        "neighbor": (coupling.neighbor - np.arange(count)[:, None]).astype(np.int32),
        "weight": coupling.weights.astype(scalar),
        "layer": coupling.layer.astype(scalar),
        "depth": _depths(coupling.outer_faces, coupling.cell_sides).astype(scalar),
    }


def _points_of(tables: Sequence[dict[str, np.ndarray]]) -> np.ndarray:
    """Return the coarse points, then the fine points of each kind of outer faces, and refer to them in the forms."""
    parts, first = [coarse_points()], 9 * COARSE_LENGTH
    forms = [table["form"] for table in tables]
    for outer in np.unique(np.concatenate([form[:, 0] for form in forms])):
        parts.append(fine_points(int(outer)))
        for form in forms:
            form[form[:, 0] == outer, 2:] = first, parts[-1].shape[1]
        first += parts[-1].size
    return np.concatenate([part.ravel() for part in parts])


def _depths(outer_faces: np.ndarray, sides: np.ndarray) -> np.ndarray:
    """Return the depths of cells behind their outer faces, over the longest side of the face, shape [n].

    Cells end there only in layers of one cell.
    """
    of_layer = sides / np.array([max(sides[k - 2], sides[k - 1]) for k in range(3)])
    return np.where(outer_faces.reshape(-1, 3, 2).all(axis=2), of_layer, _THICK).min(axis=1)


def lay_out(arrays, bodies: Sequence[NearCellBody | None], rotations, solids, solid_ranges, dtype, device, copies=1):
    """Fill the struct ``arrays`` for bodies of cells; None stands for a body that takes no part.

    The bodies are those of one of ``copies`` of all worlds.

    Args:
        arrays: The struct of :func:`cell_arrays_type`.
        bodies: The bodies, in the order of ``rotations``.
        rotations: Rotation from each body's frame to the world, Warp array, shape [bodies].
        solids: The permanent bodies (``solids.SolidMagnet``).
        solid_ranges: Range of the permanent bodies in the world of each moment, shape [n, 2].
        dtype: Warp scalar type.
        device: Warp device.
        copies: Number of copies.
    """

    def put(values, kind=wp.int32):
        return wp.array(np.ascontiguousarray(values), dtype=kind, device=device)

    def put_cells(values, kind, step=0):
        return put_copies(values, kind, device, copies, step)

    numbers = sorted((k for k, body in enumerate(bodies) if body is not None), key=lambda k: bodies[k].first)
    used = [bodies[number] for number in numbers]
    # bodies of many worlds have few shapes
    of_shape = {id(body.coupling): body for body in used}
    kinds, shapes = {key: k for k, key in enumerate(of_shape)}, list(of_shape.values())
    kind = np.array([kinds[id(body.coupling)] for body in used])
    tables = [_table(body.coupling, k, wp.dtype_to_numpy(dtype)) for k, body in enumerate(shapes)]
    sizes = np.array([len(table["form"]) for table in tables])
    counts, begins = sizes[kind], (np.cumsum(sizes) - sizes)[kind]
    points = _points_of(tables)
    types = {"form": wp.vec4i, "half": dtype, "neighbor": wp.int32, "weight": dtype, "layer": dtype, "depth": dtype}
    for name, warp_type in types.items():
        setattr(arrays, name, put(np.concatenate([table[name] for table in tables]), warp_type))
    firsts = np.array([body.first for body in used])
    of_bodies = np.column_stack([begins, firsts, numbers, solid_ranges[firsts]]).astype(np.int32)
    of_bodies[:, :2] -= (np.cumsum(counts) - counts).astype(np.int32)[:, None]  # rows and moments count up in a body
    cells = np.repeat(of_bodies, counts, axis=0)
    cells[:, :2] += np.arange(len(cells), dtype=np.int32)[:, None]
    steps = [len(solid_ranges), len(bodies), len(solids), len(solids)]
    arrays.row, arrays.cell = put_cells(cells[:, 0], wp.int32), put_cells(cells[:, 1:], wp.vec4i, steps)
    grids = np.zeros((len(bodies), 9))
    grids[numbers] = np.array([_axes(body.coupling.grid_rotation) for body in shapes])[kind]
    arrays.grid, arrays.rotation = put(repeat_rows(grids, copies), dtype), rotations
    arrays.point = put(points, dtype)
    arrays.response = put(np.concatenate([body.response.ravel() for body in shapes]), dtype)
    potentials = [
        solid.shape.potential_table() if solid.potential is None else solid.potential
        for solid in of_each_shape(solids).values()
    ]
    ends = np.cumsum([len(potential) for potential in potentials])
    arrays.cylinder = put([end - len(p) if len(p) else -1 for end, p in zip(ends, potentials, strict=True)])
    arrays.cylinders = put(np.concatenate(potentials), dtype)
    _allocate(arrays, copies * len(cells), dtype, device)


def _allocate(arrays, count: int, dtype, device):
    """Allocate the results of ``count`` cells in the struct ``arrays``."""
    vec3 = wp.types.vector(3, dtype)
    arrays.wrench = wp.empty((count, 6), dtype=dtype, device=device)
    arrays.near, arrays.factor, arrays.change, arrays.steepness = (
        wp.zeros(count, dtype=kind, device=device) for kind in (wp.int32, dtype, vec3, vec3)
    )
    if device.is_cuda:
        arrays.listed = wp.zeros(2 + count, dtype=wp.int32, device=device)
    # large, and read only where a pass has written it before: zeros would take longer than all else on a CPU
    arrays.potential = wp.empty(count * 6 * FACE_POINTS, dtype=dtype, device=device)


@wp.func
def _inverse_permeability(slope: Any):
    """Return 1/μ from the slope 3χ/(3 + χ) of a ball, at least :data:`_LEAST_INVERSE_PERMEABILITY`."""
    inverse = (type(slope)(3.0) - slope) / (type(slope)(3.0) + type(slope)(2.0) * slope)
    return wp.max(inverse, type(slope)(_LEAST_INVERSE_PERMEABILITY))


@wp.func
def _image_factor(along: Any, across: Any, depth: Any):
    """Return the charge on a plate in front of a source, over that on an ideally permeable one.

    ``along`` and ``across`` are 1/μ of the plate along its magnetization and perpendicular to it. The source varies
    along the magnetization as a wave of half a period on a length l, and the plate has the thickness ``depth`` l.
    """
    unit, wave = type(along)(1.0), type(along)(-2.0 * wp.pi)
    mean = wp.sqrt(along * across)
    face = (unit - mean) / (unit + mean)
    # factor of the wave after its way to the other face and back
    echo = wp.exp(wave * depth * wp.sqrt(across / along))
    return face * (unit - echo) / (unit - face * face * echo)


@cache
def _image_factor_kernel(dtype):
    cells_struct, vec3 = cell_arrays_type(dtype), wp.types.vector(3, dtype)

    @wp.kernel(module="unique", enable_backward=False, module_options=native_options("material/curves.h", dtype=dtype))
    def write_image_factors(
        moments: wp.array[vec3],
        radii: wp.array[dtype],
        saturation: wp.array[dtype],
        slope: wp.array[dtype],
        curve: wp.array[int],
        tables: wp.array2d[dtype],
        cells: cells_struct,
    ):
        c = wp.tid()
        if cells.active:
            if c >= cells.active[0]:
                return
            c = cells.active[c + 1]
        if cells.near[c] != wp.static(NEAR):
            return
        i = cells.cell[c][0]
        k, volume = slope[i], dtype(4.18879020478639) * radii[i] * radii[i] * radii[i]
        reduced = wp.length(moments[i]) / (volume * saturation[i])
        ratio = inverse_curve_ratio(reduced, k, curve[i], tables)
        along = _inverse_permeability(k * curve_slope(ratio * reduced, k, curve[i], tables))
        cells.factor[c] = _image_factor(along, _inverse_permeability(k / ratio), cells.depth[cells.row[c]])

    return write_image_factors


def launch_image_factors(launch, arrays, moments, radii, material):
    """Write the factors of the charges on faces of near cells, for the permeabilities at their magnetizations.

    Args:
        launch: The ``RecordedLaunches`` of the caller.
        arrays: The struct of :func:`cell_arrays_type`.
        moments: Moments [A·m²], shape [n].
        radii: Radii of their balls [m], shape [n].
        material: Their curves (``material.curves.CurveParameters``).
    """
    values = moments, radii, material.saturation, material.slope, material.curve, material.tables
    kernel = _image_factor_kernel(arrays.factor.dtype)
    most = most_blocks(moments.device) if arrays.active else 0
    launch(kernel, arrays.cell.shape[0], inputs=[*values, arrays], max_blocks=most, device=moments.device)


def energies(arrays) -> np.ndarray:
    """Return the energies over μ0 of the charges on the faces of cells, −½ φᵀ R φ, shape [cells]."""
    near = np.flatnonzero(arrays.near.numpy() == NEAR)
    forms, factors = arrays.form.numpy()[arrays.row.numpy()[near]], arrays.factor.numpy()[near].astype(float)
    potentials = arrays.potential.numpy().reshape(-1, 6, FACE_POINTS)[near]
    matrices = arrays.response.numpy().reshape(-1, 3, FACE_POINTS, FACE_POINTS)[forms[:, 1]].astype(float)
    is_outer = (forms[:, :1] >> np.arange(6) & 1).astype(bool)
    place = np.where(is_outer, np.cumsum(is_outer, axis=1) - 1, 0)  # outer faces come first in ``potential``
    of_faces = np.take_along_axis(potentials, place[:, :, None], axis=1)
    of_faces = np.where(is_outer[:, :, None], of_faces, 0).astype(float)  # the rest was never written
    result = np.zeros(len(arrays.near))
    result[near] = -0.5 * factors * np.einsum("cfi,cfij,cfj->c", of_faces, np.repeat(matrices, 2, axis=1), of_faces)
    return result
