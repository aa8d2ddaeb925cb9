"""Writes a run as a cache layer over an untouched scene.

``out.usda`` is a thin root whose sublayers are ``./out.cache.usdc``, which holds the motion, and the scene. The root
repeats the metadata of the scene, since that does not compose, and has no prims: an opinion there would hide the
samples of the cache.
"""

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom, UsdPhysics, Vt

from warpmag.errors import InputError
from warpmag.usd.clock import stage_clock
from warpmag.usd.schemas import MOMENT
from warpmag.usd.transforms import is_animated

_SUFFIXES = (".usd", ".usda", ".usdc")
_COMPOSED = ("subLayers", "subLayerOffsets", "layerRelocates")  # metadata that sublayers do hand up
_TRANSLATE, _ORIENT, _SCALE = (f"xformOp:{kind}:warpmag" for kind in ("translate", "orient", "scale"))
_TYPES = Sdf.ValueTypeNames


class CacheWriter:
    """Collects the frames of a run and writes them when closed.

    Used as a context manager it closes in any case, so that an interrupted run leaves a valid stage with the frames
    done so far. Without a single frame nothing is written.
    """

    def __init__(
        self,
        stage: Usd.Stage,
        path: str | os.PathLike,
        body_paths: Sequence[str],
        magnet_paths: Sequence[str],
        *,
        copy_scene: bool = False,
    ):
        """Prepare for a run.

        Args:
            stage: The scene, as :func:`warpmag.usd.open_stage` opened it.
            path: File of the root layer, ``.usd``, ``.usda`` or ``.usdc``.
            body_paths: Prims of the rigid bodies, in the order of the frames' rows.
            magnet_paths: Prims of the magnets, in the order of the frames' moments.
            copy_scene: Copy the scene beside the root, as is right for a bundled one, instead of pointing to it. A
                scene that is no file is always copied.

        Raises:
            InputError: The path has another suffix, cannot be written or would overwrite a layer of the scene.
        """
        self._path = Path(path)
        self._stage = stage
        self._clock = stage_clock(stage)
        self._copy_scene = copy_scene or stage.GetRootLayer().anonymous
        self._cache_path = self._path.with_name(f"{self._path.stem}.cache.usdc")
        self._scene_path = self._path.with_name(f"{self._path.stem}.scene.usdc")
        self._check_output()
        self._magnet_paths = list(magnet_paths)
        self._frames = _Placements(stage, body_paths)
        self._times: list[float] = []
        self._body_q: list[np.ndarray] = []
        self._body_qd: list[np.ndarray] = []
        self._moments: list[np.ndarray] = []
        self._closed = False

    def __enter__(self) -> "CacheWriter":
        """Return the writer itself."""
        return self

    def __exit__(self, *exception) -> None:
        """Write the frames so far, whatever ended the run."""
        self.close()

    def add_frame(self, time: float, body_q: np.ndarray, body_qd: np.ndarray, moments: np.ndarray) -> None:
        """Keep one frame.

        Args:
            time: Time since the start of the stage [s]; rises from frame to frame.
            body_q: Body frames in the world (position [m], quaternion x y z w), shape [n, 7].
            body_qd: Linear velocity of the centre of mass [m/s] and angular velocity [rad/s], world, shape [n, 6].
            moments: Moments of the magnets [A·m²], world frame, shape [m, 3].
        """
        if self._times and not time > self._times[-1]:
            raise ValueError(f"time must rise from frame to frame: {time} after {self._times[-1]}")
        self._times.append(float(time))
        count = len(self._frames.paths)
        self._body_q.append(np.array(body_q, dtype=np.float32).reshape(count, 7))
        self._body_qd.append(np.array(body_qd, dtype=np.float32).reshape(count, 6))
        self._moments.append(np.array(moments, dtype=np.float32).reshape(len(self._magnet_paths), 3))

    def close(self) -> None:
        """Write the stage, all of its files or none; a second call does nothing."""
        if self._closed or not self._times:
            return
        self._closed = True
        layers = {self._cache_path: self._cache_layer(), self._path: self._root_layer()}
        if self._copy_scene:
            layers = {self._scene_path: self._stage.GetRootLayer(), **layers}
        _write_all(layers)

    def _check_output(self) -> None:
        if self._path.suffix not in _SUFFIXES:
            raise InputError(f"{self._path}: the output must end in {', '.join(_SUFFIXES)}")
        targets = {self._path, self._cache_path, *([self._scene_path] if self._copy_scene else [])}
        used = {Path(layer.realPath).resolve() for layer in self._stage.GetUsedLayers() if layer.realPath}
        for target in sorted(targets):
            if target.resolve() in used:
                raise InputError(f"{self._path}: would overwrite {target}, which belongs to the scene")
            if target.is_dir():
                raise InputError(f"{self._path}: {target} is a directory")
        folder = self._path.absolute().parent
        while not folder.exists():
            folder = folder.parent
        if not (folder.is_dir() and os.access(folder, os.W_OK)):
            raise InputError(f"{self._path}: cannot write to {folder}")

    def _time_codes(self) -> list[float]:
        return [self._clock.start + time * self._clock.time_codes_per_second for time in self._times]

    def _set_metadata(self, layer) -> None:
        """Repeat on ``layer`` what says how the numbers of the scene are meant."""
        layer.pseudoRoot.SetInfo("metersPerUnit", UsdGeom.GetStageMetersPerUnit(self._stage))
        layer.pseudoRoot.SetInfo("kilogramsPerUnit", UsdPhysics.GetStageKilogramsPerUnit(self._stage))
        layer.pseudoRoot.SetInfo("upAxis", UsdGeom.GetStageUpAxis(self._stage))
        layer.timeCodesPerSecond = self._clock.time_codes_per_second  # equal in all layers: USD rescales otherwise
        layer.framesPerSecond = self._clock.frames_per_second
        layer.startTimeCode = self._clock.start
        layer.endTimeCode = self._time_codes()[-1]

    def _root_layer(self) -> Sdf.Layer:
        scene = self._stage.GetRootLayer()
        root = Sdf.Layer.CreateAnonymous()
        for key in scene.pseudoRoot.ListInfoKeys():
            if key not in _COMPOSED:
                root.pseudoRoot.SetInfo(key, scene.pseudoRoot.GetInfo(key))
        self._set_metadata(root)
        below = f"./{self._scene_path.name}"
        if not self._copy_scene:
            below = os.path.relpath(Path(scene.realPath).resolve(), self._path.parent.resolve())
            below = below if below.startswith("..") else f"./{below}"
        root.subLayerPaths[:] = [f"./{self._cache_path.name}", below]
        return root

    def _cache_layer(self) -> Sdf.Layer:
        cache = Sdf.Layer.CreateAnonymous()
        self._set_metadata(cache)
        codes = self._time_codes()
        body_q, body_qd = np.stack(self._body_q, axis=1), np.stack(self._body_qd, axis=1)  # [n, frames, ...]
        moments = np.stack(self._moments, axis=1)
        with Sdf.ChangeBlock():
            for index in range(len(self._frames.paths)):
                self._frames.author(cache, index, codes, body_q[index], body_qd[index])
            for path, values in zip(self._magnet_paths, moments, strict=True):
                _over(cache, self._stage, path)
                _author(cache, path, MOMENT, _TYPES.Vector3f, codes, values, Vt.Vec3fArray)
        return cache


