"""The moments that stand for the magnets of a Newton model, as a system that can be solved."""

import newton
import numpy as np

from warpmag.declarations.magnets import LINEAR_CURVE, MagneticSettings
from warpmag.engine.magnets.grouping import BodyMagnet
from warpmag.kernels.applied.solids import SolidMagnet
from warpmag.moments.layout import Material
from warpmag.moments.system import MomentSystem, SolverSettings

KINEMATIC = int(newton.BodyFlags.KINEMATIC)


def make_system(
    model: newton.Model,
    magnets: list[BodyMagnet],
    settings: MagneticSettings,
    *,
    curve,
    sources,
    method,
    max_evaluations,
) -> tuple[MomentSystem, list[int], list[int]]:
    """Make the system of all moments of some magnets.

    Args:
        model: Their model.
        magnets: The magnets, in the order of the system.
        settings: How they are to be solved.
        curve: Magnetization curve of all that are inducible; None means their own.
        sources: Coils and field maps, as :class:`MomentSystem` takes them.
        method: Summation method of :class:`SolverSettings`.
        max_evaluations: Largest number of field evaluations of a solve.

    Returns:
        The system, the bodies of its couplings, and those of its solids.
    """
    counts = [len(one.lattice.volumes) for one in magnets]

    def spread(values, dtype=float):
        return np.repeat(np.asarray(values, dtype=dtype), counts)

    first = (np.cumsum(counts) - counts).tolist()
    celled = [(k, one) for k, one in zip(first, magnets, strict=True) if one.lattice.coupling is not None]
    made_of = [one.magnet for one in magnets]
    flags = model.body_flags  # None in a model without bodies
    kinematic = [] if flags is None else ((flags.numpy() & KINEMATIC) != 0).tolist()
    fixed = np.cumsum([one.body < 0 for one in magnets]) + model.body_count
    bodies = [one.body if one.body >= 0 else own for one, own in zip(magnets, fixed.tolist(), strict=True)]
    movable = [one.body >= 0 and not kinematic[one.body] for one in magnets]
    body_of, moves = spread(bodies, int), spread(movable, bool)
    solids = [
        (one.body, _solid(k, one, move, part))
        for k, one, move in zip(first, magnets, movable, strict=True)
        for part in one.lattice.solids
    ]
    curves = [LINEAR_CURVE if one.recoils else curve or one.curve for one in made_of]
    system = MomentSystem(
        worlds=spread([one.world for one in magnets], int),
        permanent=spread([one.fixed for one in made_of], bool),
        radii=np.concatenate([one.lattice.radii for one in magnets]),
        bodies=body_of,
        movable=moves,
        material=Material(
            spread([one.saturation for one in made_of]),
            spread([one.recoil_permeability - 1.0 if one.recoils else one.susceptibility for one in made_of]),
            [curve for curve, count in zip(curves, counts, strict=True) for _ in range(count)],
        ),
        external_field=settings.external_field,
        settings=SolverSettings(
            settings.force, settings.dynamics, settings.contact_model, method, settings.rtol, max_evaluations
        ),
        couplings=[(k, one.lattice.coupling) for k, one in celled],
        solids=[solid for _, solid in solids],
        body_extent=_largest_extent(magnets, body_of, moves),
        sources=sources,
        device=model.device,
    )
    return system, [one.body for _, one in celled], [body for body, _ in solids]


def _solid(first: int, one: BodyMagnet, movable: bool, part) -> SolidMagnet:
    """What the system has to know of a part that has a closed form, of a magnet with the moments from ``first`` on."""
    volume, response = float(one.lattice.volumes[part.first]), 3.0 - 9.0 / (2.0 + one.magnet.recoil_permeability)
    return SolidMagnet(first + part.first, part.count, volume, one.world, part.reach, part.shape, movable, response)


def _largest_extent(magnets: list[BodyMagnet], bodies: np.ndarray, movable: np.ndarray) -> float:
    """Distance that no two moments of a body that may move exceed [m]; zero where each has a single one."""
    if not movable.any():
        return 0.0
    order = np.flatnonzero(movable)[np.argsort(bodies[movable], kind="stable")]
    places, bodies = np.concatenate([one.lattice.positions for one in magnets])[order], bodies[order]
    begin = np.flatnonzero(np.diff(bodies, prepend=bodies[0] - 1))
    low, high = np.minimum.reduceat(places, begin), np.maximum.reduceat(places, begin)
    return float(np.linalg.norm(high - low, axis=1).max())
