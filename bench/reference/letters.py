"""Moments of the letters of ``alphabets`` against a surface integral equation.

The equation is that of ``susceptible.py`` with χ = ∞, w/2 − (1/4π) ∫ w dΩ = H0·x, w constant on triangles, whose solid
angles are those of Van Oosterom and Strackee (1983). Triangles are halved until there are 1,500 of them, and 4,500.

Run as ``python -m bench.reference.letters [LETTER ...]``: how many cells each letter has, m/(V H0) of its surface along
x, y and z, what three times the triangles changed of it, and how far from it the letter's cells are.
"""

import argparse

import numpy as np
import warp as wp

from bench.reference.table import FAINT
from warpmag import demagnetization, even_field, facets, lattice
from warpmag.scenes_usd import bundled
from warpmag.system import MomentSystem

SPACING = 0.004
"""Distance between the moments of a letter in the scene [m]."""
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


def letters() -> dict[str, np.ndarray]:
    """Triangles of the scene's letters [m], shape [n, 3, 3] each."""
    from pxr import Usd, UsdGeom  # noqa: PLC0415 - the reference does without USD

    shapes = {}
    stage = Usd.Stage.Open(str(bundled()["alphabets"]))
    for prim in stage.Traverse():
        letter = prim.GetParent().GetName().partition("_")[0]
        if not prim.IsA(UsdGeom.Mesh) or letter in shapes:
            continue  # all letters of a kind are one mesh
        mesh = UsdGeom.Mesh(prim)
        points = np.array(mesh.GetPointsAttr().Get(), dtype=float)
        indices = np.split(mesh.GetFaceVertexIndicesAttr().Get(), np.cumsum(mesh.GetFaceVertexCountsAttr().Get())[:-1])
        shapes[letter] = points[[[face[0], face[k], face[k + 1]] for face in indices for k in range(1, len(face) - 1)]]
    return shapes


def main() -> None:
    """Print the table."""
    shapes = letters()
    parser = argparse.ArgumentParser(prog="python -m bench.reference.letters", description=__doc__.partition("\n")[0])
    parser.add_argument("letters", nargs="*", metavar="LETTER", help=f"of {', '.join(sorted(shapes))}; all if none")
    options = parser.parse_args()
    wp.config.log_level = wp.LOG_WARNING
    for letter in options.letters or sorted(shapes):
        corners = shapes[letter]
        coarse, fine = (moments(facets.mesh(corners, k * TRIANGLES)[:, :3]) for k in (1, 3))
        body, count = found(lattice.mesh(corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3)))
        numbers = (*fine, *(100.0 * (fine - coarse) / fine), *(100.0 * (body / fine - 1.0)))
        columns = "{:8.3f}" * 3 + "  {:+6.2f} %" * 6
        print(f"{letter} {count:3d}{columns.format(*numbers)}", flush=True)


if __name__ == "__main__":
    main()