class _Placements:
    """Turns body frames in the world into transforms local to the parents of the prims."""

    def __init__(self, stage, paths):
        self.paths = list(paths)
        self._stage = stage
        self._transforms = UsdGeom.XformCache(Usd.TimeCode.Default())
        moving = set(self.paths)
        self._parents, self._scales = [], []
        for path in self.paths:
            prim = stage.GetPrimAtPath(path)
            world = np.array(self._transforms.GetLocalToWorldTransform(prim))
            scale = np.diag(world[:3, :3] @ _rigid(world)[:3, :3].T)
            parent = self._parent(prim, moving)
            self._parents.append(parent)
            self._scales.append(scale if parent is None else scale / _scale(parent))

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
        similar = np.allclose(matrix[:3, :3], scale * _rigid(matrix)[:3, :3], rtol=0.0, atol=1e-6 * abs(scale))
        return matrix if similar else None

    def author(self, layer, index, codes, body_q, body_qd) -> None:
        """Author the motion of one body, ``body_q`` [frames, 7] and ``body_qd`` [frames, 6]."""
        path, parent, scale = self.paths[index], self._parents[index], self._scales[index]
        positions = body_q[:, :3].astype(np.float64)
        turns = body_q[:, 3:].astype(np.float64)
        turns /= np.linalg.norm(turns, axis=1, keepdims=True)
        in_body = turns * (-1.0, -1.0, -1.0, 1.0)
        linear = _rotate(in_body, body_qd[:, :3])
        angular = _rotate(in_body, np.degrees(body_qd[:, 3:].astype(np.float64)))
        if parent is not None and not np.array_equal(parent, np.eye(4)):
            positions = (np.c_[positions, np.ones(len(positions))] @ np.linalg.inv(parent))[:, :3]
            turns = _product(_conjugate_rotation(parent), turns)
        turns *= np.where(np.cumsum(np.r_[0, np.sum(turns[1:] * turns[:-1], axis=1) < 0.0]) % 2, -1.0, 1.0)[:, None]

        _over(layer, self._stage, path)
        _author(layer, path, _TRANSLATE, _TYPES.Double3, codes, positions, Vt.Vec3dArray)
        _author(layer, path, _ORIENT, _TYPES.Quatf, codes, turns.astype(np.float32), Vt.QuatfArray)
        order = [_TRANSLATE, _ORIENT]
        if not np.allclose(scale, 1.0, rtol=0.0, atol=1e-6):
            _author_default(layer, path, _SCALE, _TYPES.Double3, Gf.Vec3d(*scale.tolist()))
            order.append(_SCALE)
        if parent is None:
            order.insert(0, "!resetXformStack!")
        _author_default(layer, path, "xformOpOrder", _TYPES.TokenArray, Vt.TokenArray(order), Sdf.VariabilityUniform)
        _author(layer, path, "physics:velocity", _TYPES.Vector3f, codes, linear.astype(np.float32), Vt.Vec3fArray)
        _author(
            layer, path, "physics:angularVelocity", _TYPES.Vector3f, codes, angular.astype(np.float32), Vt.Vec3fArray
        )


