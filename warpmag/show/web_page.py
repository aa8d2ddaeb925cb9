"""Makes a web page of a stage for renderers, to orbit and play: a viser recording inside viser's own client."""

import contextlib
import functools
import html
import io
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from pxr import Usd, UsdGeom, Vt

from warpmag.errors import InputError, extra
from warpmag.show.glb import glb
from warpmag.show.materials import bound_material, surface_value
from warpmag.show.meshes import corner_normals, shape_of, triangles_of
from warpmag.usd.read.input_errors import usd_errors
from warpmag.usd.read.transforms import rigid_part, rotation_of
from warpmag.usd.values import number, value_of, vector

_REACH = 2.0
"""Half the size of the scene in units of the page: viser's shadows and near plane suit this size."""
_OUTSIDE = 0.02
"""Fraction of body positions that the camera ignores on each side, since a few bodies may fly far."""
_DIRECTION = (0.55, -0.75, 0.45)
"""Direction from the bodies to the camera of a stage that has none; z is up."""
_FIELD_OF_VIEW = math.radians(35.0)
_LAST = 1.0
"""Duration of the last frame before the page plays again [s]."""
_FAR_TRIANGLES, _FAR_RADII = 400_000, 20.0
"""Largest number of triangles of all distant copies of a mesh, and their least distance over the mesh's radius."""
_GRAY = (0.5, 0.5, 0.5)


@dataclass(frozen=True)
class _Surface:
    """Surface of a mesh: linear RGB, metalness and roughness."""

    color: tuple[float, ...] = _GRAY
    metallic: float = 0.0
    roughness: float = 0.6


@dataclass(frozen=True)
class _Batch:
    """Copies of one mesh over time; f is 1 for constant arrays."""

    points: np.ndarray  # of the mesh, shape [n, 3]
    faces: list[np.ndarray]  # corners of each face
    positions: np.ndarray  # of the copies, shape [f, k, 3]
    orientations: np.ndarray  # quaternions x y z w, shape [f, k, 4]
    scales: np.ndarray  # scale factors, shape [f, k]
    palette: list[_Surface]
    surfaces: np.ndarray  # index of each copy's surface in the palette, shape [f, k]


def page_of(stage: Usd.Stage, codes: np.ndarray, title: str) -> str:
    """Return the HTML of a stage's page, which needs neither a server nor a network.

    The stage is one of :class:`RendererStage`: meshes, PointInstancers of meshes and BasisCurves. The page shows the
    time codes, shape [f]. Raises :class:`InputError` if viser is missing, or has no free port to listen on.
    """
    try:
        import viser  # noqa: PLC0415 - an extra
    except ImportError as error:
        raise InputError(f"a web page needs {extra('viewers')}: {error}") from None
    batches = [*_instances(stage, codes), *_meshes(stage, codes)]
    curves = [prim for prim in stage.Traverse() if prim.IsA(UsdGeom.BasisCurves)]
    with contextlib.redirect_stdout(io.StringIO()):  # viser prints its address
        try:
            server = viser.ViserServer(host="127.0.0.1", verbose=False)
        except OSError as error:
            raise InputError(f"a web page needs a free port, on which viser listens ({error})") from None
        try:
            _put_camera(server, stage, batches, scale := _scale(batches))
            recording = server.get_scene_serializer()
            updates = [_add_batch(server.scene, f"/shape_{n}", batch, scale) for n, batch in enumerate(batches)]
            updates += [_add_curves(server.scene, prim, codes, scale) for prim in curves]
            for frame, wait in enumerate((np.diff(codes) / stage.GetTimeCodesPerSecond()).tolist(), start=1):
                recording.insert_sleep(wait)
                for update in updates:
                    update(frame)
            recording.insert_sleep(_LAST if len(codes) > 1 else 0.0)
            page = recording.as_html()
        finally:
            server.stop()
    return page.replace("<title>Viser</title>", f"<title>{html.escape(title)}</title>", 1)


