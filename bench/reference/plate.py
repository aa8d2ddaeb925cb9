"""Force of a box magnet on an ideally permeable plate below it, from a surface integral equation.

The plate is at one potential: (1/4π) ∫ σ/‖x − y‖ dA + φ = const, φ the potential of the magnet, whose two charged faces
are closed forms; σ is taken as constant on rectangles that shrink towards the edges of the plate (``boxes.py``) and are
small below the magnet. The force is μ0 ∫ σ H dA, H the magnet's.

Run as ``python -m bench.reference.plate [--found]``: the force and moment of the plate for some gaps, what twice the
rectangles along each side change, and how far from it a model's plate and magnet are.
"""

import argparse
import itertools

import numpy as np

from bench.reference.boxes import _potentials
from bench.reference.cuboids import MU0

MAGNET, MAGNETIZATION = 0.02, 3.2e5
"""Side of the ferrite cube [m], and its magnetization along z [A/m]."""
PLATE = (0.04, 0.04, 0.005)
"""Sides of the plate [m]."""
GAPS = (0.0002, 0.0005, 0.001, 0.002, 0.005, 0.01)
"""Gaps between them [m]."""


def force(gap: float, aside: float = 0.0, rectangles: int = 16, plate=PLATE) -> tuple[np.ndarray, np.ndarray]:
    """Force [N] on the plate and its moment [A·m²], shape [3] each; the magnet is above it.

    Args:
        gap: Gap between the faces [m].
        aside: How far the magnet is from the middle of the plate, along x [m].
        rectangles: Rectangles along each side of the plate.
        plate: Sides of the plate [m].
    """
    centre = np.array([aside, 0.0, 0.5 * plate[2] + gap + 0.5 * MAGNET])
    lower, upper, axis = _rectangles(0.5 * np.asarray(plate, float), centre, rectangles)
    middle, size = 0.5 * (lower + upper), upper - lower
    area = np.prod(np.where(np.arange(3) == axis[:, None], 1.0, size), axis=1)
    matrix = np.ones((len(axis) + 1, len(axis) + 1))
    matrix[:-1, :-1] = _potentials(middle, lower, upper, axis)
    matrix[-1] = np.append(area, 0.0)
    charge = np.linalg.solve(matrix, np.append(-_potential(middle, centre), 0.0))[:-1] * area
    step, field = 1e-4 * MAGNET, np.zeros_like(middle)
    nodes, weights = np.polynomial.legendre.leggauss(3)
    for i, j, k in np.ndindex(3, 3, 3):
        at = middle + 0.5 * size * nodes[[i, j, k]]
        for n, d in enumerate(step * np.eye(3)):
            change = _potential(at - d, centre) - _potential(at + d, centre)
            field[:, n] += weights[[i, j, k]].prod() / 8.0 * change / (2.0 * step)
    return MU0 * charge @ field, charge @ middle


def _potential(points, centre) -> np.ndarray:
    """Scalar potential of the magnet [A], shape [n]."""
    faces = centre + 0.5 * MAGNET * np.array([[[-1, -1, 1], [1, 1, 1]], [[-1, -1, -1], [1, 1, -1]]])
    found = _potentials(points, faces[:, 0], faces[:, 1], np.array([2, 2]))
    return MAGNETIZATION * (found[:, 0] - found[:, 1])


def _rectangles(half, centre, count: int):
    """Corners of rectangles of the plate, narrow towards its edges and those of the magnet, and their axes."""
    edges = []
    for k in range(3):
        inner = centre[k] + 0.5 * MAGNET * np.array([-1.0, 1.0]) if k < 2 else []
        stops = np.unique(np.clip(np.concatenate([[-half[k]], inner, [half[k]]]), -half[k], half[k]))
        parts = max(2, round(count / (len(stops) - 1 if k < 2 else 2)))
        at = 0.5 - 0.5 * np.cos(np.pi * np.linspace(0.0, 1.0, parts + 1))
        edges.append(np.unique(np.concatenate([a + (b - a) * at for a, b in itertools.pairwise(stops)])))
    lower, upper, axes = [], [], []
    for axis in range(3):
        a, b = (axis + 1) % 3, (axis + 2) % 3
        for end in (-half[axis], half[axis]):
            i, j = (n.reshape(-1) for n in np.meshgrid(np.arange(len(edges[a]) - 1), np.arange(len(edges[b]) - 1)))
            corners = np.full((2, len(i), 3), end)
            corners[:, :, a], corners[:, :, b] = [edges[a][i], edges[a][i + 1]], [edges[b][j], edges[b][j + 1]]
            lower.append(corners[0])
            upper.append(corners[1])
            axes.append(np.full(len(i), axis))
    return np.concatenate(lower), np.concatenate(upper), np.concatenate(axes)


def found(gap: float, aside: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The same of a Newton model, and the force on the magnet."""
    import newton  # noqa: PLC0415 - the reference does without the library
    import warp as wp  # noqa: PLC0415

    import warpmag  # noqa: PLC0415

    wp.config.log_level = wp.LOG_WARNING
    builder, side = newton.ModelBuilder(), 0.5 * MAGNET
    warpmag.register_attributes(builder)
    iron = builder.add_body()
    builder.add_shape_box(iron, hx=0.5 * PLATE[0], hy=0.5 * PLATE[1], hz=0.5 * PLATE[2])
    warpmag.add_inducible(builder, iron, saturation=1e12)
    place = (aside, 0.0, 0.5 * PLATE[2] + gap + side)
    magnet = builder.add_body(xform=wp.transform(place, wp.quat_identity()))
    builder.add_shape_box(magnet, hx=side, hy=side, hz=side)
    warpmag.add_permanent(builder, magnet, magnetization=(0.0, 0.0, MAGNETIZATION))
    model = builder.finalize(device="cpu")
    magnetics, state = warpmag.Magnetics(model), model.state()
    magnetics.apply(state)
    forces = state.body_f.numpy()[:, :3].astype(float)
    return forces[0], magnetics.shape_moments()[0], forces[1]


def main() -> None:
    """Print force and moment for all gaps."""
    parser = argparse.ArgumentParser(prog="python -m bench.reference.plate", description=__doc__.partition("\n")[0])
    parser.add_argument("--found", action="store_true", help="how far a model is from that")
    options = parser.parse_args()
    for gap in GAPS:
        for aside in (0.0, 0.01):
            (coarse, _), (fine, moment) = force(gap, aside, 9), force(gap, aside, 18)
            change = np.abs(fine - coarse).max().round(4)
            print(gap, aside, "N", fine.round(4), "A·m²", moment.round(4), "change", change, flush=True)
            if options.found:
                pull, magnetized, back = found(gap, aside)
                off = [np.linalg.norm(a - b) / np.linalg.norm(b) for a, b in ((pull, fine), (magnetized, moment))]
                rest = np.linalg.norm(pull + back) / np.linalg.norm(pull)
                print(
                    f"  off by: force {100 * off[0]:.2f} %, moment {100 * off[1]:.2f} %; left of both forces {rest:.0e}"
                )


if __name__ == "__main__":
    main()
