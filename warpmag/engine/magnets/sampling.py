"""Sampling of Newton's shapes: the moments that represent them."""

import contextlib
from dataclasses import dataclass
from typing import Any

import newton
import numpy as np
import warp as wp

from warpmag.declarations.magnets import Magnet, check_sizes
from warpmag.declarations.rotations import rotate
from warpmag.engine.magnets.attributes import close_rows, unique_rows
from warpmag.errors import InputError
from warpmag.moments.arrays import RADIUS_RANGE
from warpmag.moments.cached_shapes import shape_cache
from warpmag.shapes import lattice, polyhedra
from warpmag.shapes.demagnetization import Coupling, coupling
from warpmag.shapes.flat_faces import FlatFaces, faces_of_mesh, faces_of_polyhedron, joined
from warpmag.shapes.polyhedra import Moments, Polyhedron
from warpmag.shapes.solids import boxes_meet
from warpmag.shapes.uniform_response import with_surface_response

_REACH = 3.0
"""Distance up to which the closed form of a magnet replaces its lattice of cells, in cell sizes."""
_LARGEST_CLOSED_FORM = 4096
"""Largest number of moments of a permanent magnet whose near field has a closed form. More moments make only the fields
of coils and maps more accurate. The force between two magnets near each other visits all pairs of moments."""
_ROUNDING = 1e-5
"""Relative difference up to which sizes and frames of shapes are equal: 80 units in the last place of float32. Frames
come from products of transforms, which round differently for each instance of a prototype."""
_SOLIDS = {
    newton.GeoType.SPHERE: (lattice.sphere, 1),
    newton.GeoType.CAPSULE: (lattice.capsule, 2),
    newton.GeoType.CYLINDER: (lattice.cylinder, 2),
    newton.GeoType.CONE: (lattice.cone, 2),
    newton.GeoType.BOX: (lattice.box, 3),
    newton.GeoType.ELLIPSOID: (lattice.ellipsoid, 3),
}
"""Function that returns the solid of a type of shapes, and the number of lengths in the scale of the shape."""


@dataclass(frozen=True)
class ClosedForm:
    """A shape of a permanent magnet with a closed form of its near field."""

    first: int  # first moment of the shape in its magnet
    count: int  # number of moments
    shape: Polyhedron  # surface, in the frame of the body
    reach: float  # largest distance at which the closed form is used [m]
    moments: Moments  # moments at larger distances, in the frame of the body
    far_reach: float = 0.0  # largest distance at which ``moments`` are used [m], if the magnet itself has fewer


@dataclass(frozen=True)
class BodyLattice:
    """Moments of one magnet in the frame of its body, grouped by shape."""

    positions: np.ndarray  # [m], shape [n, 3]
    volumes: np.ndarray  # [m³], shape [n]
    radii: np.ndarray  # radii of the balls that average the fields of moments [m], shape [n]
    counts: np.ndarray  # number of moments of each shape
    coupling: Coupling | None = None  # tensors between inducible cells, minus the pair law of balls
    solids: tuple[ClosedForm, ...] = ()  # closed forms of the near field of a permanent magnet
    faces: FlatFaces | None = None  # flat faces of inducible cells