def _instances(stage: Usd.Stage, codes: np.ndarray) -> Iterator[_Batch]:
    """Return the instances of PointInstancers, one batch per shape; colors may change over time."""
    for prim in stage.Traverse():
        if not prim.IsA(UsdGeom.PointInstancer):
            continue
        instancer = UsdGeom.PointInstancer(prim)
        meshes = [stage.GetPrimAtPath(path) for path in instancer.GetPrototypesRel().GetTargets()]
        shapes = [shape_of(mesh) for mesh in meshes]
        palette = [_surface_of(mesh) for mesh in meshes]
        groups: dict[bytes, int] = {}
        group = np.array([groups.setdefault(points.tobytes(), len(groups)) for points, _ in shapes])
        positions = _values(instancer.GetPositionsAttr(), codes, Vt.Vec3fArray)
        prototypes = _values(instancer.GetProtoIndicesAttr(), codes, Vt.IntArray)
        upright = np.tile((0.0, 0.0, 0.0, 1.0), (prototypes.shape[1], 1))
        orientations = _values(instancer.GetOrientationsAttr(), codes, Vt.QuathArray, upright)
        scales = _values(instancer.GetScalesAttr(), codes, Vt.Vec3fArray, np.ones_like(upright))[..., 0]
        for index in range(len(groups)):
            points, faces = shapes[int(np.argmax(group == index))]
            members = group[prototypes[0]] == index
            copies = positions[:, members], orientations[:, members], scales[:, members]
            yield _Batch(points, faces, *copies, palette, prototypes[:, members])


def _meshes(stage: Usd.Stage, codes: np.ndarray) -> Iterator[_Batch]:
    """Return the meshes that are not prototypes, one batch each."""
    transforms = [UsdGeom.XformCache(code) for code in codes.tolist()]
    prims = iter(Usd.PrimRange(stage.GetPseudoRoot()))
    for prim in prims:
        if prim.IsA(UsdGeom.PointInstancer):
            prims.PruneChildren()
        surface = shape_of(prim) if prim.IsA(UsdGeom.Mesh) else None
        if surface is None or UsdGeom.Imageable(prim).ComputeVisibility(codes[0]) == UsdGeom.Tokens.invisible:
            continue
        frames = np.array([cache.GetLocalToWorldTransform(prim) for cache in transforms])
        if (frames == frames[0]).all():
            frames = frames[:1]
        poses = [rigid_part(frame) for frame in frames]
        scaling = frames[0] @ np.linalg.inv(poses[0])
        points = np.c_[surface[0], np.ones(len(surface[0]))] @ scaling[:, :3]
        faces = [face[::-1] for face in surface[1]] if np.linalg.det(scaling) < 0.0 else surface[1]
        orientations = np.array([rotation_of(pose) for pose in poses])[:, None]
        positions, scale, index = frames[:, None, 3, :3], np.ones((1, 1)), np.zeros((1, 1), dtype=int)
        yield _Batch(points, faces, positions, orientations, scale, [_surface_of(prim)], index)


def _surface_of(prim: Usd.Prim) -> _Surface:
    """Return the surface of a mesh from its UsdPreviewSurface, or from its display color."""
    color, material = value_of(prim, "primvars:displayColor"), bound_material(prim)
    where = str(prim.GetPath())
    values: dict[str, Any] = {"color": vector(f"{where}: displayColor", color[0])} if color else {}
    for name, key in (("diffuseColor", "color"), ("metallic", "metallic"), ("roughness", "roughness")):
        value = surface_value(material, name)
        if value is not None:
            values[key] = (vector if key == "color" else number)(f"{where}: {name}", value)
    return _Surface(**values)


def _values(attribute: Usd.Attribute, codes: np.ndarray, array, default: np.ndarray | None = None) -> np.ndarray:
    """Return the values of an attribute, shape [f, ...], or [1, ...] if they are constant."""
    if not attribute.HasAuthoredValue() and default is not None:
        return default[None]
    many = codes.tolist() if attribute.ValueMightBeTimeVarying() else [codes[0]]
    return np.stack([np.array(array(attribute.Get(code))) for code in many])


def _box(batches: list[_Batch]) -> np.ndarray:
    """Return the bounding box of moving batches, or of all, at the first and the last frame, shape [2, 3]."""
    moving = [batch for batch in batches if len(batch.positions) > 1] or batches
    lows, highs = [], []
    for batch in moving:
        positions = batch.positions[[0, -1]].reshape(-1, 3)
        size = float(batch.scales.max()) * np.linalg.norm(batch.points, axis=1).max()
        lows.append(np.quantile(positions, _OUTSIDE, axis=0) - size)
        highs.append(np.quantile(positions, 1.0 - _OUTSIDE, axis=0) + size)
    return np.array([np.min(lows, axis=0), np.max(highs, axis=0)])


def _scale(batches: list[_Batch]) -> float:
    """Return the length of a unit of the stage in units of the page."""
    return 2.0 * _REACH / max(float(np.linalg.norm(np.ptp(_box(batches), axis=0))), 1e-30) if batches else 1.0


