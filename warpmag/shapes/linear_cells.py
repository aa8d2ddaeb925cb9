"""Cells whose magnetization varies along its own axes: differences between their halves, and the operator of a body.

Iron of high permeability has charges on its surface and almost none inside. Uniform cells have charges on the faces
between them wherever the magnetization varies. These charges cost energy, and the body responds too little: two
letters in contact attract each other 20 % too weakly. So each component of the magnetization has a slope along its own
axis, from the neighbors on both sides. Where div M = 0 the charges in a cell then cancel, and faces have almost none.

The unknowns stay one vector M per cell, the mean. Along axis k the halves of a cell have the means M ± D M, with

    D M = ¼ Σ_s s w_s (M_s − M),    s = ±1,    w_s = ½ min(V_s/V, V/V_s) b b_s,    b = min(1, V_grid/V),

where V is the volume of the cell, V_grid that of a whole cell of the grid, and M_s, V_s, b_s belong to the neighbor on
the side s. Without a neighbor w_s is 0. V exceeds V_grid where a cell includes pieces of its neighbors. The factors
reduce the slopes of cells that differ in volume from their neighbors or from V_grid. With the full slopes of such cells
the operator is not positive. The field that magnetizes a cell is the derivative of the energy: the mean field, plus Dᵀ
of half the difference of the fields of the halves.

The halves are uniform, but the magnetization they represent is linear. The difference of the two is a sawtooth along
the axis, of period l/2 for a side l. Deep in a body its field is H = −M as in a plate, and its energy per volume, μ0 (D
M)²/6, remains where div M = 0. So it is subtracted. In a sheet of thickness t the field is weaker. It is weakest where
the next sheets on both sides have the opposite sawtooth. A harmonic wave in a stack of such sheets has the
demagnetizing factor

    1 − tanh(p/2)/(p/2),    p = 4π t/l.

Only this part of the energy is subtracted. If all of it were subtracted, the energy of a sheet could be negative, and
the solve of a sheet of 60 × 60 × 0.1 mm on a plate would not converge.

A body that is the only iron in its world has no neighboring sheets, and two changes make the force on magnets near it
more accurate (:class:`~warpmag.shapes.demagnetization.LoneSlopes`). Where all cells have neighbors along all axes, all
of the sawtooth's energy is subtracted. In other bodies, such as a sheet of one layer, the halves of a cell differ along
the axes without neighbors, too. Flux that enters a sheet through one face turns into the sheet, so the normal component
falls to 0 at the other face. The difference is the one for which div M = 0:

    D M = −(l/n) Σ_k D M_k/l_k

with the sides l of the cell, over the axes k with neighbors, for each of n axes without. Otherwise a magnet 1 mm over
1 mm of iron would be pulled 5 % too weakly, however small the cells are. The energy of the sawtooth of these
differences is not subtracted. If it were, a magnet 1 mm over 2 mm of steel would be pulled 4 % too strongly. Among
other iron there are no such differences. Two sheets that lie on each other would have eigenvalues up to 90 % smaller
with them.

Magnetizations without charges have no energy. In iron they do not occur, because M follows the curl-free field H. But
conjugate gradients need many steps for them, and errors of distant pairs of cells would make their energy negative. So
the curl of M at the edges between cells has a small energy, κ μ0 (l curl M)²/2 per volume. Here l is the geometric mean
of the sides of a cell perpendicular to the edge, and κ is :data:`_CURL` or :data:`_LARGE_CURL`.

A coupling has entries for near cells only. The fields of differences end where its entries end. An abrupt end would
give some magnetizations without charges negative energies in compact bodies: the operator of a cylinder of 621 cells
would have an eigenvalue of -0.0008. So these fields fade over the outer half of the distances, :data:`_FADING`.
"""

from dataclasses import replace

import numpy as np
from scipy.sparse import csr_array, diags_array, eye_array

from warpmag.shapes.demagnetization import Coupling, LoneSlopes, Slopes, cuboid_tensors, full_tensors, rotated
from warpmag.shapes.lattice import Lattice, Pieces
from warpmag.shapes.solids import grid

