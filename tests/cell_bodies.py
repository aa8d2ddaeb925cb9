"""Systems of one inducible body that is no ball, that several tests share."""

import math

import numpy as np
from scipy.integrate import quad
from scipy.spatial.transform import Rotation

from bench.reference import boxes, oracle
from bench.systems import moment_system
from warpmag.kernels.cells import cell_pairs
from warpmag.shapes import demagnetization, lattice, linear_cells, uniform_response

FAINT = 1e12  # A/m, a saturation far above any field here
TURN = np.array([0.2, -0.4, 0.1, 0.8]) / np.linalg.norm([0.2, -0.4, 0.1, 0.8])


def demagnetizing_factors(semi_axes):
    """Demagnetizing factors of an ellipsoid (Osborn 1945), by numerical integration."""
    a = np.asarray(semi_axes, float)
    return np.array(
        [a.prod() / 2 * quad(lambda s, x=x: 1 / ((s + x * x) * np.sqrt((s + a * a).prod())), 0, np.inf)[0] for x in a]
    )


def full(six):
    """Symmetric tensors of xx, yy, zz, xy, xz, yz."""
    xx, yy, zz, xy, xz, yz = np.moveaxis(np.asarray(six), -1, 0)
    return np.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz], axis=-1).reshape(*xx.shape, 3, 3)


def matrix(quaternion):
    return lattice.box([1.0] * 3).posed((0.0, 0.0, 0.0), quaternion).rotation


def posed(*boxes_at):
    return [lattice.box(half).posed(at) for half, at in boxes_at]


def filled(solids, spacing=0.0):
    return lattice.fill(solids, spacing, lattice.LEAST_ACROSS, together=True)


def make_system(body, *, turn=(0.0, 0.0, 0.0, 1.0), permanent=(), coupling=None, **settings):
    """System of one body at the origin, and permanent dipoles (position, moment) of another."""
    count = len(body.volumes)
    coupling = demagnetization.coupling(body, body.radii) if coupling is None else coupling
    system = moment_system(
        radii=np.append(body.radii, np.zeros(len(permanent))), permanent=np.arange(count + len(permanent)) >= count,
        bodies=np.append(np.zeros(count, int), np.ones(len(permanent), int)),
        couplings=[(0, coupling)], **{"saturation": FAINT, **settings},
    )  # fmt: skip
    positions = body.positions @ matrix(turn).T
    system.positions.assign(np.concatenate([positions, *(np.atleast_2d(x) for x, _ in permanent)]))
    system.moments.assign(np.concatenate([np.zeros((count, 3)), *(np.atleast_2d(m) for _, m in permanent)]))
    system.rotations.assign(np.atleast_2d(turn))
    return system


def polarizability(body, susceptibility, device, **settings):
    """Moment over V H0 along x and along z, shape [2]."""
    results = []
    for axis in np.eye(3)[[0, 2]]:
        system = make_system(body, susceptibility=susceptibility, external_field=1e3 * axis, device=device, **settings)
        system.solve()
        assert system.converged.numpy().all()
        results.append(system.moments.numpy().sum(axis=0) @ axis / (1e3 * body.volumes.sum()))
    return np.array(results)


def demagnetizing_matrix(body, coupling=None):
    """Operator H = −D M of a body at rest, as balls and couplings make it, symmetrized by volumes, [3 n, 3 n]."""
    coupling = demagnetization.coupling(body, body.radii) if coupling is None else coupling
    x, n = body.positions, len(body.volumes)
    r = x[:, None] - x
    g1, g2, _ = oracle.radial_factors(np.linalg.norm(r, axis=2), body.radii[:, None], body.radii)
    t = (g1[..., None, None] * np.eye(3) + g2[..., None, None] * r[..., :, None] * r[..., None, :]) / (4 * math.pi)
    t[np.arange(n), np.arange(n)] = -np.eye(3) / (3.0 * body.volumes[:, None, None])
    i = np.repeat(np.arange(n), np.diff(coupling.start))
    grid = Rotation.from_quat(coupling.grid_rotation).as_matrix()
    t[i, coupling.other] += grid @ coupling.grid_tensor @ grid.T
    t += coupling.common
    t *= -np.sqrt(body.volumes[:, None] * body.volumes)[..., None, None]
    return t.transpose(0, 2, 1, 3).reshape(3 * n, 3 * n)


def coupled(body, solids):
    """Coupling of the cells of a body, as a model has it for the only iron of a world."""
    cells = linear_cells.with_slopes(demagnetization.coupling(body, body.radii), body)
    return uniform_response.with_surface_response(cells, body, solids).among(1, balls=False)


def pair_corrections(bodies, couplings, poses):
    """Tensors between cells of bodies at poses (rotation, position) by the float64 reference, shape [n, 3, n, 3]."""
    cells = [
        (turn.apply(x) + place, turn.as_matrix() @ Rotation.from_quat(coupling.grid_rotation).as_matrix(), half)
        for body, coupling, (turn, place) in zip(bodies, couplings, poses, strict=True)
        for x, half in zip(body.positions, coupling.half_sides, strict=True)
    ]
    labels = np.repeat(np.arange(len(bodies)), [len(body.volumes) for body in bodies])
    overlap = cell_pairs.OVERLAP_DEMAGNETIZATION, cell_pairs.OVERLAP
    windows = boxes.Windows(cell_pairs.WINDOW, cell_pairs.CLOSE, cell_pairs.FINE, cell_pairs.FLAT)
    return boxes.body_corrections(cells, labels, windows, *overlap)
