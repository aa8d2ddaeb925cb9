"""Moments of inducible bodies compared with references, at the default spacing and at half of it.

``python -m bench.reference.body_moments [BODY ...] [--half] [--torque]`` prints m/(V H0) across and along the axis for
susceptibilities of 1, 10, 1000 and ∞, and the field evaluations of a cold solve. It also prints the difference from the
reference: Osborn's closed form for ellipsoids, else a surface integral equation (``surface_integrals.py``).
``--torque`` prints the torque on a soft ellipsoid oblique to a uniform field instead, over μ0 V H0², and the difference
from the closed form.
"""

import argparse
import math

import numpy as np
import warp as wp

from bench.machine import describe
from bench.reference.oracle import MU0
from bench.reference.surface_integrals import box_moments, cylinder_moments
from bench.systems import moment_system
from warpmag.moments.system import MomentSystem
from warpmag.shapes import demagnetization, lattice, linear_cells, uniform_response

SUSCEPTIBILITIES = (1.0, 10.0, 1000.0, math.inf)
LINEAR = 1e12
"""Saturation far above any field here [A/m]."""
STRENGTH = 1e3  # applied field [A/m]


def ellipsoid_moments(semi_axes, susceptibilities=SUSCEPTIBILITIES) -> np.ndarray:
    """Moments over V H0 along each axis, shape [susceptibilities, 3]; factors by quadrature (Osborn 1945)."""
    a = np.asarray(semi_axes, float)
    nodes, weights = np.polynomial.legendre.leggauss(200)
    s = np.exp(0.5 * (nodes + 1.0) * 60.0 - 30.0)[:, None]  # from e^-30 to e^30
    integrals = (30.0 * weights[:, None] * s / ((s + a * a) * np.sqrt(np.prod(s + a * a, axis=1))[:, None])).sum(axis=0)
    return 1.0 / (0.5 * a.prod() * integrals + 1.0 / np.array(susceptibilities)[:, None])


def box(*sides):
    """A box, and a function that returns its moments."""
    return lattice.box(0.5 * np.array(sides)), lambda: box_moments(sides, SUSCEPTIBILITIES)[:, [0, 2]]


def cylinder(length):
    """A cylinder of unit diameter, and a function that returns its moments."""
    return lattice.cylinder(0.5, 0.5 * length), lambda: cylinder_moments(length, SUSCEPTIBILITIES)[:, ::-1]


def ellipsoid(*axes):
    """An ellipsoid, and a function that returns its moments."""
    return lattice.ellipsoid(0.5 * np.array(axes)), lambda: ellipsoid_moments(axes)[:, [0, 2]]


BODIES = {
    "cube": box(1.0, 1.0, 1.0), "rod 1:1:5": box(1.0, 1.0, 5.0), "rod 1:1:10": box(1.0, 1.0, 10.0),
    "plate 5:5:1": box(5.0, 5.0, 1.0), "plate 10:10:1": box(10.0, 10.0, 1.0),
    "cylinder 1": cylinder(1.0), "cylinder 5": cylinder(5.0), "cylinder 10": cylinder(10.0),
    "sphere": ellipsoid(1.0, 1.0, 1.0), "ellipsoid 1:1:10": ellipsoid(1.0, 1.0, 10.0),
    "ellipsoid 5:5:1": ellipsoid(5.0, 5.0, 1.0),
}  # fmt: skip
"""Bodies, and their exact moments across z and along it, shape [susceptibilities, 2]."""


def cells_of(solid, half: bool):
    """Cells of a body, and their coupling."""
    body = lattice.fill(solid, across=lattice.LEAST_ACROSS)
    if half:
        body = lattice.fill(solid, 0.5 * np.cbrt(solid.volume / len(body.volumes)))
    cells = linear_cells.with_slopes(demagnetization.coupling(body, body.radii), body)
    return body, uniform_response.with_surface_response(cells, body, [solid])


def solved(body, coupling, susceptibility: float, field, device=None) -> MomentSystem:
    """System of the cells of a body in a uniform field [A/m], solved."""
    system = moment_system(
        radii=body.radii, bodies=np.zeros(len(body.radii), int), couplings=[(0, coupling)], saturation=LINEAR,
        susceptibility=susceptibility, external_field=field, max_evaluations=5000, device=device,
    )  # fmt: skip
    system.positions.assign(body.positions)
    system.solve()
    return system


def moments_of_cells(solid, half: bool, device=None):
    """Moments over V H0 across and along, and evaluations, shape [susceptibilities, 2] each, and number of cells."""
    body, coupling = cells_of(solid, half)
    moments, evaluations = np.empty((2, len(SUSCEPTIBILITIES), 2))
    for i, j in np.ndindex(moments.shape):
        field = STRENGTH * np.eye(3)[[0, 2]][j]
        system = solved(body, coupling, SUSCEPTIBILITIES[i], field, device)
        moment = system.moments.numpy().sum(axis=0, dtype=float) @ field
        moments[i, j], evaluations[i, j] = moment / (STRENGTH**2 * body.volumes.sum()), system.evaluations.numpy()[0]
    return moments, evaluations, len(body.volumes)


def print_torques(half: bool, device=None, susceptibility=179.0) -> None:
    """Print the torque on an ellipsoid 1:1:10 at several angles between its axis and the field."""
    axes = np.array([1.0, 1.0, 10.0])
    body, coupling = cells_of(lattice.ellipsoid(0.5 * axes), half)
    across, _, along = ellipsoid_moments(axes, (susceptibility,))[0]
    for degrees in (15, 30, 45, 60, 75):
        field = STRENGTH * np.array([math.sin(math.radians(degrees)), 0.0, math.cos(math.radians(degrees))])
        system = solved(body, coupling, susceptibility, field, device)
        system.apply_forces()
        torque = system.torques.numpy().sum(axis=0, dtype=float)[1] / (MU0 * STRENGTH**2 * body.volumes.sum())
        exact = (along - across) * field[0] * field[2] / STRENGTH**2
        error = 100.0 * (torque / exact - 1.0)
        print(f"{degrees} degrees {len(body.volumes)} {torque:8.4f} {error:+5.2f} %", flush=True)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        prog="python -m bench.reference.body_moments", description=__doc__.partition("\n")[0]
    )
    parser.add_argument("bodies", nargs="*", metavar="BODY", help=f"of {', '.join(BODIES)}; all if none is named")
    parser.add_argument("--half", action="store_true", help="half the default spacing")
    parser.add_argument("--torque", action="store_true", help="the torque of a soft ellipsoid")
    parser.add_argument("--device", default="cpu")
    options = parser.parse_args()
    if unknown := set(options.bodies) - set(BODIES):
        parser.error(f"no such body: {', '.join(unknown)}")
    wp.config.log_level = wp.LOG_WARNING
    print(describe(wp.get_device(options.device)))
    if options.torque:
        return print_torques(options.half, options.device)
    for name in options.bodies or BODIES:
        solid, reference = BODIES[name]
        exact, (moments, evaluations, count) = reference(), moments_of_cells(solid, options.half, options.device)
        for j, direction in enumerate(("across", "along")):
            cells = "  ".join(
                f"{value:8.4f} {100.0 * (value / true - 1.0):+5.2f} % {int(evaluated):4d}"
                for value, true, evaluated in zip(moments[:, j], exact[:, j], evaluations[:, j], strict=True)
            )
            print(f"{name:17s} {count:5d} {direction:6s} {cells}", flush=True)


if __name__ == "__main__":
    main()