def _put_camera(server, stage: Usd.Stage, batches: list[_Batch], scale: float) -> None:
    """Aim the camera at the moving bodies, from the direction of the stage's camera."""
    up = 1 if UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.y else 2
    target = scale * _box(batches).mean(axis=0) if batches else np.zeros(3)
    cameras = [prim for prim in stage.Traverse() if prim.IsA(UsdGeom.Camera)]
    if cameras:
        with usd_errors(str(cameras[0].GetPath()), "USD cannot compose its transform"):
            frame = np.array(UsdGeom.XformCache(stage.GetStartTimeCode()).GetLocalToWorldTransform(cameras[0]))
        direction = frame[2, :3]
    else:
        direction = np.roll(_DIRECTION, up - 2)
    direction = direction / np.linalg.norm(direction)
    server.scene.set_up_direction("+y" if up == 1 else "+z")
    server.initial_camera.fov = _FIELD_OF_VIEW
    server.initial_camera.position = target + _REACH / math.sin(0.5 * _FIELD_OF_VIEW) * direction
    server.initial_camera.look_at = target


def _add_batch(scene, name: str, batch: _Batch, scale: float) -> Callable[[int], None]:
    """Add meshes at the first frame; return a function that shows them at a given frame."""
    points, normals, triangles = _corners(batch.points, batch.faces)
    surfaces = [batch.palette[surface] for surface in np.unique(batch.surfaces).tolist()]
    arrays = {"positions": batch.positions, "wxyzs": batch.orientations[..., [3, 0, 1, 2]], "scales": batch.scales}
    if len(surfaces) == 1:
        add = functools.partial(scene.add_batched_glb, name, glb(points, normals, triangles, **vars(surfaces[0])))
    else:  # a color per copy, without metalness
        colors = np.array([surface.color for surface in batch.palette]) ** (1.0 / 2.2)
        arrays["colors"] = np.rint(255.0 * colors[batch.surfaces]).astype(np.uint8)
        add = functools.partial(scene.add_batched_meshes_simple, name, points, triangles)
    arrays = {f"batched_{key}": value for key, value in arrays.items()}
    share = _FAR_TRIANGLES / (len(triangles) * batch.positions.shape[1])
    radius = scale * float(np.linalg.norm(points, axis=1).max()) * float(batch.scales[0].max())
    detail = "off" if share >= 1.0 else ((_FAR_RADII * radius, share),)
    solid = bool(np.ptp(points, axis=0).min() > 0.0)  # a flat ground would cast a shadow on itself
    handle = add(**{key: value[0] for key, value in arrays.items()}, scale=scale, lod=detail, cast_shadow=solid)
    moving = {key: value for key, value in arrays.items() if len(value) > 1}

    def show(frame: int) -> None:
        for key, value in moving.items():
            setattr(handle, key, value[frame])

    return show


def _corners(points: np.ndarray, faces: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return points, normals and triangles of a surface; points of sharp edges occur once per side."""
    corners = np.c_[points[np.concatenate(faces)], corner_normals(points, faces)].astype(np.float32)
    vertices, indices = np.unique(np.round(corners, 6), axis=0, return_inverse=True)
    separate = np.split(np.arange(len(corners)), np.cumsum([len(face) for face in faces])[:-1])
    triangles = triangles_of(points[np.concatenate(faces)], separate)
    return vertices[:, :3], vertices[:, 3:], indices.reshape(-1)[triangles].astype(np.uint32)


def _add_curves(scene, prim: Usd.Prim, codes: np.ndarray, scale: float) -> Callable[[int], None]:
    """Add polylines at the first frame; return a function that shows them at a given frame."""
    curves = UsdGeom.BasisCurves(prim)
    points = _values(curves.GetPointsAttr(), codes, Vt.Vec3fArray)
    counts = np.array(curves.GetCurveVertexCountsAttr().Get())
    begins = np.delete(np.arange(points.shape[1]), np.cumsum(counts) - 1)
    segments = np.stack([points[:, begins], points[:, begins + 1]], axis=2)
    color = np.rint(255.0 * np.array(_surface_of(prim).color) ** (1.0 / 2.2)).astype(np.uint8)
    width = scale * float(curves.GetWidthsAttr().Get()[0])
    handle = scene.add_line_segments(str(prim.GetPath()), segments[0], color, thickness=width, scale=scale)

    def show(frame: int) -> None:
        if len(segments) > 1:
            handle.points = segments[frame]

    return show
