"""Moments of the letters of ``alphabets`` against a surface integral equation.

The equation is that of ``susceptible.py`` with χ = ∞, w/2 − (1/4π) ∫ w dΩ = H0·x, w constant on triangles, whose solid
angles are those of Van Oosterom and Strackee (1983). Triangles are halved until there are 1,500 of them, and 4,500.

Run as ``python -m bench.reference.letters [LETTER ...]``: the cells of each letter, m/(V H0) of its surface right, up
and across, what three times the triangles changed of it, and how far from it the letter's cells are.
"""

import argparse
import itertools
import string

import numpy as np
import warp as wp

from bench.reference.table import FAINT
from warpmag.moments.system import MomentSystem
from warpmag.scenes_usd import lettering
from warpmag.shapes import demagnetization, facets, lattice
from warpmag.shapes import uniform_response as even_field

SIZE, THICKNESS, SPACING = 0.02, 0.005, 0.004
"""Height and thickness of letters in the scene, and the distance between their moments [m]."""
BEVEL = 0.02
"""Width of their bevels over the height."""
TRIANGLES = 1500
"""How many there are at least, the first time."""


def moments(corners: np.ndarray) -> np.ndarray:
    """m/(V H0) of an ideally permeable body in fields along x, y and z.

    Args:
        corners: Triangles of its surface, counterclockwise seen from outside, shape [n, 3, 3].

    Returns:
        Component along the field, shape [3].
    """
    centre = corners.mean(axis=1)
    normals = 0.5 * np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    matrix = np.array([_solid_angles(point, corners) for point in centre]) / (-4.0 * np.pi)
    np.fill_diagonal(matrix, 0.5)
    matrix += 1.0 / len(centre)  # a constant potential is free: it makes no moment
    volume = (centre * normals).sum() / 3.0
    return (np.linalg.solve(matrix, centre) * normals).sum(axis=0) / volume


def _solid_angles(point: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """∫ n·(y − x)/‖y − x‖³ dA over triangles, shape [n]."""
    a, b, c = np.moveaxis(corners - point, 1, 0)
    la, lb, lc = (np.linalg.norm(one, axis=1) for one in (a, b, c))
    ab, bc, ca = ((one * other).sum(axis=1) for one, other in ((a, b), (b, c), (c, a)))
    above = (a * np.cross(b, c)).sum(axis=1)
    return 2.0 * np.arctan2(above, la * lb * lc + ab * lc + bc * la + ca * lb)


def found(solid) -> tuple[np.ndarray, int]:
    """The same of the library's cells, shape [3], and how many there are."""
    body = lattice.fill(solid, SPACING)
    coupling = even_field.corrected(demagnetization.coupling(body, body.radii), body, [solid])
    result = np.empty(3)
    for axis, field in enumerate(1e3 * np.eye(3)):
        system = MomentSystem(
            radii=body.radii, bodies=np.zeros(len(body.radii), int), couplings=[(0, coupling)], saturation=FAINT,
            external_field=field, rtol=1e-5, max_evaluations=5000, device="cpu",
        )  # fmt: skip
        system.positions.assign(body.positions)
        system.solve()
        result[axis] = system.moments.numpy()[:, axis].sum(dtype=float) / (1e3 * body.volumes.sum())
    return result, len(body.volumes)


def triangles(letter: str) -> np.ndarray:
    """Triangles of a letter [m], z across it, shape [n, 3, 3]."""
    points, faces = lettering.extruded(lettering.outline(letter), THICKNESS / SIZE, BEVEL)
    return SIZE * points[[[face[0], a, b] for face in faces for a, b in itertools.pairwise(face[1:])]]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(prog="python -m bench.reference.letters", description=__doc__.partition("\n")[0])
    parser.add_argument("letters", nargs="*", metavar="LETTER", help="of the capitals; all if none is named")
    options = parser.parse_args()
    wp.config.log_level = wp.LOG_WARNING
    for letter in options.letters or string.ascii_uppercase:
        corners = triangles(letter)
        coarse, fine = (moments(facets.mesh(corners, k * TRIANGLES)[:, :3]) for k in (1, 3))
        body, count = found(lattice.mesh(corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3)))
        numbers = (*fine, *(100.0 * (fine - coarse) / fine), *(100.0 * (body / fine - 1.0)))
        columns = "{:8.3f}" * 3 + "  {:+6.2f} %" * 6
        print(f"{letter} {count:3d}{columns.format(*numbers)}", flush=True)


if __name__ == "__main__":
    main()
