"""Quaternions (x, y, z, w) and vectors in rows of float64 or float32 arrays."""

import numpy as np


def conjugate(quaternions) -> np.ndarray:
    """Return the inverse rotations of unit quaternions, shape [..., 4]."""
    return quaternions * np.array((-1.0, -1.0, -1.0, 1.0))


def multiply(a, b) -> np.ndarray:
    """Return quaternion products a b, shape [n, 4]: rotation ``b`` first, then ``a``."""
    va, vb, wa, wb = a[:, :3], b[:, :3], a[:, 3:], b[:, 3:]
    return np.concatenate([wa * vb + wb * va + cross(va, vb), wa * wb - dot(va, vb)], axis=1)


def rotate(quaternions, vectors) -> np.ndarray:
    """Return ``vectors``, shape [n, 3], rotated by unit ``quaternions``, shape [n, 4]."""
    axis, w = quaternions[:, :3], quaternions[:, 3:]
    twice = 2.0 * cross(axis, vectors)
    return vectors + w * twice + cross(axis, twice)


def cross(a, b) -> np.ndarray:
    """Return cross products of rows, shape [n, 3]; ``numpy.cross`` takes three times as long."""
    (ax, ay, az), (bx, by, bz) = a.T, b.T
    return np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx]).T


def dot(a, b) -> np.ndarray:
    """Return dot products of rows, shape [n, 1]."""
    return np.einsum("ni,ni->n", a, b)[:, None]


def quaternion_of(matrix) -> np.ndarray:
    """Return the quaternion (x, y, z, w) of a rotation matrix, shape [4]: an eigenvector (Bar-Itzhack 2000)."""
    m = np.asarray(matrix, float)
    axis = np.array([m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]])
    symmetric = np.zeros((4, 4))
    symmetric[:3, :3] = m + m.T - np.trace(m) * np.eye(3)
    symmetric[3, :3] = symmetric[:3, 3] = axis
    symmetric[3, 3] = np.trace(m)
    return np.linalg.eigh(symmetric)[1][:, -1]