class ShapeSampler:
    """Samples the shapes of one model. Equal shapes, for example instances of a prototype, are sampled once."""

    def __init__(self, model: newton.Model, *, few: bool = True):
        """Read the geometry of ``model``. With ``few``, closed forms let permanent magnets have few moments."""
        self._few = few
        # a builder that grows after finalize() appends to the same lists
        self._labels, self._sources = model.shape_label, model.shape_source[: model.shape_count]
        self._types, self._scales = model.shape_type.numpy(), model.shape_scale.numpy().astype(float)
        self._frames = model.shape_transform.numpy().astype(float)
        numbers, reaches = _number_sources(self._sources)
        sizes = np.abs(reaches * self._scales).max(axis=1)
        sizes[~(sizes > 0.0)] = 1.0  # an infinite plane has the scale 0
        columns = [self._types, numbers, sizes, _largest(sizes, model.shape_body.numpy()), self._scales, self._frames]
        rows, row_of = unique_rows(np.column_stack(columns))
        self.kinds = _kinds(*np.split(rows, (2, 3, 4, 7, 10), axis=1))[row_of]
        self._lattices: dict[tuple, BodyLattice] = {}
        self._cache = shape_cache()

    def sample(self, shapes: list[int], magnet: Magnet) -> BodyLattice:
        """Return the moments of a magnet: shapes of one body, or one static shape.

        At automatic spacing, separate balls are one moment each. All other shapes are filled with moments as one solid:
        the common volume of overlapping shapes belongs to the first of them. The fields of fixed moments are averaged
        over balls inside their cells. Permanent magnets have closed forms of their near fields, where possible.
        """
        choices = magnet.moment_spacing, magnet.fixed, magnet.kind == "permanent"
        key = (*choices, *self.kinds[shapes].tolist())
        if key not in self._lattices:
            try:
                self._lattices[key] = _within_range(self._sample(shapes, *choices))
            except InputError as error:
                raise InputError(f"{self._labels[shapes[0]]}: {error}") from None
        return self._lattices[key]

    def _sample(self, shapes: list[int], spacing: float, fixed: bool, permanent: bool) -> BodyLattice:
        for shape in shapes:
            kind = newton.GeoType(self._types[shape])
            check_sizes(kind.name.lower(), lengths_of(kind, self._scales[shape]))
        if spacing == 0.0 and self._are_balls_apart(shapes):
            balls = [lattice.ball(self._scales[shape, 0]) for shape in shapes]
            return BodyLattice(
                np.concatenate([self._frames[shape, None, :3] for shape in shapes]),
                np.concatenate([ball.volumes for ball in balls]),
                np.concatenate([ball.radii for ball in balls]),
                np.ones(len(shapes), dtype=int),
            )
        key = (self._few, spacing, fixed, permanent, *(part for shape in shapes for part in self._content(shape)))
        return self._cache.get(self._labels[shapes[0]], key, lambda: self._fill(shapes, spacing, fixed, permanent))

    def _content(self, shape: int) -> tuple:
        """Return the type, the size, the frame and the mesh of a shape."""
        source: Any = self._sources[shape]
        mesh = (np.asarray(source.vertices), np.asarray(source.indices)) if hasattr(source, "vertices") else ()
        return int(self._types[shape]), self._scales[shape], self._frames[shape], *mesh

    def _fill(self, shapes: list[int], spacing: float, fixed: bool, permanent: bool) -> BodyLattice:
        """Return the moments of shapes that are not separate balls; see :meth:`sample`."""
        solids = [
            solid_of(self._types[shape], self._scales[shape], self._sources[shape]).posed(frame[:3], frame[3:])
            for shape, frame in zip(shapes, self._frames[shapes], strict=True)
        ]
        surfaces = self._polyhedra(shapes, solids) if permanent else []
        if surfaces and fixed and spacing == 0.0:
            return self._sample_closed_forms(shapes, solids, surfaces)
        across, largest = (1 if fixed else lattice.LEAST_ACROSS), lattice.LARGEST_COUNT
        if fixed and surfaces:
            largest = _LARGEST_CLOSED_FORM
        filled = lattice.fill(solids, spacing, across, together=not fixed, largest=largest)
        counts = np.bincount(filled.owners, minlength=len(solids))
        ends, grids = np.cumsum(counts), filled.pieces if fixed else filled.pieces * len(solids)
        parts = []
        for end, count, shape, grid in zip(ends, counts, surfaces, grids, strict=bool(surfaces)):
            own, reach = slice(end - count, end), _REACH * float(grid.sides.max())
            moments = Moments(filled.positions[own], filled.volumes[own], filled.inner_radii[own], reach)
            parts.append(ClosedForm(int(end - count), int(count), shape, reach, moments))
        if fixed:
            return BodyLattice(filled.positions, filled.volumes, filled.inner_radii, counts, solids=tuple(parts))
        cells = coupling(filled, filled.radii)
        if not permanent:
            from warpmag.shapes.linear_cells import with_slopes  # noqa: PLC0415 - SciPy takes a while

            cells = with_slopes(cells, filled)
        with contextlib.suppress(np.linalg.LinAlgError):  # long wires keep the response of their cells
            cells = with_surface_response(cells, filled, solids)
        faces = None if permanent else joined([self._faces(*pair) for pair in zip(shapes, solids, strict=True)])
        return BodyLattice(filled.positions, filled.volumes, filled.radii, counts, cells, tuple(parts), faces)

    def _faces(self, shape: int, solid: lattice.Solid) -> FlatFaces:
        """Return the flat faces of a box, a cylinder or a mesh in the frame of its body; none of other shapes."""
        kinds, kind, scale = newton.GeoType, self._types[shape], self._scales[shape]
        if kind == kinds.BOX:
            return faces_of_polyhedron(polyhedra.box(scale).posed(solid.position, solid.rotation), 6)
        if kind == kinds.CYLINDER:
            surface = polyhedra.cylinder(scale[0], scale[1]).posed(solid.position, solid.rotation)
            return faces_of_polyhedron(surface, 2)
        if kind in (kinds.MESH, kinds.CONVEX_MESH):
            source: Any = self._sources[shape]
            vertices = solid.to_body(np.asarray(source.vertices, float) * scale)
            return faces_of_mesh(vertices, np.asarray(source.indices).reshape(-1, 3))
        return joined([])

    def _polyhedra(self, shapes: list[int], solids: list[lattice.Solid]) -> list[Polyhedron]:
        """Return the surfaces of separate boxes and cylinders, in the frame of the body; empty for other shapes."""
        kinds, surfaces = newton.GeoType, []
        for shape, solid in zip(shapes, solids, strict=True):
            kind, scale, earlier = self._types[shape], self._scales[shape], solids[: len(surfaces)]
            if kind not in (kinds.BOX, kinds.CYLINDER) or any(boxes_meet(solid, other) for other in earlier):
                return []
            surface = polyhedra.box(scale) if kind == kinds.BOX else polyhedra.cylinder(scale[0], scale[1])
            surfaces.append(surface.posed(solid.position, solid.rotation))
        return surfaces

    def _sample_closed_forms(self, shapes: list[int], solids, surfaces: list[Polyhedron]) -> BodyLattice:
        """Return the moments of permanent boxes and cylinders, with closed forms of their near fields."""
        positions, volumes, radii, parts, first = [], [], [], [], 0
        for shape, solid, surface in zip(shapes, solids, surfaces, strict=True):
            scale, box = self._scales[shape], self._types[shape] == newton.GeoType.BOX
            moments = polyhedra.box_moments(scale) if box else polyhedra.cylinder_moments(scale[0], scale[1])
            moments = moments.posed(solid.position, solid.rotation)
            own, own_radii = moments, np.minimum(0.5 * np.cbrt(moments.volumes), moments.depths)
            if self._few:
                own = polyhedra.far_box_moments(scale) if box else polyhedra.far_cylinder_moments(scale[0], scale[1])
                own = own.posed(solid.position, solid.rotation)
                own_radii = np.full(len(own.volumes), own_radii.max())  # larger balls would overlap more of others
            positions.append(own.positions)
            volumes.append(own.volumes)
            radii.append(own_radii)
            parts.append(ClosedForm(first, len(own.volumes), surface, moments.reach, moments, own.reach))
            first += len(own.volumes)
        counts = np.array([part.count for part in parts])
        return BodyLattice(
            np.concatenate(positions), np.concatenate(volumes), np.concatenate(radii), counts, solids=tuple(parts)
        )

    def _are_balls_apart(self, shapes: list[int]) -> bool:
        if (self._types[shapes] != newton.GeoType.SPHERE).any():
            return False
        centers, radii = self._frames[shapes, :3], self._scales[shapes, 0]
        distances = np.linalg.norm(centers[:, None] - centers, axis=2) + 3.0 * np.diag(radii)
        return bool((distances >= (radii[:, None] + radii) * (1.0 - 1e-5)).all())


