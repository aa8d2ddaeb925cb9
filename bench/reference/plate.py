"""Force of a box magnet on a plate of infinite permeability below it, from a surface integral equation.

The plate is at one potential: (1/4π) ∫ σ/‖x − y‖ dA + φ = const, with φ the potential of the magnet, in closed form for
its two charged faces. σ is constant on rectangles that shrink towards the edges of the plate and of the magnet. The
force is μ0 ∫ σ H dA, H the field of the magnet.

``python -m bench.reference.plate`` prints force and moment of the plate for some gaps, and the error of a warpmag
model. It also prints the change of the force from half as many rectangles along each side.
"""

import itertools

import newton
import numpy as np
import warp as wp

import warpmag
from bench.reference.oracle import MU0, relative
from bench.reference.surface_integrals import potentials, rectangles_of, solved_charges

MAGNET, MAGNETIZATION = 0.02, 3.2e5  # edge of the ferrite cube [m], and its magnetization along z [A/m]
PLATE = (0.04, 0.04, 0.005)  # sides of the plate [m]
GAPS = (0.0002, 0.0005, 0.001, 0.002, 0.005, 0.01)  # gaps between plate and magnet [m]


def force(gap: float, offset: float = 0.0, rectangles: int = 16) -> tuple[np.ndarray, np.ndarray]:
    """Force [N] on the plate and its moment [A·m²], shape [3] each.

    The magnet is above the plate at a ``gap`` [m] and shifted by ``offset`` along x [m]. Each side of the plate has
    the given number of rectangles.
    """
    magnet = np.array([offset, 0.0, 0.5 * PLATE[2] + gap + 0.5 * MAGNET])
    lower, upper, axis = _rectangles(0.5 * np.asarray(PLATE, float), magnet, rectangles)
    center, size = 0.5 * (lower + upper), upper - lower
    charge = solved_charges(lower, upper, axis, -_potential(center, magnet)[:, None])[1][:, 0]
    step, field = 1e-4 * MAGNET, np.zeros_like(center)
    nodes, weights = np.polynomial.legendre.leggauss(3)
    for i, j, k in np.ndindex(3, 3, 3):
        points = center + 0.5 * size * nodes[[i, j, k]]
        for n, d in enumerate(step * np.eye(3)):
            change = _potential(points - d, magnet) - _potential(points + d, magnet)
            field[:, n] += weights[[i, j, k]].prod() / 8.0 * change / (2.0 * step)
    return MU0 * charge @ field, charge @ center


def _potential(points, magnet) -> np.ndarray:
    """Scalar potential [A] of the magnet centered at ``magnet``, shape [n]."""
    faces = magnet + 0.5 * MAGNET * np.array([[[-1, -1, 1], [1, 1, 1]], [[-1, -1, -1], [1, 1, -1]]])
    upper, lower = potentials(points, faces[:, 0], faces[:, 1], np.array([2, 2])).T
    return MAGNETIZATION * (upper - lower)


def _rectangles(half, magnet, count: int):
    """Corners and axes of normals of the plate's rectangles, which are narrow near the edges of plate and magnet."""
    edges = []
    for k in range(3):
        inner = magnet[k] + 0.5 * MAGNET * np.array([-1.0, 1.0]) if k < 2 else []
        stops = np.unique(np.clip(np.concatenate([[-half[k]], inner, [half[k]]]), -half[k], half[k]))
        parts = max(2, round(count / (len(stops) - 1 if k < 2 else 2)))
        fractions = 0.5 - 0.5 * np.cos(np.pi * np.linspace(0.0, 1.0, parts + 1))
        edges.append(np.unique(np.concatenate([a + (b - a) * fractions for a, b in itertools.pairwise(stops)])))
    faces = [rectangles_of(edges, axis, end) for axis in range(3) for end in (-half[axis], half[axis])]
    return tuple(np.concatenate(arrays) for arrays in zip(*faces, strict=True))


def model_forces(gap: float, offset: float, device="cpu") -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Force on the plate, its moment, and force on the magnet, of a Newton model with warpmag's magnets."""
    builder, side = newton.ModelBuilder(), 0.5 * MAGNET
    warpmag.register_attributes(builder)
    iron = builder.add_body()
    builder.add_shape_box(iron, hx=0.5 * PLATE[0], hy=0.5 * PLATE[1], hz=0.5 * PLATE[2])
    warpmag.add_inducible(builder, body=iron, saturation=1e12)
    center = (offset, 0.0, 0.5 * PLATE[2] + gap + side)
    magnet = builder.add_body(xform=wp.transform(center, wp.quat_identity()))
    builder.add_shape_box(magnet, hx=side, hy=side, hz=side)
    warpmag.add_permanent(builder, body=magnet, magnetization=(0.0, 0.0, MAGNETIZATION))
    model = builder.finalize(device=device)
    magnetics, state = warpmag.Magnetics(model), model.state()
    magnetics.apply(state)
    forces = state.body_f.numpy()[:, :3].astype(float)
    return forces[0], magnetics.shape_moments()[0], forces[1]


def main() -> None:
    """Print force and moment for all gaps."""
    for gap, offset in itertools.product(GAPS, (0.0, 0.01)):
        (coarse, _), (fine, moment) = force(gap, offset, 9), force(gap, offset, 18)
        change = np.abs(fine - coarse).max().round(4)
        print(gap, offset, "N", fine.round(4), "A·m²", moment.round(4), "change", change, flush=True)
        pull, magnetized, reaction = model_forces(gap, offset)
        errors = [relative(pull, fine), relative(magnetized, moment)]
        rest = np.linalg.norm(pull + reaction) / np.linalg.norm(pull)
        print(f"  model: force {100 * errors[0]:.2f} %, moment {100 * errors[1]:.2f} %; sum of forces {rest:.0e}")


if __name__ == "__main__":
    main()
