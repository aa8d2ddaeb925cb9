"""Writes a run frame by frame, as a cache layer over an untouched scene.

``out.usda`` is a short root layer. Its sublayers are ``./out.cache.usdc`` with the motion, the prims that were created
for instances, if any, and the scene. The root repeats the metadata of the scene, because metadata of sublayers do not
compose. It has no prims: an opinion there would hide the samples of the cache.
"""

import contextlib
import hashlib
import os
import time as clock_time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import numpy.typing as npt
from pxr import Sdf, Usd, UsdGeom

from warpmag.errors import InputError
from warpmag.usd.paths import full_path, path_between
from warpmag.usd.read.ball_instancers import BallInstancer
from warpmag.usd.read.clock import stage_clock
from warpmag.usd.read.identical_balls import MOMENTS_PRIMVAR
from warpmag.usd.read.input_errors import usd_errors
from warpmag.usd.read.opening import copied_metadata
from warpmag.usd.read.recording import ORIENT, SCALE, TRANSLATE
from warpmag.usd.read.session import INSTANCES, added_layer, as_written, instances_around, unsaved_layers
from warpmag.usd.read.trial_read import mark_readable, trial_read
from warpmag.usd.read.units import units_of
from warpmag.usd.write import crate
from warpmag.usd.write.columns import BODY, CIRCUIT, MAGNET, Column
from warpmag.usd.write.instancer_frames import InstancerFrames
from warpmag.usd.write.output import Output
from warpmag.usd.write.placements import Placements
from warpmag.usd.write.samples import SampleFile
from warpmag.usd.write.scene_copy import copy_scene, file_with

_CHECKPOINT_SECONDS = 1.0
"""Least time between checkpoints [s]."""
_LATE = 0.1
"""Part of a frame by which the last frame of a stage may be later than a whole one, at which the stage ends."""
_CHECKPOINT_SHARE = 0.01
"""Largest share of the run time spent on checkpoints."""


@dataclass(frozen=True)
class PreviousRun:
    """An earlier run whose output is being continued."""

    time: float  # time of its last frame since the start of the stage [s]
    state: dict[str, np.ndarray] | None  # the saved state of the run; None if it was complete


class _Rows:
    """Rows of a run's ``bodies`` and ``magnets`` that have prims.

    ``of_instancers`` are the rows of each instancer's balls and of their magnets, -1 for balls without a magnet.
    """

    def __init__(self, body_paths: Sequence[str], magnet_paths: Sequence[str], instancers: Sequence[BallInstancer]):
        self.body_count, self.magnet_count = len(body_paths), len(magnet_paths)
        body_rows = {path: row for row, path in enumerate(body_paths)} if instancers else {}
        magnet_rows = {path: row for row, path in enumerate(magnet_paths)} if instancers else {}
        self.of_instancers = [
            (
                np.array([body_rows[path] for path in instancer.bodies], int),
                np.array([magnet_rows.get(path, -1) for path in instancer.magnets], int),
            )
            for instancer in instancers
        ]
        bodies, magnets = np.ones(self.body_count, bool), np.ones(self.magnet_count, bool)
        for balls, ball_magnets in self.of_instancers:
            bodies[balls], magnets[ball_magnets[ball_magnets >= 0]] = False, False
        self.bodies, self.magnets = np.flatnonzero(bodies), np.flatnonzero(magnets)