LEAST_CELLS = 65
"""Smallest number of linear cells of a body. Smaller bodies get the response of their surface
(``uniform_response.py``)."""
_CURL = 0.001
"""Demagnetizing factor of the curl. Cylinders side by side at 0.2 mm attract each other 1 % too weakly, and 9 % with
0.004. With 0.0007 three plates of three layers that lie on each other would have an eigenvalue of -0.0002."""
_LARGE_CURL = 0.004
"""The same in bodies of one or two layers or of several shapes. The fields of the layers almost cancel, and errors of
the pairs between bodies matter more: with 0.001 a stack of five sheets of two layers would take five times as many
evaluations. With 0.002 a hammer of two shapes at an angle would have an eigenvalue of -0.002."""
_FADING = 0.5, 1.1
"""Distances at which fields of differences start to fade and have ended, over the largest distance of a coupling's
entries. With 0.45 and 1.05 letters in contact attract each other 0.1 % less, and cylinders side by side
0.8 % less."""
_WITHIN_HALF = 1.0 / 3.0
"""Demagnetizing factor of the linear part within a half, for the difference D M, deep in a body."""


def with_slopes(coupling: Coupling, lattice: Lattice) -> Coupling:
    """Return the coupling with linear cells. Bodies of fewer than :data:`LEAST_CELLS` are returned unchanged."""
    if len(coupling.radii) < LEAST_CELLS:
        return coupling
    (part,) = lattice.pieces  # the shapes of an inducible body share a grid
    index = _cell_indices(part)
    neighbor, weight = _neighbors(index, lattice.volumes / part.sides.prod())
    curl_factor = _curl_factor(index, lattice.owners)
    operator = _Operator(coupling, part, index, lattice.volumes, neighbor, weight, curl_factor)
    tensor = operator.tensors()
    layer, added = _layer_factors(weight, part.sides), {(k, k): operator.sawtooth(k) for k in range(3)}
    if layer.any():
        operator.take_layers(layer)
        change = operator.tensors() - tensor
        added = {(k, j): change[:, k, j] for k in range(3) for j in range(3)}
    slopes = Slopes(neighbor, weight, np.zeros_like(layer), tensor, LoneSlopes(layer, added))
    return replace(coupling, slopes=slopes)


def _cell_indices(part: Pieces) -> np.ndarray:
    """Return the grid index of the cell with the largest part of each moment, shape [n, 3]."""
    order = np.lexsort((part.share * part.filled.mean(axis=(1, 2, 3))[part.piece], part.moment))
    last = np.append(np.flatnonzero(np.diff(part.moment[order])), len(order) - 1)
    return part.index[part.piece[order[last]]]


