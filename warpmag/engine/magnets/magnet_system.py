"""Builds the :class:`MomentSystem` of the magnets of a Newton model."""

import newton
import numpy as np

from warpmag.declarations.magnets import LINEAR_CURVE, MagneticSettings
from warpmag.engine.magnets.equal_worlds import EqualWorlds, kinematic_bodies
from warpmag.engine.magnets.grouping import BodyMagnet
from warpmag.kernels.applied.solids import SolidMagnet
from warpmag.kernels.near_contact.images import IronFaces
from warpmag.moments.cached_shapes import shape_cache
from warpmag.moments.layout import MomentMaterial
from warpmag.moments.settings import SolverSettings
from warpmag.moments.system import MomentSystem


def make_system(
    model: newton.Model, worlds: EqualWorlds, settings: MagneticSettings, *, curve, sources, **options
) -> MomentSystem:
    """Return the system of the moments of all magnets of a model.

    ``curve`` replaces the curves of all inducible magnets; None keeps them. See :class:`MomentSystem` for
    ``sources``, and :class:`SolverSettings` for further ``options``.
    """
    magnets = worlds.magnets
    counts = [len(magnet.lattice.volumes) for magnet in magnets]

    def per_moment(values, dtype=float):
        return np.repeat(np.asarray(values, dtype=dtype), counts)

    first = (np.cumsum(counts) - counts).tolist()
    coupled = [(k, magnet) for k, magnet in zip(first, magnets, strict=True) if magnet.lattice.coupling is not None]
    materials = [magnet.magnet for magnet in magnets]
    # each static magnet of a world counts as a body, numbered after the bodies of the model
    static = np.cumsum([magnet.body < 0 for magnet in magnets]) + model.body_count
    bodies = [magnet.body if magnet.body >= 0 else k for magnet, k in zip(magnets, static.tolist(), strict=True)]
    kinematic = kinematic_bodies(model).tolist()
    movable = [magnet.body >= 0 and not kinematic[magnet.body] for magnet in magnets]
    near_cells = any(magnet.lattice.coupling.near for _, magnet in coupled)
    potentials = _potentials(model, magnets) if near_cells else {}
    solids = [
        _solid_magnet(k, magnet, can_move, part, potentials.get(id(part.shape)))
        for k, magnet, can_move in zip(first, magnets, movable, strict=True)
        for part in magnet.lattice.solids
    ]
    curves = [LINEAR_CURVE if material.recoils else curve or material.curve for material in materials]
    return MomentSystem(
        worlds=per_moment([magnet.world for magnet in magnets], int),
        permanent=per_moment([material.fixed for material in materials], bool),
        radii=np.concatenate([magnet.lattice.radii for magnet in magnets]),
        bodies=per_moment(bodies, int),
        movable=per_moment(movable, bool),
        material=MomentMaterial(
            per_moment([material.saturation for material in materials]),
            per_moment([m.recoil_permeability - 1.0 if m.recoils else m.susceptibility for m in materials]),
            curves,
            curve_counts=counts,
        ),
        external_field=settings.external_field,
        settings=SolverSettings(
            settings.force, settings.dynamics, settings.contact_model, rtol=settings.rtol, **options
        ),
        couplings=[(k, magnet.lattice.coupling) for k, magnet in coupled],
        solids=solids,
        faces=[_iron_faces(number, k, magnet) for number, (k, magnet) in enumerate(coupled) if _has_faces(magnet)],
        copies=worlds.copies,
        body_step=worlds.body_step,
        body_extent=_largest_extent(magnets, np.array(bodies), np.array(movable)),
        sources=sources,
        device=model.device,
    )


def _has_faces(magnet: BodyMagnet) -> bool:
    return magnet.lattice.faces is not None and len(magnet.lattice.faces.planes) > 0


def _iron_faces(number: int, first: int, magnet: BodyMagnet) -> IronFaces:
    """Return the flat faces of the magnet with coupling ``number``. ``first`` is its first moment in the system."""
    lattice, faces = magnet.lattice, magnet.lattice.faces
    assert faces is not None
    count = len(lattice.volumes)
    return IronFaces(number, first, count, magnet.world, lattice.positions[0], faces.planes, faces.edges)


def _potentials(model: newton.Model, magnets: list[BodyMagnet]) -> dict[int, np.ndarray]:
    """Return the tables of the potential of cylinders by the identity of their shape, from the cache of shapes."""
    shapes = {id(part.shape): (part.shape, magnet) for magnet in magnets for part in magnet.lattice.solids}
    tables = {}
    for key, (shape, magnet) in shapes.items():
        if (cylinder := shape.cylinder) is not None:
            of = "potential", cylinder.radius, cylinder.half_height, cylinder.center, cylinder.axis
            name = f"{model.shape_label[magnet.shapes[0]]}: potential"
            tables[key] = shape_cache().get(name, of, shape.potential_table)
    return tables


def _solid_magnet(first: int, magnet: BodyMagnet, movable: bool, part, potential) -> SolidMagnet:
    """Return the record of a part with a closed form. ``first`` is the first moment of its magnet in the system."""
    # the response of recoil, 3χ/(3 + χ) = 3 (μ − 1)/(μ + 2)
    lattice, response = magnet.lattice, 3.0 - 9.0 / (2.0 + magnet.magnet.recoil_permeability)
    volume, first = float(lattice.volumes[part.first]), first + part.first
    places = first, part.count, volume, magnet.world, part.reach
    return SolidMagnet(*places, part.shape, part.moments, movable, response, part.far_reach, potential)


def _largest_extent(magnets: list[BodyMagnet], bodies: np.ndarray, movable: np.ndarray) -> float:
    """Return an upper bound of the distance between moments of a movable body [m]; 0 if each has one moment.

    ``bodies`` and ``movable`` have an entry for each magnet.
    """
    if not movable.any():
        return 0.0
    lattices = {id(magnet.lattice): magnet.lattice.positions for magnet in magnets}
    boxes = {key: (positions.min(axis=0), positions.max(axis=0)) for key, positions in lattices.items()}
    order = np.flatnonzero(movable)[np.argsort(bodies[movable], kind="stable")]
    corners = np.array([boxes[id(magnets[k].lattice)] for k in order.tolist()])
    starts = np.flatnonzero(np.diff(bodies[order], prepend=bodies[order[0]] - 1))
    low, high = np.minimum.reduceat(corners[:, 0], starts), np.maximum.reduceat(corners[:, 1], starts)
    return float(np.linalg.norm(high - low, axis=1).max())