class CacheWriter:
    """Writes the frames of a run as they are computed.

    The stage can be opened from the first frame on, and is valid whatever ends the process. As a context manager the
    writer always closes its files. Without any frame nothing is written.
    """

    def __init__(
        self,
        stage: Usd.Stage,
        path: str | os.PathLike,
        body_paths: Sequence[str],
        magnet_paths: Sequence[str],
        *,
        coil_paths: Sequence[str] = (),
        instancers: Sequence[BallInstancer] = (),
        copy_scene: bool = False,
        frames: int | None = None,
        options: dict[str, str] | None = None,
    ):
        """Prepare for a run; nothing is written yet.

        Args:
            stage: The scene, as :func:`warpmag.usd.open_stage` opened it.
            path: File of the root layer, ``.usd``, ``.usda`` or ``.usdc``.
            body_paths: Paths of the rigid bodies, in the order of the frames' rows.
            magnet_paths: Paths of the magnets, in the order of the frames' moments.
            coil_paths: Paths of the coils with a resistance, in the order of the frames' currents.
            instancers: Instancers that contain some of the bodies and stay instancers.
            copy_scene: Copy the scene beside the root layer instead of referring to it, as for a bundled scene. A scene
                without a file or with unsaved edits is always copied.
            frames: Expected number of frames; without it the file may become longer than necessary.
            options: Options that a resumed run must share with this one, besides the scene.

        Raises:
            InputError: The path has another suffix, cannot be written or would overwrite a layer of the scene.
        """
        self._stage, self._units = stage, units_of(stage)
        self._clock = stage_clock(stage)
        self._copy_scene = copy_scene or stage.GetRootLayer().anonymous or bool(unsaved_layers(stage))
        scene = {Path(layer.realPath).resolve() for layer in stage.GetUsedLayers() if layer.realPath}
        self._output = Output(path, scene, copy_scene=self._copy_scene)
        self._rows = _Rows(body_paths, magnet_paths, instancers)
        self._bodies = Placements(stage, [body_paths[row] for row in self._rows.bodies.tolist()], self._units.meters)
        magnets_with_prims = [magnet_paths[row] for row in self._rows.magnets.tolist()]
        self._instancer_paths = [instancer.path for instancer in instancers]
        self._instancers = [InstancerFrames(instancer) for instancer in instancers]
        self._columns = [Column(kind, self._bodies.paths) for kind in BODY] + [Column(MAGNET, magnets_with_prims)]
        self._columns.append(Column(CIRCUIT, coil_paths))
        self._columns += [column for instancer in self._instancers for column in instancer.columns]
        self._frames, self._options = frames, options or {}
        self._samples: SampleFile | None = None
        self._first: list[np.ndarray] = []
        self._last: list[np.ndarray] | None = None
        self._last_time = -np.inf
        self._sublayers: list[str] = []
        self._save_time = 0.0

    def __enter__(self) -> "CacheWriter":
        """Return the writer itself."""
        return self

    def __exit__(self, kind, *exception) -> None:
        """Close the files."""
        self.close(complete=kind is None)

    def resume(self) -> PreviousRun | None:
        """Continue the run at the output, before the first frame; return it, None if there is none.

        A complete run stays unchanged. An output of another run, or of a running process, raises :class:`InputError`.
        """
        if not (self._output.root.exists() or self._output.checkpoint.exists()):
            return None
        self._output.lock()
        try:
            checkpoint = self._output.load_checkpoint()
            return self._completed() if checkpoint is None else self._continue(*checkpoint)
        except BaseException:
            self._output.close()
            raise

    def _continue(self, run: dict[str, str], arrays: dict[str, np.ndarray]) -> PreviousRun:
        """Continue from a checkpoint."""
        self._check_same_run(run)
        output = self._output
        places = {name[5:]: array for name, array in arrays.items() if name.startswith("file/")}
        state = {name[6:]: array for name, array in arrays.items() if name.startswith("state/")}
        with output.errors(output.cache):
            self._samples = SampleFile.resume(output.cache, self._value_sizes(), places)
        self._first = self._unpack(self._samples.frame(0))
        self._last = self._unpack(self._samples.frame(self._samples.count - 1))
        self._last_time = float(run["time"])
        return PreviousRun(self._last_time, state)

    def _drop_later_frames(self, samples: SampleFile) -> None:
        """Bring the files of a resumed run back to its checkpoint. A run that is refused does not come here."""
        with self._output.errors(self._output.cache):
            samples.drop_later_frames()
        self._open_cache("cannot be resumed, it has changed since the run wrote it")  # perhaps damage to the disk
        for target in (*self._write_scene_and_root(), self._output.root):
            self._output.place(target)

    def _open_cache(self, message: str) -> Sdf.Layer:
        """Open the cache of an earlier run; raise :class:`InputError` with ``message`` if USD cannot read it."""
        cache = str(self._output.cache)
        if reason := trial_read(cache):
            raise InputError(f"{cache}: {message} ({reason})")
        with usd_errors(cache, message):
            return Sdf.Layer.OpenAsAnonymous(cache)

    def _completed(self) -> PreviousRun:
        """Return a complete run, which has no checkpoint."""
        cache = self._open_cache("cannot be resumed") if self._output.cache.exists() else None
        run = cache.customLayerData.get("warpmag") if cache else None
        if run is None:
            raise InputError(f"{self._output.root}: nothing to resume, no run of this version has written it")
        self._check_same_run(run)
        return PreviousRun((cache.endTimeCode - self._clock.start) / self._clock.time_codes_per_second, None)

    def _check_same_run(self, run: dict[str, str]) -> None:
        """Raise :class:`InputError` where the previous run had another scene or other options."""
        for name, value in self._identity.items():
            if run.get(name) != value:
                change = "" if name == "scene" else f": {run.get(name, 'unknown')}, now {value}"
                raise InputError(f"{self._output.root}: cannot resume, it was run with another {name}{change}")

    @cached_property
    def _identity(self) -> dict[str, str]:
        """Digest of the scene and the options: equal for runs that may continue each other."""
        return {"scene": _digest(self._stage), **self._options}

    def add_frame(
        self,
        time: float,
        body_q: np.ndarray,
        body_qd: np.ndarray,
        moments: np.ndarray,
        currents: npt.ArrayLike = (),
    ) -> None:
        """Write one frame; if that fails, the stage keeps the earlier frames.

        Args:
            time: Time since the start of the stage [s]; must increase from frame to frame.
            body_q: Body frames in the world (position [m], quaternion x y z w), shape [n, 7].
            body_qd: Linear velocity of the center of mass [m/s] and angular velocity [rad/s], world, shape [n, 6].
            moments: Moments of the magnets [A·m²], world frame, shape [m, 3].
            currents: Currents of the coils with a resistance [A], shape [c].
        """
        if not time > self._last_time:
            raise ValueError(f"time must increase from frame to frame: {time} after {self._last_time}")
        rows, last = self._rows, self._last
        body_q = np.asarray(body_q, dtype=np.float32).reshape(rows.body_count, 7)
        body_qd = np.asarray(body_qd, dtype=np.float32).reshape(rows.body_count, 6)
        moments = np.asarray(moments, dtype=np.float32).reshape(rows.magnet_count, 3)
        placed = self._bodies.place(body_q[rows.bodies], body_qd[rows.bodies], last and last[1])
        values = [placed.positions, placed.rotations, placed.linear, placed.angular, moments[rows.magnets]]
        values.append(np.asarray(currents, dtype=np.float64).reshape(-1, 1))
        for instancer, (balls, magnets) in zip(self._instancers, rows.of_instancers, strict=True):
            ball_moments = moments[magnets] if len(moments) else np.zeros((len(magnets), 3), np.float32)
            ball_moments[magnets < 0] = 0.0
            last_rotations = last and last[len(values) + 1]
            values += instancer.values(body_q[balls], body_qd[balls], ball_moments, last_rotations)
        if self._samples is None:
            self._samples = self._begin(time, values)
        else:
            if self._samples.resumed:
                self._drop_later_frames(self._samples)
            self._append(self._samples, time, values)

    @property
    def save_due(self) -> bool:
        """True about once a second, when :meth:`save` should be called after the next frame."""
        return clock_time.monotonic() >= self._save_time

    def save(self, state: dict[str, np.ndarray] | None) -> None:
        """Write the root layer, and a checkpoint with the ``state`` after the last frame unless it is None."""
        assert self._samples is not None
        began = clock_time.monotonic()
        self._place_root()
        if state is not None:
            run = {**self._identity, "time": repr(self._last_time)}
            arrays = {f"file/{name}": array for name, array in self._samples.places().items()}
            arrays |= {f"state/{name}": array for name, array in state.items()}
            with self._output.errors(self._output.checkpoint):
                self._output.save_checkpoint(run, arrays)
        spent = clock_time.monotonic() - began
        self._save_time = began + max(_CHECKPOINT_SECONDS, spent / _CHECKPOINT_SHARE)

    def close(self, complete: bool = True) -> None:
        """Close the files, and remove the checkpoint of a complete run; a second call does nothing."""
        samples, self._samples = self._samples, None
        output = self._output
        try:
            if samples is None:
                return
            if samples.resumed and not complete:
                samples.close()
                return
            if samples.resumed:
                self._drop_later_frames(samples)
            # the error that ended an incomplete run is the one to report
            with contextlib.nullcontext() if complete else contextlib.suppress(InputError):
                with output.errors(output.cache):
                    samples.close()
                self._place_root()
            if complete:
                output.checkpoint.unlink(missing_ok=True)
        finally:
            output.close()
        for path in (output.beside(".scene.usdc"), output.instances, output.cache, output.root):
            if layer := Sdf.Layer.Find(str(path)):  # an earlier result that this process has open
                layer.Reload(force=True)
        scene = [layer.realPath for layer in self._stage.GetUsedLayers() if layer.realPath]
        mark_readable(full_path(output.root), [*output.files(), *scene])  # the scene has been tried

    # ---------------------------------------------------------------------------------------------------------------

    def _begin(self, time: float, values: list[np.ndarray]) -> SampleFile:
        """Write the files with the first frame; an earlier result stays until all of them are complete."""
        output = self._output
        output.lock()
        with output.errors(output.cache):
            layer, path = self._cache_layer().encode(), output.temporary(output.cache)
            samples = SampleFile.begin(path, layer, self._value_sizes(), self._frames)
        try:
            self._first = values
            self._append(samples, time, values)
            written = self._write_scene_and_root()
            with output.errors(output.root):
                output.checkpoint.unlink(missing_ok=True)
                for target in (*written, output.cache, output.root):
                    output.place(target)
        except BaseException:
            with contextlib.suppress(OSError):
                samples.close()
            raise
        return samples

    def _append(self, samples: SampleFile, time: float, values: list[np.ndarray]) -> None:
        changed = np.zeros(0, dtype=int)
        if not samples.sampled.all():
            differs = [(value != first).any(axis=1) for value, first in zip(values, self._first, strict=True)]
            changed = np.flatnonzero(np.concatenate(differs) & ~samples.sampled)
        data = b"".join(column.pack(value) for column, value in zip(self._columns, values, strict=True))
        with self._output.errors(self._output.cache):
            samples.append(self._code(time), data, changed)
        self._last_time, self._last = float(time), values

    def _write_scene_and_root(self) -> list[Path]:
        """Write the root and the layers below it to temporary files; return the targets to place before the root."""
        output, written = self._output, []
        self._sublayers = []
        if instances := self._instances_layer():
            written.append(output.instances)
            with output.errors(output.instances):
                output.write(instances, output.instances)
            self._sublayers.append(f"./{output.instances.name}")
        if self._copy_scene:
            with output.errors(output.beside(".scene")):
                target, scene = copy_scene(self._stage, output)
            written.append(target)
            self._sublayers.append(f"./{scene.relative_to(output.root.parent)}")
        else:
            self._sublayers.append(path_between(output.root, Path(self._stage.GetRootLayer().realPath)))
        with output.errors(output.root):
            output.write(self._root_layer(), output.root)
        return written

    def _place_root(self) -> None:
        with self._output.errors(self._output.root):
            self._output.write(self._root_layer(), self._output.root)
            self._output.place(self._output.root)

    # ---------------------------------------------------------------------------------------------------------------

    def _code(self, time: float) -> float:
        return self._clock.start + time * self._clock.time_codes_per_second

    def _value_sizes(self) -> np.ndarray:
        """Return the size of each value of a frame [bytes]."""
        return np.concatenate([column.sizes for column in self._columns])

    def _unpack(self, data: bytes) -> list[np.ndarray]:
        """Return the values of a frame, one array for each column."""
        values, start = [], 0
        for column in self._columns:
            values.append(column.unpack(data, start))
            start += int(column.sizes.sum())
        return values

    def _metadata(self, end: float) -> dict[str, float | str]:
        """Return units, axis and times of the scene, which the cache and the root repeat."""
        return {
            "metersPerUnit": self._units.meters,
            "kilogramsPerUnit": self._units.kilograms,
            "upAxis": str(UsdGeom.GetStageUpAxis(self._stage)),
            "timeCodesPerSecond": self._clock.time_codes_per_second,  # equal in all layers: USD rescales otherwise
            "framesPerSecond": self._clock.frames_per_second,
            "startTimeCode": self._clock.start,
            "endTimeCode": end,
        }

    def _root_layer(self) -> Sdf.Layer:
        scene = self._stage.GetRootLayer()
        root = Sdf.Layer.CreateAnonymous()
        for key in copied_metadata(scene):
            root.pseudoRoot.SetInfo(key, scene.pseudoRoot.GetInfo(key))
        for key, value in self._metadata(self._end_code()).items():
            root.pseudoRoot.SetInfo(key, value)
        root.subLayerPaths[:] = [f"./{self._output.cache.name}", *self._sublayers]
        return root

    def _end_code(self) -> float:
        """Return the last time code of the stage: players stop at whole frames, and the last frame must be shown.

        The last frame is at the nearest step, a little before or after a whole frame unless steps are long.
        """
        rate = self._clock.frames_per_second
        whole = round(self._last_time * rate)
        return self._code(self._last_time if self._last_time * rate - whole > _LATE else whole / rate)

    def _instances_layer(self) -> Sdf.Layer | None:
        """Return the layer with the prims of instances, None if there is none.

        Instancers that stay instancers get no prims in it, only the primvar of their moments.
        """
        instances = added_layer(self._stage, INSTANCES)
        if instances is None or not self._instancer_paths:
            return instances
        layer = Sdf.Layer.CreateAnonymous()
        layer.TransferContent(instances)
        for path in self._instancer_paths:
            spec = layer.GetPrimAtPath(path)
            del (spec.nameParent or layer.pseudoRoot).nameChildren[spec.name]
            prim = Sdf.CreatePrimInLayer(layer, path)
            moments = Sdf.AttributeSpec(prim, MOMENTS_PRIMVAR, Sdf.ValueTypeNames.Vector3fArray)
            moments.SetInfo("interpolation", UsdGeom.Tokens.vertex)
        return layer

    def _cache_layer(self) -> crate.OverLayer:
        """Return the cache without its frames."""
        cache, bodies = crate.OverLayer(self._value_sizes()), self._bodies
        for name, value in self._metadata(self._clock.start).items():
            cache.set_metadata(name, value)
        cache.set_metadata("customLayerData", {"warpmag": self._identity})
        for column in self._columns:
            cache.add_sampled(column.paths, column.kind.name, column.kind.type_name, column.kind.kind)
        scaled = ~np.isclose(bodies.scales, 1.0, rtol=0.0, atol=1e-6).all(axis=1)
        orders: dict[tuple[str, ...], list[str]] = {}
        for path, scale, resets, has_scale in zip(bodies.paths, bodies.scales, bodies.resets, scaled, strict=True):
            if has_scale:
                cache.add_vector(path, SCALE, scale)
            order = (*["!resetXformStack!"] * bool(resets), TRANSLATE, ORIENT, *[SCALE] * bool(has_scale))
            orders.setdefault(order, []).append(path)
        for order, paths in orders.items():
            cache.add_tokens(paths, "xformOpOrder", order)
        stage = as_written(self._stage)
        parents = {path.rpartition("/")[0] for column in self._columns for path in column.paths}
        for prim in instances_around(stage.GetPrimAtPath(path or "/") for path in parents):
            cache.make_editable(str(prim.GetPath()))  # USD ignores opinions inside an instance
        return cache


def _digest(stage: Usd.Stage) -> str:
    """Return a digest of the content of a stage's layers, unsaved edits included, independent of their paths."""
    layers = [layer for layer in stage.GetUsedLayers() if layer.realPath or layer == stage.GetRootLayer()]
    in_memory = [layer for layer in layers if layer.dirty or not layer.realPath]
    digests = [hashlib.sha256(layer.ExportToString().encode()).hexdigest() for layer in in_memory]
    for path in {file_with(layer.realPath) for layer in layers if layer not in in_memory}:
        with open(path, "rb") as file:
            digests.append(hashlib.file_digest(file, "sha256").hexdigest())
    return hashlib.sha256("".join(sorted(digests)).encode()).hexdigest()