def lengths_of(kind: int, scale: Any) -> list[float]:
    """Return the radii and half sides [m] of a Newton shape, from its type and scale; empty for a mesh."""
    _, count = _SOLIDS.get(newton.GeoType(kind), (None, 0))
    return [float(length) for length in scale[:count]]


def solid_of(kind: int, scale: np.ndarray, source: Any) -> lattice.Solid:
    """Return the solid of a Newton shape, from its type, its scale [m], shape [3], and its mesh or None."""
    if kind in (newton.GeoType.MESH, newton.GeoType.CONVEX_MESH):
        return lattice.mesh(np.asarray(source.vertices, float) * scale, np.asarray(source.indices).reshape(-1, 3))
    if kind == newton.GeoType.CYLINDER and scale[2] != 0.0:
        raise InputError("a cylinder with a barrel-shaped side cannot be magnetized")
    make, lengths = _SOLIDS[newton.GeoType(kind)]
    return make(scale) if lengths == 3 else make(*scale[:lengths])


def _number_sources(sources: list) -> tuple[list[int], list[np.ndarray]]:
    """Return a number for each geometry source, and its largest coordinates [m], shape [3], before it is scaled.

    The number is 0 for None, and equal for meshes of equal points and triangles. A source without points has ones.
    """
    number_of_contents: dict[Any, int] = {}
    of_object: dict[int, tuple[int, np.ndarray]] = {id(None): (0, np.ones(3))}
    for source in sources:
        if id(source) not in of_object:
            contents, reach = id(source), np.ones(3)
            if hasattr(source, "vertices"):
                points = np.asarray(source.vertices, float).reshape(-1, 3)
                contents = points.tobytes(), np.asarray(source.indices).tobytes()
                reach = np.abs(points).max(axis=0, initial=0.0)
            of_object[id(source)] = number_of_contents.setdefault(contents, 1 + len(number_of_contents)), reach
    numbers, reaches = zip(*(of_object[id(source)] for source in sources), strict=True)
    return list(numbers), list(reaches)