def _neighbors(index: np.ndarray, volumes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return neighbors and weights; ``volumes`` are relative to the volume of a whole cell.

    Neighbors are mutual. Of two cells at one index only the larger one has neighbors.
    """
    cells = {}
    for i in np.argsort(volumes, kind="stable").tolist():
        cells[tuple(index[i])] = i
    own = np.arange(len(index))
    neighbor = np.repeat(own[:, None], 6, axis=1)
    for side in range(6):
        step = np.eye(3, dtype=int)[side // 2] * (2 * (side % 2) - 1)
        for at, i in cells.items():
            neighbor[i, side] = cells.get(tuple(at + step), i)
    ratio, whole = volumes[neighbor] / volumes[:, None], np.minimum(1.0, 1.0 / volumes)
    weight = 0.5 * (neighbor != own[:, None]) * np.minimum(ratio, 1.0 / ratio) * whole[:, None] * whole[neighbor]
    return neighbor, weight


def _layer_factors(weight: np.ndarray, sides: np.ndarray) -> np.ndarray:
    """Return the factors of differences across layers, from weights of neighbors [n, 6] and sides of cells [3].

    They are positive for axes without neighbors, negative for the others, and 0 for cells with neighbors along all
    axes. Shape [n, 3].
    """
    alone, size = (weight.reshape(-1, 3, 2) == 0.0).all(axis=2), sides / sides.max()
    count = alone.sum(axis=1, keepdims=True)
    return np.where(alone, size / np.maximum(count, 1), -1.0 / size) * ((count > 0) & (count < 3))


class _Operator:
    """Operator of a body's linear cells minus the pair law, symmetrized by the roots of volumes."""

    def __init__(self, coupling, part: Pieces, index, volumes, neighbor, weight, curl_factor):
        """Compute the tensors of the coupling's entries in the frame of the grid."""
        self.row, self.other = np.repeat(np.arange(len(volumes)), np.diff(coupling.start)), coupling.other
        self._own, self._root, self._neighbor, self._weight = (
            np.arange(len(volumes)),
            np.sqrt(volumes),
            neighbor,
            weight,
        )
        scale = self._root[self.row] * self._root[self.other]
        own = self.row == self.other
        self._of_means = full_tensors(rotated(coupling.tensor, part.rotation.T)) * scale[:, None, None]
        self._of_means[own] -= np.eye(3) / 3.0  # the curve of a ball contains 1/3 of the cell's own field
        offsets, inverse = np.unique(index[self.row] - index[self.other], axis=0, return_inverse=True)
        shares = (scale * _fading((offsets * part.sides)[inverse.reshape(-1)]) / part.sides.prod())[:, None, None]
        self._differences = [-block[inverse.reshape(-1)] * shares for block in half_cell_tensors(offsets, part.sides)]
        within_half = _within_half(index, part.sides)
        self._differences[2][own] += np.diag(within_half)
        self._left_sawtooth = _WITHIN_HALF - within_half
        self._slopes = [{k: self._difference(k)} for k in range(3)]  # by component of M and axis of the difference
        self._curls = [self._curl(axis, part.sides) for axis in range(3)]
        self._curl_factor = curl_factor

    def take_layers(self, factors: np.ndarray) -> None:
        """Include differences across layers from now on, with the factors of :func:`_layer_factors`.

        The energy of their sawtooth is not subtracted.
        """
        own = np.flatnonzero(self.row == self.other)
        for axis in range(3):
            self._differences[2][own[factors[:, axis] > 0.0], axis, axis] -= _WITHIN_HALF - self._left_sawtooth[axis]
        across = [axis for axis in range(3) if (factors[:, axis] > 0.0).any()]
        for j, slopes in enumerate(self._slopes):
            outward = diags_array(np.minimum(factors[:, j], 0.0)) @ slopes[j]
            for axis in across:
                added = diags_array(np.maximum(factors[:, axis], 0.0)) @ outward
                slopes[axis] = slopes[axis] + added if axis in slopes else added

    def tensors(self) -> np.ndarray:
        """Return T_ij of the coupling's entries [1/m³], shape [entries, 3, 3]."""
        tensor = np.empty((len(self.other), 3, 3))
        for k in range(3):
            for j in range(k, 3):
                tensor[:, k, j], tensor[:, j, k] = self.entries(k, j)
        return tensor / (self._root[self.row] * self._root[self.other])[:, None, None]

    def entries(self, k: int, j: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the operator's entries of the coupling from component j to component k, and back, shape [entries].

        Slopes reach farther than the coupling. Omitted entries are added to the diagonal, as if the other cells had the
        same magnetization, so that uniform magnetizations have neither slopes nor their energy.
        """
        block = self.block(k, j)
        there, back = block[self.row, self.other], block[self.other, self.row]
        both, root = 0.5 * (block + block.T), self._root
        listed = np.bincount(self.row, 0.5 * (there + back) * root[self.other], len(root))
        left_out = (both @ root - listed) / root
        own = self.row == self.other
        there[own] += left_out
        back[own] += left_out
        return there, back

    def block(self, k: int, j: int) -> csr_array:
        """Return the operator from component j to component k, shape [n, n]."""
        by_differences, at_differences, differences = self._differences
        block = self._matrix(self._of_means[:, k, j])
        for axis, of_slope in self._slopes[j].items():
            block += self._matrix(by_differences[:, k, axis]) @ of_slope
        for axis, at_slope in self._slopes[k].items():
            field = self._matrix(at_differences[:, axis, j])
            for other, of_slope in self._slopes[j].items():
                field += self._matrix(differences[:, axis, other]) @ of_slope
            block += at_slope.T @ field
        for curl in self._curls:
            if k in curl and j in curl:
                block -= self._curl_factor * (curl[k].T @ curl[j])
        return (block + eye_array(len(self._own)) / 3.0 if k == j else block).tocsr()

    def _matrix(self, entries: np.ndarray) -> csr_array:
        """Return the matrix of the coupling's entries, shape [n, n]."""
        n = len(self._own)
        return csr_array((entries, (self.row, self.other)), shape=(n, n))

    def sawtooth(self, k: int) -> np.ndarray:
        """Return T_ij of the energy of the sawtooth along axis k that is not yet subtracted [1/m³], shape [entries]."""
        slope = self._slopes[k][k]
        energy = (slope.T @ slope).tocsr()[self.row, self.other]
        return self._left_sawtooth[k] * energy / (self._root[self.row] * self._root[self.other])

    def _difference(self, axis: int) -> csr_array:
        """Return D of √V M along an axis, shape [n, n]."""
        n, parts = len(self._own), []
        for side in (2 * axis, 2 * axis + 1):
            neighbor, weight = self._neighbor[:, side], (0.5 * (side % 2) - 0.25) * self._weight[:, side]
            parts.append((-weight, self._own))
            parts.append((weight * self._root / self._root[neighbor], neighbor))
        values, columns = (np.concatenate(part) for part in zip(*parts, strict=True))
        return csr_array((values, (np.tile(self._own, 4), columns)), shape=(n, n))

    def _curl(self, axis: int, sides: np.ndarray) -> dict:
        """Return the curl along an axis at the edges between four cells, by components of √V M, each [edges, n]."""
        k, j = (axis + 1) % 3, (axis + 2) % 3
        beside, above = self._neighbor[:, 2 * k + 1], self._neighbor[:, 2 * j + 1]
        across = self._neighbor[beside, 2 * j + 1]
        four = (beside != self._own) & (above != self._own) & (across != beside) & (across != above)
        edge = np.flatnonzero(four & (self._neighbor[above, 2 * k + 1] == across))
        cells = np.stack([edge, beside[edge], above[edge], across[edge]])
        least = self._root[cells].min(axis=0)
        rows = np.tile(np.arange(len(edge)), 4)
        shape, ratio, result = (len(edge), len(self._own)), np.sqrt(sides[j] / sides[k]), {}
        for component, signs, factor in ((j, (-1, 1, -1, 1), ratio), (k, (1, 1, -1, -1), 1.0 / ratio)):
            values = 0.5 * factor * np.array(signs)[:, None] * least / self._root[cells]
            result[component] = csr_array((values.ravel(), (rows, cells.ravel())), shape=shape)
        return result


def _curl_factor(index: np.ndarray, owners: np.ndarray) -> float:
    """Return the demagnetizing factor of the curl, from grid indices [n, 3] and shapes [n] of a body's cells."""
    is_sheet, is_compound = np.ptp(index, axis=0).min() < 2, np.ptp(owners) > 0
    return _LARGE_CURL if is_sheet or is_compound else _CURL


def _fading(separations: np.ndarray) -> np.ndarray:
    """Return the factors of fields of differences between cells, from their separations, shape [entries, 3]."""
    distances, (begin, end) = np.linalg.norm(separations, axis=1), _FADING
    farthest = distances.max() or 1.0  # 0 if all cells are far apart
    left = np.clip((end - distances / farthest) / (end - begin), 0.0, 1.0)
    return left * left * (3.0 - 2.0 * left)


def _within_half(index: np.ndarray, sides: np.ndarray) -> np.ndarray:
    """Return the demagnetizing factors of the linear parts within halves along each axis, shape [3].

    ``index`` are the grid indices of a body's cells, shape [n, 3], ``sides`` those of a whole cell, shape [3].
    """
    extent = (np.ptp(index, axis=0) + 1) * sides
    thickness = np.array([min(extent[k - 2], extent[k - 1]) for k in range(3)])
    phase = 4.0 * np.pi * thickness / sides
    return _WITHIN_HALF * (1.0 - np.tanh(phase / 2.0) / (phase / 2.0))


def half_cell_tensors(offsets: np.ndarray, sides: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return demagnetizing tensors between the means and differences of cells, three arrays of shape [n, 3, 3].

    They map differences to mean fields, means to differences of fields, and differences to differences of fields.
    ``offsets`` are the vectors from sources to targets in ``sides``, whole numbers, shape [n, 3].
    """
    steps = grid(np.array([3, 3, 3])).astype(int) - 1  # between an octant of the target and one of the source
    octants = np.asarray(offsets)[:, None] * 2 + steps
    tensors = full_tensors(cuboid_tensors(octants.reshape(-1, 3), np.asarray(sides) / 2.0)).reshape(-1, 27, 3, 3)
    both, of_source, of_target, of_both = np.array([[1, 2, 1], [1, 0, -1], [-1, 0, 1], [-1, 2, -1]]) / 2.0
    results = tuple(np.zeros((len(octants), 3, 3)) for _ in range(3))
    for k in range(3):
        for j in range(3):
            patterns = (
                [of_source if axis == j else both for axis in range(3)],
                [of_target if axis == k else both for axis in range(3)],
                [of_both if axis == j == k else of_source if axis == j else of_target if axis == k else both
                 for axis in range(3)],
            )  # fmt: skip
            for result, pattern in zip(results, patterns, strict=True):
                weights = np.prod([row[steps[:, axis] + 1] for axis, row in enumerate(pattern)], axis=0)
                result[:, k, j] = tensors[:, :, k, j] @ weights
    return results[0], results[1], results[2]
