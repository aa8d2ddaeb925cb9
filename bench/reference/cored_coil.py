"""Reference inductance of a solenoid with a cylindrical core in plain NumPy and SciPy, float64: finite volumes.

The azimuthal vector potential A of an axisymmetric field satisfies ∇×(∇×A/μ) = J. With u = r A, constant on flux tubes,

    −∂/∂r (1/(μ r) ∂u/∂r) − ∂/∂z (1/(μ r) ∂u/∂z) = J.

Nodes are dense around core and coil and sparse toward u = 0 far away. Independent of moments and of closed forms.
"""

import itertools

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.linalg import spsolve

MU0 = 4e-7 * np.pi


def inductance(radius, length, *, core_radius=0.0, core_length=0.0, permeability=1.0, offset=0.0, cells=24) -> float:
    """Return the inductance of a current sheet of one turn around a core of relative ``permeability`` [H].

    Args:
        radius: Radius of the sheet [m].
        length: Length of the sheet [m], centered at z = 0.
        core_radius: Radius of the core [m], smaller than that of the sheet.
        core_length: Length of the core [m].
        permeability: μr of the core.
        offset: Height of the core's center above that of the sheet [m].
        cells: Cells per radius of the core or the sheet, whichever is smaller.
    """
    size = min(radius, core_radius or radius) / cells
    ends = [0.5 * length, -0.5 * length, offset + 0.5 * core_length, offset - 0.5 * core_length]
    r = _nodes([0.0, core_radius, radius], size, 20.0 * (radius + length), below=False)
    z = _nodes(ends, size, 20.0 * (radius + length))
    rc, zc = 0.5 * (r[1:] + r[:-1]), 0.5 * (z[1:] + z[:-1])
    inside = (rc[:, None] < core_radius) & (np.abs(zc - offset) < 0.5 * core_length)
    weight = 1.0 / (MU0 * np.where(inside, permeability, 1.0) * rc[:, None])  # of each cell
    index = np.arange(len(r) * len(z)).reshape(len(r), len(z))
    dr, dz = np.diff(r)[:, None], np.diff(z)[None]
    # conductance of an edge between nodes: half of the cells on either side
    along_r, along_z = np.zeros((len(r) - 1, len(z))), np.zeros((len(r), len(z) - 1))
    along_r[:, :-1] += 0.5 * weight * dz / dr
    along_r[:, 1:] += 0.5 * weight * dz / dr
    along_z[:-1] += 0.5 * weight * dr / dz
    along_z[1:] += 0.5 * weight * dr / dz
    pairs = [(index[:-1], index[1:], along_r), (index[:, :-1], index[:, 1:], along_z)]
    first, second, value = (np.concatenate([pair[k].ravel() for pair in pairs]) for k in range(3))
    rows, columns = np.concatenate([first, second, first, second]), np.concatenate([second, first, first, second])
    matrix = coo_array((np.concatenate([-value, -value, value, value]), (rows, columns))).tocsr()
    free = np.zeros(index.shape, bool)
    free[1:-1, 1:-1] = True
    sheet = np.zeros(index.shape)  # current of each node, one ampere-turn in all
    ring = np.argmin(np.abs(r - radius))
    heights = (zc > -0.5 * length) & (zc < 0.5 * length)
    share = np.where(heights, dz[0] / length, 0.0)
    sheet[ring, :-1] += 0.5 * share
    sheet[ring, 1:] += 0.5 * share
    inner, current = free.ravel(), sheet.ravel()
    potential = spsolve(matrix[inner][:, inner].tocsc(), current[inner])
    return 2.0 * np.pi * float(np.dot(potential, current[inner]))


def _nodes(marks, size: float, far: float, *, below: bool = True) -> np.ndarray:
    """Return nodes at ``size`` between marks, growing by a tenth each toward ±``far``."""
    marks = np.unique(np.round(marks, 12))
    parts = [np.linspace(a, b, max(2, round((b - a) / size) + 1)) for a, b in itertools.pairwise(marks)]
    steps = size * 1.1 ** np.arange(1, 200)
    outward = np.cumsum(steps)
    outward = outward[: np.searchsorted(outward, far) + 1]
    low = marks[0] - outward[::-1] if below else np.zeros(0)
    return np.unique(np.round(np.concatenate([low, *parts, marks[-1] + outward]), 12))
