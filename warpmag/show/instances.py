"""Authors moving bodies as PointInstancers and field lines as curves, one array per time sample."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from pxr import Sdf, Usd, UsdGeom, Vt

from warpmag.declarations.rotations import rotate


@dataclass(frozen=True)
class InstanceArrays:
    """Instances over time; arrays without the leading axis f are constant."""

    positions: np.ndarray  # in the world, shape [f, k, 3]
    prototypes: np.ndarray  # index of each instance's prototype, shape [f, k] or [k]
    orientations: np.ndarray | None = None  # quaternions x y z w, shape [f, k, 4]; None for no rotation
    scales: np.ndarray | None = None  # scale factors, shape [f, k] or [k]
    velocities: np.ndarray | None = None  # [units/s], shape [f, k, 3]; None for no motion blur
    angular_velocities: np.ndarray | None = None  # [rad/s], shape [f, k, 3]; None if ``orientations`` is None


def author_instances(
    stage: Usd.Stage, path: Sdf.Path, prototypes: Sequence[Sdf.Path], codes: np.ndarray, instances: InstanceArrays
) -> None:
    """Author a PointInstancer of existing prototypes."""
    prim = UsdGeom.PointInstancer.Define(stage, path)
    prim.CreatePrototypesRel().SetTargets(list(prototypes))
    boxes = [UsdGeom.Boundable(stage.GetPrimAtPath(prototype)).GetExtentAttr().Get() for prototype in prototypes]
    boxes = np.array(boxes, dtype=float).reshape(-1, 2, 3)
    indices, scales, angular = instances.prototypes, instances.scales, instances.angular_velocities
    if indices.ndim == 2 and (indices == indices[0]).all():
        indices = indices[0]
    moving = len(codes) > 1
    angular = np.degrees(angular) if moving and angular is not None else None
    for create, values, dtype, array in (
        (prim.CreatePositionsAttr, instances.positions, np.float32, Vt.Vec3fArray),
        (prim.CreateProtoIndicesAttr, indices, np.int32, Vt.IntArray),
        (prim.CreateScalesAttr, None if scales is None else scales[..., None].repeat(3, -1), np.float32, Vt.Vec3fArray),
        (prim.CreateVelocitiesAttr, instances.velocities if moving else None, np.float32, Vt.Vec3fArray),
        (prim.CreateOrientationsAttr, instances.orientations, np.float16, Vt.QuathArray),
        (prim.CreateAngularVelocitiesAttr, angular, np.float32, Vt.Vec3fArray),
    ):
        if values is not None:
            _set(create(), codes, values.astype(dtype), array)
    extents = np.stack([_extent(instances, boxes, frame) for frame in range(len(codes))]).astype(np.float32)
    _set(prim.CreateExtentAttr(), codes, extents, Vt.Vec3fArray)


def author_curves(
    stage: Usd.Stage, path: Sdf.Path, codes: np.ndarray, points: np.ndarray, width: float
) -> UsdGeom.BasisCurves:
    """Author polylines, shape [f, lines, points, 3], of a diameter ``width``, that deform over the time codes [f]."""
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


def rotations_from_z(vectors: np.ndarray) -> np.ndarray:
    """Return quaternions x y z w that rotate z to each vector, shape [..., 4]."""
    size = np.linalg.norm(vectors, axis=-1, keepdims=True)
    unit = np.where(size > 0.0, vectors / np.maximum(size, 1e-300), (0.0, 0.0, 1.0))
    rotations = np.stack([-unit[..., 1], unit[..., 0], np.zeros(unit.shape[:-1]), 1.0 + unit[..., 2]], axis=-1)
    rotations[unit[..., 2] < -1.0 + 1e-7] = (1.0, 0.0, 0.0, 0.0)
    return rotations / np.linalg.norm(rotations, axis=-1, keepdims=True)


def _set(attribute: Usd.Attribute, codes: np.ndarray, values: np.ndarray, array) -> None:
    """Author values, shape [f, k, ...], at the time codes, or one default value if they are constant."""
    sampled = values.ndim == (3 if array in (Vt.Vec3fArray, Vt.QuathArray) else 2)
    if not sampled or len(codes) == 1 or (values == values[0]).all():
        attribute.Set(array.FromNumpy(np.ascontiguousarray(values[0] if sampled else values)))
        return
    for code, value in zip(codes.tolist(), values, strict=True):
        attribute.Set(array.FromNumpy(np.ascontiguousarray(value)), code)


def _extent(instances: InstanceArrays, boxes: np.ndarray, frame: int) -> np.ndarray:
    """Return the bounding box of all instances at a sample, shape [2, 3], from the boxes of the prototypes."""
    indices, scales = instances.prototypes, instances.scales
    boxes = boxes[indices if indices.ndim == 1 else indices[frame]]
    center, half = boxes.mean(axis=1), 0.5 * (boxes[:, 1] - boxes[:, 0])
    if scales is not None:
        scales = scales if scales.ndim == 1 else scales[frame]
        center, half = center * scales[:, None], half * scales[:, None]
    if instances.orientations is not None:
        rotations = instances.orientations[frame].astype(np.float16).astype(float)
        center = rotate(rotations, center)
        half = sum(np.abs(rotate(rotations, half * axis)) for axis in np.eye(3))
    center = center + instances.positions[frame]
    return np.stack([(center - half).min(axis=0), (center + half).max(axis=0)])
