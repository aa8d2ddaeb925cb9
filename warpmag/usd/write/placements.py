"""Turns frames of bodies in the world into transforms and velocities of their prims."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from pxr import Gf, Usd, UsdGeom

from warpmag.usd.read.transforms import is_animated


@dataclass(frozen=True)
class Placed:
    """What the prims of bodies get, rows in their order.

    Attributes:
        positions: Translations in the parents [units of the stage], float64, shape [n, 3].
        turns: Orientations in the parents, quaternions x y z w, float32, shape [n, 4].
        linear: Velocities in the bodies' frames [units of the stage/s], float32, shape [n, 3].
        angular: Angular velocities there [degrees/s], float32, shape [n, 3].
    """

    positions: np.ndarray
    turns: np.ndarray
    linear: np.ndarray
    angular: np.ndarray


class Placements:
    """Places bodies, given in the world, in the parents of their prims.

    Attributes:
        paths: The prims.
        scales: Scale of each, apart from that of its parent, shape [n, 3].
        free: Whether each must leave its parent's transform behind, shape [n].
    """

    def __init__(self, stage: Usd.Stage, paths: Sequence[str], unit: float = 1.0):
        """Look at the prims ``paths`` and what is above them, which get lengths in a ``unit`` [m]."""
        self.paths, self._unit = list(paths), unit
        self._transforms = UsdGeom.XformCache(Usd.TimeCode.Default())
        prims, moving = [stage.GetPrimAtPath(path) for path in self.paths], set(self.paths)
        self.scales = _scales(
            np.reshape([self._transforms.GetLocalToWorldTransform(prim) for prim in prims], (-1, 4, 4))
        )
        self.free = np.zeros(len(prims), dtype=bool)
        below: dict[int, np.ndarray] = {}
        known: dict[str, tuple[np.ndarray | None, float, bool]] = {}  # thousands of bodies may have one parent
        for index, (path, prim) in enumerate(zip(self.paths, prims, strict=True)):
            above = path.rpartition("/")[0]
            if above not in known:
                parent = self._parent(prim, moving)
                known[above] = (
                    (parent, 1.0, True)
                    if parent is None
                    else (parent, _scale(parent), np.array_equal(parent, np.eye(4)))
                )
            parent, scale, same = known[above]
            self.free[index] = parent is None
            self.scales[index] /= scale
            if not same:
                below[index] = parent
        self._below = np.array(list(below), dtype=int)
        parents = list(below.values())
        self._into = np.reshape([np.linalg.inv(parent) for parent in parents], (-1, 4, 4))
        self._turn_into = np.reshape([turn_of(parent) * (-1.0, -1.0, -1.0, 1.0) for parent in parents], (-1, 4))

    def _parent(self, prim, moving) -> np.ndarray | None:
        """Return the parent's world transform, None where the prim must leave it behind.

        That is so where the parent moves, and where it would shear a turning body.
        """
        parent = prim.GetParent()
        above = parent
        while above and not above.IsPseudoRoot():
            if str(above.GetPath()) in moving or is_animated(above):
                return None
            above = above.GetParent()
        matrix = np.array(self._transforms.GetLocalToWorldTransform(parent))
        scale = _scale(matrix)
        # Scales are often authored in single precision.
        similar = np.allclose(matrix[:3, :3], scale * rigid(matrix)[:3, :3], rtol=0.0, atol=1e-6 * abs(scale))
        return matrix if similar else None

    def place(self, body_q: np.ndarray, body_qd: np.ndarray, last_turns: np.ndarray | None) -> Placed:
        """Place bodies.

        Args:
            body_q: Body frames in the world (position [m], quaternion x y z w), shape [n, 7].
            body_qd: Linear velocity of the centre of mass [m/s] and angular velocity [rad/s], world, shape [n, 6].
            last_turns: Orientations of the frame before, next to which those of this one are to be; None in the first.
        """
        # column by column in memory, which takes half the time
        positions, turns = (values.astype(np.float64, order="F") for values in (body_q[:, :3], body_q[:, 3:]))
        body_qd = body_qd.astype(np.float64, order="F")
        turns /= np.sqrt(dot(turns, turns))
        in_body = turns * (-1.0, -1.0, -1.0, 1.0)
        linear = rotate(in_body, body_qd[:, :3])
        angular = rotate(in_body, np.degrees(body_qd[:, 3:]))
        below = self._below
        if len(below):
            local = np.c_[positions[below], np.ones(len(below))]
            positions[below] = np.einsum("ni,nij->nj", local, self._into)[:, :3]
            turns[below] = product(self._turn_into, turns[below])
        if last_turns is not None:
            turns *= np.where(dot(turns, last_turns) < 0.0, -1.0, 1.0)
        return Placed(
            positions / self._unit, *(values.astype(np.float32) for values in (turns, linear / self._unit, angular))
        )


def _scale(matrix) -> float:
    """Return the mean scale of a transform, the cube root of its determinant."""
    return float(np.cbrt(np.linalg.det(matrix[:3, :3])))


def _scales(matrices: np.ndarray) -> np.ndarray:
    """Return the scales of transforms without what :func:`rigid` leaves of them, shape [n, 3]."""
    turns, values, _ = np.linalg.svd(matrices[:, :3, :3])
    return np.sign(np.linalg.det(matrices[:, :3, :3]))[:, None] * np.einsum("nij,nj->ni", turns**2, values)


def rigid(matrix) -> np.ndarray:
    """Return position and rotation of a transform, as USD's physics and Newton take them: the body's frame."""
    transform = Gf.Transform(Gf.Matrix4d(matrix.tolist()))
    rigid = Gf.Matrix4d().SetRotate(transform.GetRotation())
    rigid.SetTranslateOnly(transform.GetTranslation())
    return np.array(rigid)


def turn_of(matrix) -> np.ndarray:
    """Return the rotation of a transform as a quaternion x y z w."""
    turn = Gf.Transform(Gf.Matrix4d(matrix.tolist())).GetRotation().GetQuat()
    return np.array([*turn.GetImaginary(), turn.GetReal()])


def product(a, b) -> np.ndarray:
    """Return the product of quaternions x y z w, shape [n, 4]: first ``b``, then ``a``."""
    va, vb, wa, wb = a[:, :3], b[:, :3], a[:, 3:], b[:, 3:]
    return np.concatenate([wa * vb + wb * va + cross(va, vb), wa * wb - dot(va, vb)], axis=1)


def rotate(turns, vectors) -> np.ndarray:
    """Rotate ``vectors`` [n, 3] by quaternions ``turns`` [n, 4]."""
    axis, w = turns[:, :3], turns[:, 3:]
    across = 2.0 * cross(axis, vectors)
    return vectors + w * across + cross(axis, across)


def cross(a, b) -> np.ndarray:
    """Return cross products of rows; ``numpy.cross`` takes three times as long."""
    (ax, ay, az), (bx, by, bz) = a.T, b.T
    return np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx]).T


def dot(a, b) -> np.ndarray:
    """Return dot products of rows, shape [n, 1]."""
    return np.einsum("ni,ni->n", a, b)[:, None]
