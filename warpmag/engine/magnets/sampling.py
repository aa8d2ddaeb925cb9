"""From Newton's shapes to the moments that stand for them."""

from dataclasses import dataclass
from typing import Any

import newton
import numpy as np
import warp as wp

from warpmag.engine.magnets.attributes import unique_rows
from warpmag.errors import InputError
from warpmag.moments.arrays import RADIUS_RANGE
from warpmag.shapes import lattice, polyhedra
from warpmag.shapes.demagnetization import Coupling, coupling
from warpmag.shapes.polyhedra import Polyhedron
from warpmag.shapes.solids import boxes_meet
from warpmag.shapes.uniform_response import with_surface_response

_REACH = 3.0
"""How far the closed form of a permanent magnet reaches where it is a lattice from afar, in cells."""


@dataclass(frozen=True)
class ClosedForm:
    """One shape of a permanent magnet whose field is a closed form close up.

    Attributes:
        first, count: Its moments among those of the magnet.
        shape: What bounds it, in the frame of the body.
        reach: Distance up to which the closed form counts [m].
    """

    first: int
    count: int
    shape: Polyhedron
    reach: float


@dataclass(frozen=True)
class BodyLattice:
    """Moments of one magnet in the frame of its body, grouped by shape.

    Attributes:
        positions: Positions [m], shape [n, 3].
        volumes: Volumes [m³], shape [n].
        radii: Radii of the balls that the moments are averaged over [m], shape [n].
        counts: Moments of each shape, in the order of the shapes.
        coupling: What inducible moments lack among themselves as balls; None of permanent ones, and of balls apart.
        solids: The parts of a permanent magnet whose fields are closed forms close up; none of others, and of balls.
    """

    positions: np.ndarray
    volumes: np.ndarray
    radii: np.ndarray
    counts: np.ndarray
    coupling: Coupling | None = None
    solids: tuple[ClosedForm, ...] = ()