def _write_all(layers: dict[Path, Sdf.Layer]) -> None:
    """Write the layers beside their places first, then move them there, the last one last."""
    temporary = {path: path.with_name(f".{path.stem}.{os.getpid()}.tmp{path.suffix}") for path in layers}
    try:
        for path, layer in layers.items():
            path.parent.mkdir(parents=True, exist_ok=True)
            arguments = {"format": "usda"} if path.suffix == ".usd" else {}  # a thin root is for people to read
            if not layer.Export(str(temporary[path]), args=arguments):
                raise InputError(f"{path}: cannot be written")
        for path in layers:
            os.replace(temporary[path], path)
    except OSError as error:
        raise InputError(f"{error.filename}: cannot be written ({error.strerror})") from None
    finally:
        for path in temporary.values():
            path.unlink(missing_ok=True)
    for path in layers:
        if known := Sdf.Layer.Find(str(path)):  # an earlier run's result that this process has open
            known.Reload(force=True)


def _over(layer, stage, path) -> None:
    """Make room for opinions on ``path``, which inside an instance have no effect until that is made editable."""
    Sdf.CreatePrimInLayer(layer, path)
    prim = stage.GetPrimAtPath(path)
    while prim.IsInstanceProxy():
        prim = prim.GetParent()
        if prim.IsInstance():
            Sdf.CreatePrimInLayer(layer, prim.GetPath()).instanceable = False


def _author(layer, path, name, kind, codes, values, array) -> None:
    """Author ``values`` [frames, ...] as time samples, or as one default value if they are all the same.

    The samples come with a default, the first of them, for readers that do not ask for a time.
    """
    samples = array.FromNumpy(np.ascontiguousarray(values))
    place = _author_default(layer, path, name, kind, samples[0])
    if (values != values[0]).any():
        for code, sample in zip(codes, samples, strict=True):
            layer.SetTimeSample(place, code, sample)


def _author_default(layer, path, name, kind, value, variability=Sdf.VariabilityVarying) -> Sdf.Path:
    place = Sdf.Path(f"{path}.{name}")  # made once: parsing it for every sample would take half of the time
    Sdf.JustCreatePrimAttributeInLayer(layer, place, kind, variability, False)
    layer.GetAttributeAtPath(place).default = value
    return place


def _scale(matrix) -> float:
    """Return the mean scale of a transform, the cube root of its determinant."""
    return float(np.cbrt(np.linalg.det(matrix[:3, :3])))


def _rigid(matrix) -> np.ndarray:
    """Return position and rotation of a transform, as USD's physics and Newton take them: the body's frame."""
    transform = Gf.Transform(Gf.Matrix4d(matrix.tolist()))
    rigid = Gf.Matrix4d().SetRotate(transform.GetRotation())
    rigid.SetTranslateOnly(transform.GetTranslation())
    return np.array(rigid)


def _conjugate_rotation(matrix) -> np.ndarray:
    turn = Gf.Transform(Gf.Matrix4d(matrix.tolist())).GetRotation().GetQuat()
    return np.array([*(-turn.GetImaginary()), turn.GetReal()])


def _product(a, b) -> np.ndarray:
    """Return the product of quaternions x y z w: first ``b``, then ``a``."""
    va, vb, wa, wb = a[..., :3], b[..., :3], a[..., 3:], b[..., 3:]
    vector = wa * vb + wb * va + np.cross(va, vb)
    return np.concatenate([vector, wa * wb - np.sum(va * vb, axis=-1, keepdims=True)], axis=-1)


def _rotate(turns, vectors) -> np.ndarray:
    """Rotate ``vectors`` [n, 3] by quaternions ``turns`` [n, 4]."""
    axis, w = turns[:, :3], turns[:, 3:]
    across = 2.0 * np.cross(axis, vectors)
    return vectors + w * across + np.cross(axis, across)
