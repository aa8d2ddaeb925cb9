"""Converts frames of bodies in the world into transforms and velocities of their prims."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from pxr import Usd, UsdGeom

from warpmag.declarations.rotations import conjugate, dot, multiply, rotate
from warpmag.usd.read.prims import lineage
from warpmag.usd.read.transforms import is_animated, rigid_part, rotation_of


@dataclass(frozen=True)
class Placed:
    """Attributes of the prims of bodies, one row each."""

    positions: np.ndarray  # translations in the parent frames [units of the stage], float64, shape [n, 3]
    rotations: np.ndarray  # orientations in the parent frames, quaternions (x, y, z, w), float32, shape [n, 4]
    linear: np.ndarray  # velocities in the body frames [units of the stage/s], float32, shape [n, 3]
    angular: np.ndarray  # angular velocities in the body frames [degrees/s], float32, shape [n, 3]


class Placements:
    """Converts bodies from the world into the frames of their parent prims.

    Attributes:
        paths: Paths of the bodies.
        scales: Scale of each body relative to its parent, shape [n, 3].
        resets: True for each body that must ignore its parent's transform (``!resetXformStack!``), shape [n].
    """

    def __init__(self, stage: Usd.Stage, paths: Sequence[str], unit: float = 1.0):
        """Read the transforms of the prims ``paths`` and their parents; ``unit`` is the written unit of length [m]."""
        self.paths, self._unit = list(paths), unit
        self._transforms = UsdGeom.XformCache(Usd.TimeCode.Default())
        prims, moving = [stage.GetPrimAtPath(path) for path in self.paths], set(self.paths)
        frames = np.reshape([self._transforms.GetLocalToWorldTransform(prim) for prim in prims], (-1, 4, 4))
        self.scales = _scales(frames)
        self.resets = np.zeros(len(prims), dtype=bool)
        transformed: dict[int, np.ndarray] = {}
        known: dict[str, tuple[np.ndarray | None, float, bool]] = {}  # thousands of bodies may share a parent
        for index, (path, prim) in enumerate(zip(self.paths, prims, strict=True)):
            parent_path = path.rpartition("/")[0]
            if parent_path not in known:
                parent = self._parent(prim, moving)
                known[parent_path] = (None, 1.0, True)
                if parent is not None:
                    known[parent_path] = (parent, _scale(parent), np.array_equal(parent, np.eye(4)))
            parent, scale, is_identity = known[parent_path]
            self.resets[index] = parent is None
            self.scales[index] /= scale
            if not is_identity:
                transformed[index] = parent
        self._transformed = np.array(list(transformed), dtype=int)
        parents = list(transformed.values())
        self._to_parent = np.reshape([np.linalg.inv(parent) for parent in parents], (-1, 4, 4))
        self._rotation_to_parent = np.reshape([conjugate(rotation_of(parent)) for parent in parents], (-1, 4))

    def _parent(self, prim, moving) -> np.ndarray | None:
        """Return the parent's world transform; None where the parent moves, or would shear a rotating body."""
        parent = prim.GetParent()
        if any(str(ancestor.GetPath()) in moving or is_animated(ancestor) for ancestor in lineage(parent)):
            return None
        matrix = np.array(self._transforms.GetLocalToWorldTransform(parent))
        scale = _scale(matrix)
        # scales are often authored in single precision
        similar = np.allclose(matrix[:3, :3], scale * rigid_part(matrix)[:3, :3], rtol=0.0, atol=1e-6 * abs(scale))
        return matrix if similar else None

    def place(self, body_q: np.ndarray, body_qd: np.ndarray, last_rotations: np.ndarray | None) -> Placed:
        """Return the attributes of the bodies in one frame, see :meth:`CacheWriter.add_frame`.

        Each quaternion gets the sign closer to that of the previous frame, ``last_rotations``, so that interpolation
        takes the shorter arc.
        """
        # column-major arrays halve the time
        positions, rotations = (values.astype(np.float64, order="F") for values in (body_q[:, :3], body_q[:, 3:]))
        body_qd = body_qd.astype(np.float64, order="F")
        rotations /= np.sqrt(dot(rotations, rotations))
        to_body = conjugate(rotations)
        linear = rotate(to_body, body_qd[:, :3])
        angular = rotate(to_body, np.degrees(body_qd[:, 3:]))
        rows = self._transformed
        if len(rows):
            local = np.c_[positions[rows], np.ones(len(rows))]
            positions[rows] = np.einsum("ni,nij->nj", local, self._to_parent)[:, :3]
            rotations[rows] = multiply(self._rotation_to_parent, rotations[rows])
        if last_rotations is not None:
            rotations *= np.where(dot(rotations, last_rotations) < 0.0, -1.0, 1.0)
        return Placed(
            positions / self._unit, *(values.astype(np.float32) for values in (rotations, linear / self._unit, angular))
        )


def _scale(matrix) -> float:
    """Return the mean scale of a transform, the cube root of its determinant."""
    return float(np.cbrt(np.linalg.det(matrix[:3, :3])))


def _scales(matrices: np.ndarray) -> np.ndarray:
    """Return the scales of transforms, which :func:`rigid_part` drops, shape [n, 3]."""
    axes, values, _ = np.linalg.svd(matrices[:, :3, :3])
    return np.sign(np.linalg.det(matrices[:, :3, :3]))[:, None] * np.einsum("nij,nj->ni", axes**2, values)