class ShapeSampler:
    """Samples shapes of one model; shapes that are alike, in many worlds say, are sampled once."""

    def __init__(self, model: newton.Model):
        """Read the geometry of ``model``."""
        self._labels, self._sources = model.shape_label, model.shape_source
        self._bodies = model.shape_body.numpy()
        self._types, self._scales = model.shape_type.numpy(), model.shape_scale.numpy().astype(float)
        self._frames = model.shape_transform.numpy().astype(float)
        numbers = np.column_stack([self._types, _number_sources(self._sources), self._scales, self._frames])
        self.kinds = unique_rows(numbers)[1]
        self._known: dict[tuple, BodyLattice] = {}

    def sample(self, shapes: list[int], spacing: float, permanent: bool, closed: bool) -> BodyLattice:
        """Return the moments of one magnet.

        Balls apart from each other are one moment each if ``spacing`` is 0. Everything else is filled with moments,
        as one solid: volume that shapes have in common is counted once, for the first of them.

        Args:
            shapes: Shapes of one body, or one static shape.
            spacing: Distance between moments [m]; 0 for automatic.
            permanent: Whether the moments are fixed: their field is not averaged over more than their cells then.
            closed: Whether closed forms stand for them close up, where there are some.
        """
        key = (spacing, permanent, closed, *self.kinds[shapes].tolist())
        if key not in self._known:
            try:
                self._known[key] = _within_range(self._sample(shapes, spacing, permanent, closed))
            except InputError as error:
                raise InputError(f"{self._labels[shapes[0]]}: {error}") from None
        return self._known[key]

    def _sample(self, shapes: list[int], spacing: float, permanent: bool, closed: bool) -> BodyLattice:
        if spacing == 0.0 and self._are_balls_apart(shapes):
            balls = [lattice.ball(self._scales[shape, 0]) for shape in shapes]
            return BodyLattice(
                np.concatenate([self._frames[shape, None, :3] for shape in shapes]),
                np.concatenate([one.volumes for one in balls]),
                np.concatenate([one.radii for one in balls]),
                np.ones(len(shapes), dtype=int),
            )
        solids = [self._solid(shape).posed(self._frames[shape, :3], self._frames[shape, 3:]) for shape in shapes]
        bounds = self._polyhedra(shapes, solids) if closed else []
        if bounds and permanent and spacing == 0.0:
            return self._close_up(shapes, solids, bounds)
        across = 1 if permanent else lattice.LEAST_ACROSS
        filled = lattice.fill(solids, spacing, across, together=not permanent)
        counts = np.bincount(filled.owners, minlength=len(solids))
        ends, grids = np.cumsum(counts), filled.pieces if permanent else filled.pieces * len(solids)
        parts = tuple(
            ClosedForm(int(end - count), int(count), shape, _REACH * float(one.sides.max()))
            for end, count, shape, one in zip(ends, counts, bounds, grids, strict=bool(bounds))
        )
        if permanent:
            return BodyLattice(filled.positions, filled.volumes, filled.inner_radii, counts, solids=parts)
        cells = with_surface_response(coupling(filled, filled.radii), filled, solids)
        return BodyLattice(filled.positions, filled.volumes, filled.radii, counts, cells, parts)

    def _polyhedra(self, shapes: list[int], solids: list[lattice.Solid]) -> list[Polyhedron]:
        """What bounds boxes and cylinders apart from each other, in the frame of their body; nothing for others."""
        kinds, found = newton.GeoType, []
        for shape, solid in zip(shapes, solids, strict=True):
            kind, scale = self._types[shape], self._scales[shape]
            if kind not in (kinds.BOX, kinds.CYLINDER) or any(boxes_meet(solid, one) for one in solids[: len(found)]):
                return []
            own = polyhedra.box(scale) if kind == kinds.BOX else polyhedra.cylinder(scale[0], scale[1])
            found.append(own.posed(solid.position, solid.rotation))
        return found

    def _close_up(self, shapes: list[int], solids: list[lattice.Solid], closed: list[Polyhedron]) -> BodyLattice:
        """Moments of permanent boxes and cylinders, which are closed forms close up."""
        places, volumes, radii, parts, first = [], [], [], [], 0
        for shape, solid, bound in zip(shapes, solids, closed, strict=True):
            scale = self._scales[shape]
            box = self._types[shape] == newton.GeoType.BOX
            found = polyhedra.box_moments(scale) if box else polyhedra.cylinder_moments(scale[0], scale[1])
            places.append(solid.to_body(found.places))
            volumes.append(found.volumes)
            radii.append(np.minimum(0.5 * np.cbrt(found.volumes), found.depths))
            parts.append(ClosedForm(first, len(found.volumes), bound, found.reach))
            first += len(found.volumes)
        counts = np.array([part.count for part in parts])
        return BodyLattice(
            np.concatenate(places), np.concatenate(volumes), np.concatenate(radii), counts, solids=tuple(parts)
        )

    def _are_balls_apart(self, shapes: list[int]) -> bool:
        if (self._types[shapes] != newton.GeoType.SPHERE).any():
            return False
        centers, radii = self._frames[shapes, :3], self._scales[shapes, 0]
        distances = np.linalg.norm(centers[:, None] - centers, axis=2) + 3.0 * np.diag(radii)
        return bool((distances >= (radii[:, None] + radii) * (1.0 - 1e-5)).all())

    def _solid(self, shape: int) -> lattice.Solid:
        kinds, kind, scale = newton.GeoType, self._types[shape], self._scales[shape]
        if kind == kinds.SPHERE:
            return lattice.sphere(scale[0])
        if kind == kinds.BOX:
            return lattice.box(scale)
        if kind == kinds.ELLIPSOID:
            return lattice.ellipsoid(scale)
        if kind == kinds.CAPSULE:
            return lattice.capsule(scale[0], scale[1])
        if kind == kinds.CYLINDER and scale[2] == 0.0:
            return lattice.cylinder(scale[0], scale[1])
        if kind == kinds.CONE:
            return lattice.cone(scale[0], scale[1])
        if kind in (kinds.MESH, kinds.CONVEX_MESH):
            source: Any = self._sources[shape]
            return lattice.mesh(np.asarray(source.vertices, float) * scale, np.asarray(source.indices).reshape(-1, 3))
        raise InputError("a cylinder with a barrel side cannot be magnetized")


def _number_sources(sources: list) -> list[int]:
    """Number what shapes are made of: 0 for nothing, and one number for all meshes of the same points and triangles."""
    of_contents: dict[Any, int] = {}
    of_object: dict[int, int] = {id(None): 0}
    for source in sources:
        if id(source) not in of_object:
            contents = id(source)
            if hasattr(source, "vertices"):
                contents = tuple(np.asarray(array).tobytes() for array in (source.vertices, source.indices))
            of_object[id(source)] = of_contents.setdefault(contents, 1 + len(of_contents))
    return [of_object[id(source)] for source in sources]


def _within_range(sampled: BodyLattice) -> BodyLattice:
    """Return moments, which a simulation has in single precision; ``InputError`` if they are out of its range."""
    (least, most), radii = RADIUS_RANGE[wp.float32], sampled.radii
    if not ((radii >= least) & (radii <= most)).all():
        found = f"{radii.min():.3g} to {radii.max():.3g} m"
        raise InputError(f"its moments have radii of {found}, not of {least:g} to {most:g}")
    return sampled
