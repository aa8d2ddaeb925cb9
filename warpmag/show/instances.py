"""Authors moving bodies as PointInstancers and field lines as curves, one array per time sample."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from pxr import Sdf, Usd, UsdGeom, Vt

from warpmag.declarations.rotations import rotate


@dataclass(frozen=True)
class InstanceArrays:
    """Instances over time; arrays without the leading axis f are constant.

    Attributes:
        positions: Positions in the world, shape [f, k, 3].
        kinds: Prototype of each instance, shape [f, k] or [k].
        turns: Quaternions x y z w, shape [f, k, 4]; None for no rotation.
        scales: Scale factors, shape [f, k] or [k].
        linear: Velocities [units/s], shape [f, k, 3]; None for no motion blur.
        angular: Angular velocities [rad/s], shape [f, k, 3]; None if ``turns`` is None.
    """

    positions: np.ndarray
    kinds: np.ndarray
    turns: np.ndarray | None = None
    scales: np.ndarray | None = None
    linear: np.ndarray | None = None
    angular: np.ndarray | None = None


def author_instances(
    stage: Usd.Stage, path: Sdf.Path, prototypes: Sequence[Sdf.Path], codes: np.ndarray, placed: InstanceArrays
) -> None:
    """Author a PointInstancer of existing prototypes."""
    prim = UsdGeom.PointInstancer.Define(stage, path)
    prim.CreatePrototypesRel().SetTargets(list(prototypes))
    boxes = np.array([_box_of(stage.GetPrimAtPath(prototype)) for prototype in prototypes]).reshape(-1, 2, 3)
    _set(prim.CreatePositionsAttr(), codes, placed.positions.astype(np.float32), Vt.Vec3fArray)
    kinds = placed.kinds
    if kinds.ndim == 2 and (kinds == kinds[0]).all():
        kinds = kinds[0]
    _set(prim.CreateProtoIndicesAttr(), codes, kinds.astype(np.int32), Vt.IntArray)
    if placed.scales is not None:
        scales = np.repeat(placed.scales[..., None], 3, axis=-1).astype(np.float32)
        _set(prim.CreateScalesAttr(), codes, scales, Vt.Vec3fArray)
    if placed.linear is not None and len(codes) > 1:
        _set(prim.CreateVelocitiesAttr(), codes, placed.linear.astype(np.float32), Vt.Vec3fArray)
    if placed.turns is not None:
        _set(prim.CreateOrientationsAttr(), codes, placed.turns.astype(np.float16), Vt.QuathArray)
    if placed.angular is not None and len(codes) > 1:
        _set(prim.CreateAngularVelocitiesAttr(), codes, np.degrees(placed.angular).astype(np.float32), Vt.Vec3fArray)
    extents = np.stack([_extent(placed, boxes, frame) for frame in range(len(codes))]).astype(np.float32)
    _set(prim.CreateExtentAttr(), codes, extents, Vt.Vec3fArray)


def author_curves(
    stage: Usd.Stage, path: Sdf.Path, codes: np.ndarray, points: np.ndarray, width: float
) -> UsdGeom.BasisCurves:
    """Author polylines that deform over time.

    Args:
        stage: The stage.
        path: Path of the curves.
        codes: Time codes, shape [f].
        points: Points of the lines, shape [f, lines, points, 3].
        width: Diameter.
    """
    curves = UsdGeom.BasisCurves.Define(stage, path)
    curves.CreateTypeAttr(UsdGeom.Tokens.linear)
    curves.CreateCurveVertexCountsAttr(Vt.IntArray([points.shape[2]] * points.shape[1]))
    curves.CreateWidthsAttr(Vt.FloatArray([width]))
    curves.SetWidthsInterpolation(UsdGeom.Tokens.constant)
    flat = points.reshape(len(codes), -1, 3).astype(np.float32)
    _set(curves.CreatePointsAttr(), codes, flat, Vt.Vec3fArray)
    extents = np.stack([flat.min(axis=1) - 0.5 * width, flat.max(axis=1) + 0.5 * width], axis=1)
    _set(curves.CreateExtentAttr(), codes, extents, Vt.Vec3fArray)
    return curves


def turns_to(vectors: np.ndarray) -> np.ndarray:
    """Return quaternions x y z w that rotate z to each vector, shape [..., 4]."""
    size = np.linalg.norm(vectors, axis=-1, keepdims=True)
    to = np.where(size > 0.0, vectors / np.maximum(size, 1e-300), (0.0, 0.0, 1.0))
    turns = np.stack([-to[..., 1], to[..., 0], np.zeros(to.shape[:-1]), 1.0 + to[..., 2]], axis=-1)
    turns[to[..., 2] < -1.0 + 1e-7] = (1.0, 0.0, 0.0, 0.0)
    return turns / np.linalg.norm(turns, axis=-1, keepdims=True)


def _set(attribute: Usd.Attribute, codes: np.ndarray, values: np.ndarray, array) -> None:
    """Author values, shape [f, k, ...], at the time codes, or one default value if they are constant."""
    sampled = values.ndim == (3 if array in (Vt.Vec3fArray, Vt.QuathArray) else 2)
    if not sampled or len(codes) == 1 or (values == values[0]).all():
        attribute.Set(array.FromNumpy(np.ascontiguousarray(values[0] if sampled else values)))
        return
    for code, value in zip(codes.tolist(), values, strict=True):
        attribute.Set(array.FromNumpy(np.ascontiguousarray(value)), code)


def _box_of(prim: Usd.Prim) -> np.ndarray:
    return np.array(UsdGeom.Boundable(prim).GetExtentAttr().Get(), dtype=float)


def _extent(placed: InstanceArrays, prototypes: np.ndarray, frame: int) -> np.ndarray:
    """Return the bounding box of all instances at a sample, shape [2, 3], from the boxes of the prototypes."""
    boxes = prototypes[placed.kinds if placed.kinds.ndim == 1 else placed.kinds[frame]]
    middle, half = boxes.mean(axis=1), 0.5 * (boxes[:, 1] - boxes[:, 0])
    if placed.scales is not None:
        scales = placed.scales if placed.scales.ndim == 1 else placed.scales[frame]
        middle, half = middle * scales[:, None], half * scales[:, None]
    if placed.turns is not None:
        turns = placed.turns[frame].astype(np.float16).astype(float)
        middle = rotate(turns, middle)
        half = sum(np.abs(rotate(turns, half * axis)) for axis in np.eye(3))
    middle = middle + placed.positions[frame]
    return np.stack([(middle - half).min(axis=0), (middle + half).max(axis=0)])
