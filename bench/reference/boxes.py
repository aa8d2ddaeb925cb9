"""Moments of ideally permeable boxes from a surface integral equation, for ``tests/test_cells.py``.

The surface of a body of infinite permeability is at one potential: (1/4π) ∫ σ/‖x − y‖ dA = H0·x, and its moment is
∫ σ x dA. σ is taken as constant on rectangles that shrink towards the edges, where it is singular; their potentials are
known in closed form, taken at their centres. An eighth of the surface is enough: σ is odd along H0 and even across it.

Run as ``python -m bench.reference.boxes``; with twice the rectangles along each side numbers change by less than 0.2 %.
"""

import numpy as np

BOXES = ((1.0, 1.0, 1.0), (1.0, 1.0, 5.0), (1.0, 1.0, 10.0), (5.0, 5.0, 1.0), (10.0, 10.0, 1.0))


def moments(sides, rectangles: int = 12) -> np.ndarray:
    """Moment over V H0 along each axis of a box of given ``sides``, shape [3]."""
    half = 0.5 * np.asarray(sides, float)
    lower, upper, axis = faces_of_eighth(half, rectangles)
    centre = 0.5 * (lower + upper)
    area = np.prod(np.where(np.arange(3) == axis[:, None], 1.0, upper - lower), axis=1)
    found = []
    for along in range(3):
        matrix = np.zeros((len(axis), len(axis)))
        for mirror in np.ndindex(2, 2, 2):
            signs = 1.0 - 2.0 * np.array(mirror)
            matrix += signs[along] * _potentials(centre * signs, lower, upper, axis)
        charge = np.linalg.solve(matrix, centre[:, along])
        found.append(8.0 * (charge * area) @ centre[:, along] / np.prod(sides))
    return np.array(found)


def moments_within(faces, volume: float, rectangles: int = 12) -> np.ndarray:
    """Moment over V H0 of a body bounded by rectangles, whatever its symmetry, shape [3, 3].

    Args:
        faces: Lower and upper corner of each, equal along the axis that it is across, shape [n, 2, 3].
        volume: Volume of the body.
        rectangles: Into how many rectangles to divide each along each of its axes.
    """
    parts = [_divided(face, rectangles) for face in np.asarray(faces, float)]
    lower, upper, axis = (np.concatenate(one) for one in zip(*parts, strict=True))
    centre, size = 0.5 * (lower + upper), upper - lower
    area = np.prod(np.where(np.arange(3) == axis[:, None], 1.0, size), axis=1)
    matrix = np.ones((len(axis) + 1, len(axis) + 1))  # the potential of the body is free, its charge is zero
    matrix[:-1, :-1] = _potentials(centre, lower, upper, axis)
    matrix[-1] = np.append(area, 0.0)
    charge = np.linalg.solve(matrix, np.append(centre, np.zeros((1, 3)), axis=0))[:-1]
    return (charge * area[:, None]).T @ centre / volume


def _divided(face, count: int):
    """Corners of rectangles that shrink towards the edges of one, and the axis that they are across."""
    axis = int(np.ptp(face, axis=0).argmin())
    at = 0.5 - 0.5 * np.cos(np.pi * np.linspace(0.0, 1.0, count + 1))
    edges = face[0] + np.outer(at, face[1] - face[0])
    a, b = (axis + 1) % 3, (axis + 2) % 3
    i, j = (one.reshape(-1) for one in np.meshgrid(np.arange(count), np.arange(count)))
    corners = np.tile(face[0], (2, count * count, 1))
    corners[:, :, a], corners[:, :, b] = [edges[i, a], edges[i + 1, a]], [edges[j, b], edges[j + 1, b]]
    return corners[0], corners[1], np.full(count * count, axis)


def faces_of_eighth(half, count: int):
    """Corners of the rectangles of an eighth of the surface, shapes [n, 3], and the axis that each is across."""
    lower, upper, axes = [], [], []
    for axis in range(3):
        edges = [h * np.sin(0.5 * np.pi * np.linspace(0.0, 1.0, count + 1)) for h in half]
        a, b = (axis + 1) % 3, (axis + 2) % 3
        for i, j in np.ndindex(count, count):
            corner = np.empty((2, 3))
            corner[:, axis] = half[axis]
            corner[:, a], corner[:, b] = edges[a][i : i + 2], edges[b][j : j + 2]
            lower.append(corner[0])
            upper.append(corner[1])
            axes.append(axis)
    return np.array(lower), np.array(upper), np.array(axes)


def _potentials(points, lower, upper, axes):
    """(1/4π) ∫ dA/‖x − y‖ of each rectangle at each point, shape [points, rectangles]."""
    result = np.empty((len(points), len(axes)))
    for axis in range(3):
        which = np.flatnonzero(axes == axis)
        a, b = (axis + 1) % 3, (axis + 2) % 3
        z = np.abs(points[:, None, axis] - lower[None, which, axis])
        total = 0.0
        for i, j in np.ndindex(2, 2):
            x = (upper if i else lower)[None, which, a] - points[:, None, a]
            y = (upper if j else lower)[None, which, b] - points[:, None, b]
            r = np.sqrt(x * x + y * y + z * z)
            part = _times_log(x, y, r) + _times_log(y, x, r) - z * np.arctan2(x * y, z * r)
            total = total + (1.0 if i == j else -1.0) * part
        result[:, which] = total / (4.0 * np.pi)
    return result


def _times_log(a, b, r):
    """a ln(b + r), or for b < 0 the equal a ln((r² − b²)/(r − b)), which keeps its digits."""
    tiny = np.finfo(float).tiny
    far, near = np.maximum(r + np.abs(b), tiny), np.maximum(r * r - b * b, tiny)
    return a * np.where(b > 0.0, np.log(far), np.log(near) - np.log(far))


def main() -> None:
    """Print the moments of all boxes."""
    for sides in BOXES:
        coarse, fine = moments(sides, 8), moments(sides, 16)
        print(sides, "m/(V H0)", fine.round(4), "change from half as many", (fine / coarse - 1.0).round(4))


if __name__ == "__main__":
    main()