def _largest(sizes: np.ndarray, bodies: np.ndarray) -> np.ndarray:
    """Return the largest size of the shapes of each shape's body, or its own size without a body, shape [n]."""
    moves = bodies >= 0
    largest = np.zeros(bodies.max() + 1)
    np.maximum.at(largest, bodies[moves], sizes[moves])
    result = sizes.copy()
    result[moves] = largest[bodies[moves]]
    return result


def _kinds(exact: np.ndarray, sizes, body_sizes, scales, positions, quaternions: np.ndarray) -> np.ndarray:
    """Return a number for each shape, equal for equal shapes in equal frames, up to rounding, shape [n].

    ``exact`` are integers, shape [n, 2]. Lengths are relative to the size of the shape, positions to the larger of the
    size of the body and the distance from its origin. Rotations are compared as matrices, because q and −q are equal.
    """
    largest = np.abs(scales).max(axis=1, keepdims=True)
    shapes = [np.log(sizes), scales / np.where(largest > 0.0, largest, 1.0)]
    axes = [rotate(quaternions, np.broadcast_to(axis, positions.shape)) for axis in np.eye(3)]
    columns = np.concatenate([*shapes, np.arcsinh(positions / body_sizes), *axes], axis=1)
    return close_rows(unique_rows(exact)[1], columns, _ROUNDING)


def _within_range(sampled: BodyLattice) -> BodyLattice:
    """Return ``sampled``; raise :class:`InputError` if its radii are out of range for single precision."""
    (least, most), radii = RADIUS_RANGE[wp.float32], sampled.radii
    if not ((radii >= least) & (radii <= most)).all():
        raise InputError(
            f"its moments have radii of {radii.min():.3g} to {radii.max():.3g} m, must be {least:g} to {most:g}"
        )
    return sampled
