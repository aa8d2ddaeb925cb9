"""Force of a box magnet on a plate of infinite permeability below it, from a surface integral equation.

The plate is at one potential: (1/4π) ∫ σ/‖x − y‖ dA + φ = const, with φ the potential of the magnet, in closed form for
its two charged faces. σ is constant on rectangles that shrink towards the edges of the plate and of the magnet. The
force is μ0 ∫ σ H dA, H the field of the magnet.

``python -m bench.reference.plate`` prints force and moment of the plate for some gaps, the change from half as many
rectangles along each side, and the error of a warpmag model.
"""

import itertools

import numpy as np

from bench.reference.oracle import MU0, relative
from bench.reference.surface_integrals import potentials, rectangles_of, solved_charges

MAGNET, MAGNETIZATION = 0.02, 3.2e5  # edge of the ferrite cube [m], and its magnetization along z [A/m]
PLATE = (0.04, 0.04, 0.005)  # sides of the plate [m]
GAPS = (0.0002, 0.0005, 0.001, 0.002, 0.005, 0.01)  # gaps between plate and magnet [m]


def force(gap: float, aside: float = 0.0, rectangles: int = 16) -> tuple[np.ndarray, np.ndarray]:
    """Force [N] on the plate and its moment [A·m²], shape [3] each; the magnet is above it.

    Args:
        gap: Gap between the faces [m].
        aside: Offset of the magnet from the middle of the plate along x [m].
        rectangles: Number of rectangles along each side of the plate.
    """
    magnet = np.array([aside, 0.0, 0.5 * PLATE[2] + gap + 0.5 * MAGNET])
    lower, upper, axis = _rectangles(0.5 * np.asarray(PLATE, float), magnet, rectangles)
    middle, size = 0.5 * (lower + upper), upper - lower
    charge = solved_charges(lower, upper, axis, -_potential(middle, magnet)[:, None])[1][:, 0]
    step, field = 1e-4 * MAGNET, np.zeros_like(middle)
    nodes, weights = np.polynomial.legendre.leggauss(3)
    for i, j, k in np.ndindex(3, 3, 3):
        at = middle + 0.5 * size * nodes[[i, j, k]]
        for n, d in enumerate(step * np.eye(3)):
            change = _potential(at - d, magnet) - _potential(at + d, magnet)
            field[:, n] += weights[[i, j, k]].prod() / 8.0 * change / (2.0 * step)
    return MU0 * charge @ field, charge @ middle


def _potential(points, magnet) -> np.ndarray:
    """Scalar potential [A] of the magnet centered at ``magnet``, shape [n]."""
    faces = magnet + 0.5 * MAGNET * np.array([[[-1, -1, 1], [1, 1, 1]], [[-1, -1, -1], [1, 1, -1]]])
    upper, lower = potentials(points, faces[:, 0], faces[:, 1], np.array([2, 2])).T
    return MAGNETIZATION * (upper - lower)


def _rectangles(half, magnet, count: int):
    """Rectangles of the plate, narrow towards its edges and those of the magnet: corners and axes of normals."""
    edges = []
    for k in range(3):
        inner = magnet[k] + 0.5 * MAGNET * np.array([-1.0, 1.0]) if k < 2 else []
        stops = np.unique(np.clip(np.concatenate([[-half[k]], inner, [half[k]]]), -half[k], half[k]))
        parts = max(2, round(count / (len(stops) - 1 if k < 2 else 2)))
        at = 0.5 - 0.5 * np.cos(np.pi * np.linspace(0.0, 1.0, parts + 1))
        edges.append(np.unique(np.concatenate([a + (b - a) * at for a, b in itertools.pairwise(stops)])))
    faces = [rectangles_of(edges, axis, end) for axis in range(3) for end in (-half[axis], half[axis])]
    return tuple(np.concatenate(arrays) for arrays in zip(*faces, strict=True))


def model_forces(gap: float, aside: float, device="cpu") -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Force on the plate, its moment, and force on the magnet, of a Newton model with warpmag's magnets."""
    import newton  # noqa: PLC0415 - the reference itself needs NumPy alone
    import warp as wp  # noqa: PLC0415

    import warpmag  # noqa: PLC0415

    builder, side = newton.ModelBuilder(), 0.5 * MAGNET
    warpmag.register_attributes(builder)
    iron = builder.add_body()
    builder.add_shape_box(iron, hx=0.5 * PLATE[0], hy=0.5 * PLATE[1], hz=0.5 * PLATE[2])
    warpmag.add_inducible(builder, iron, saturation=1e12)
    place = (aside, 0.0, 0.5 * PLATE[2] + gap + side)
    magnet = builder.add_body(xform=wp.transform(place, wp.quat_identity()))
    builder.add_shape_box(magnet, hx=side, hy=side, hz=side)
    warpmag.add_permanent(builder, magnet, magnetization=(0.0, 0.0, MAGNETIZATION))
    model = builder.finalize(device=device)
    magnetics, state = warpmag.Magnetics(model), model.state()
    magnetics.apply(state)
    forces = state.body_f.numpy()[:, :3].astype(float)
    return forces[0], magnetics.shape_moments()[0], forces[1]


def main() -> None:
    """Print force and moment for all gaps."""
    for gap, aside in itertools.product(GAPS, (0.0, 0.01)):
        (coarse, _), (fine, moment) = force(gap, aside, 9), force(gap, aside, 18)
        change = np.abs(fine - coarse).max().round(4)
        print(gap, aside, "N", fine.round(4), "A·m²", moment.round(4), "change", change, flush=True)
        pull, magnetized, reaction = model_forces(gap, aside)
        errors = [relative(pull, fine), relative(magnetized, moment)]
        rest = np.linalg.norm(pull + reaction) / np.linalg.norm(pull)
        print(f"  model: force {100 * errors[0]:.2f} %, moment {100 * errors[1]:.2f} %; sum of forces {rest:.0e}")


if __name__ == "__main__":
    main()
