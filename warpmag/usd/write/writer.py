"""Writes a run as a cache layer over an untouched scene, frame by frame.

``out.usda`` is a thin root whose sublayers are ``./out.cache.usdc``, which holds the motion, and the scene; between
them stand the prims that were made of instances, if there are any. The root repeats the metadata of the scene, since
that does not compose, and has no prims: an opinion there would hide the samples of the cache. ``crate.py`` writes the
cache, ``samples.py`` lets it grow, ``output.py`` has the files.
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
from pxr import Sdf, Usd, UsdGeom

from warpmag.errors import InputError
from warpmag.usd.paths import path_between
from warpmag.usd.read.alike import MOMENTS
from warpmag.usd.read.clock import stage_clock
from warpmag.usd.read.guard import readable
from warpmag.usd.read.reader import copied_metadata
from warpmag.usd.read.session import INSTANCES, added_layer, as_written, instances_around, unsaved_layers
from warpmag.usd.read.swarms import Swarm
from warpmag.usd.read.units import units_of
from warpmag.usd.write import crate
from warpmag.usd.write.columns import BODY, MAGNET, ORIENT, SCALE, TRANSLATE, Column
from warpmag.usd.write.output import Output
from warpmag.usd.write.placements import Placements
from warpmag.usd.write.samples import SampleFile
from warpmag.usd.write.scene_copy import copy_scene, file_with

_CHECKPOINT_SECONDS = 1.0
_CHECKPOINT_SHARE = 0.01
"""Checkpoints come so often, and take at most this part of the time."""


@dataclass(frozen=True)
class Earlier:
    """A run that was found at the output.

    Attributes:
        time: Time of its last frame since the start of the stage [s].
        state: What the run had saved by then; None if it was complete.
    """

    time: float
    state: dict[str, np.ndarray] | None


class _Rows:
    """Which rows of what a run hands over go where.

    Attributes:
        bodies: Rows of the bodies that have prims.
        magnets: Rows of the magnets that have prims.
        of_swarms: Instancers, the rows of their balls, and those of the magnets that these are, -1 where they are none.
    """

    def __init__(self, body_paths: Sequence[str], magnet_paths: Sequence[str], swarms: Sequence[Swarm]):
        self.body_count, self.magnet_count = len(body_paths), len(magnet_paths)
        of_body = {path: row for row, path in enumerate(body_paths)} if swarms else {}
        of_magnet = {path: row for row, path in enumerate(magnet_paths)} if swarms else {}
        self.of_swarms = [
            (
                one,
                np.array([of_body[path] for path in one.bodies], int),
                np.array([of_magnet.get(path, -1) for path in one.magnets], int),
            )
            for one in swarms
        ]
        bodies, magnets = np.ones(self.body_count, bool), np.ones(self.magnet_count, bool)
        for _, own, held in self.of_swarms:
            bodies[own], magnets[held[held >= 0]] = False, False
        self.bodies, self.magnets = np.flatnonzero(bodies), np.flatnonzero(magnets)


class CacheWriter:
    """Writes the frames of a run as they come.

    The stage can be opened from the first frame on, and has all frames whatever ends the process. Used as a context
    manager it closes in any case. Without a single frame nothing is written.
    """

    def __init__(
        self,
        stage: Usd.Stage,
        path: str | os.PathLike,
        body_paths: Sequence[str],
        magnet_paths: Sequence[str],
        *,
        swarms: Sequence[Swarm] = (),
        copy_scene: bool = False,
        frames: int | None = None,
        options: dict[str, str] | None = None,
    ):
        """Prepare for a run.

        Args:
            stage: The scene, as :func:`warpmag.usd.open_stage` opened it.
            path: File of the root layer, ``.usd``, ``.usda`` or ``.usdc``.
            body_paths: Prims of the rigid bodies, in the order of the frames' rows.
            magnet_paths: Prims of the magnets, in the order of the frames' moments.
            swarms: Instancers that hold some of the bodies and stay instancers.
            copy_scene: Copy the scene beside the root, as is right for a bundled one, instead of pointing to it. A
                scene that is no file, or has edits that are not saved, is always copied.
            frames: Frames that are expected; without it the file may become longer than it has to be.
            options: What a run that goes on from this one must have in common with it, besides the scene.

        Raises:
            InputError: The path has another suffix, cannot be written or would overwrite a layer of the scene.
        """
        self._stage, self._units = stage, units_of(stage)
        self._clock = stage_clock(stage)
        self._copy_scene = copy_scene or stage.GetRootLayer().anonymous or bool(unsaved_layers(stage))
        scene = {Path(layer.realPath).resolve() for layer in stage.GetUsedLayers() if layer.realPath}
        self._output = Output(path, scene, copy_scene=self._copy_scene)
        self._rows = _Rows(body_paths, magnet_paths, swarms)
        self._bodies = Placements(stage, [body_paths[row] for row in self._rows.bodies.tolist()], self._units.metres)
        self._magnet_paths = [magnet_paths[row] for row in self._rows.magnets.tolist()]
        self._columns = [Column(kind, self._bodies.paths) for kind in BODY] + [Column(MAGNET, self._magnet_paths)]
        self._columns += [column for one in swarms for column in one.columns()]
        self._frames, self._options = frames, options or {}
        self._samples: SampleFile | None = None
        self._first: list[np.ndarray] = []
        self._last: list[np.ndarray] | None = None
        self._last_time = -np.inf
        self._below: list[str] = []
        self._save_time = 0.0

    def __enter__(self) -> "CacheWriter":
        """Return the writer itself."""
        return self

    def __exit__(self, kind, *exception) -> None:
        """Close, whatever ended the run."""
        self.close(complete=kind is None)

    def resume(self) -> Earlier | None:
        """Go on with the run that is at the output; call it before the first frame.

        Returns:
            What was found, None if there is nothing. A complete run is left as it is.

        Raises:
            InputError: Another run is writing there, or what is there is another run's, or none's.
        """
        if not (self._output.root.exists() or self._output.checkpoint.exists()):
            return None
        self._output.lock()
        try:
            checkpoint = self._output.load_checkpoint()
            return self._completed() if checkpoint is None else self._go_on(*checkpoint)
        except BaseException:
            self._output.close()
            raise

    def _go_on(self, about: dict[str, str], arrays: dict[str, np.ndarray]) -> Earlier:
        """Go on from a checkpoint."""
        self._compare(about)
        output = self._output
        places = {name[5:]: array for name, array in arrays.items() if name.startswith("file/")}
        state = {name[6:]: array for name, array in arrays.items() if name.startswith("state/")}
        with output.errors(output.cache):
            self._samples = SampleFile.resume(output.cache, self._value_sizes(), places)
        self._first = self._unpack(self._samples.frame(0))
        self._last = self._unpack(self._samples.frame(self._samples.count - 1))
        self._last_time = float(about["time"])
        for target in self._write_scene_and_root():
            output.place(target)
        output.place(output.root)
        return Earlier(self._last_time, state)

    def _completed(self) -> Earlier:
        """Return what there is to say about a run that has left no checkpoint."""
        path = self._output.cache
        with readable(str(path)):
            cache = Sdf.Layer.OpenAsAnonymous(str(path)) if path.exists() else None
        about = cache.customLayerData.get("warpmag") if cache else None
        if about is None:
            raise InputError(f"{self._output.root}: nothing to resume, no run of this version has written it")
        self._compare(about)
        return Earlier((cache.endTimeCode - self._clock.start) / self._clock.time_codes_per_second, None)

    def _compare(self, about: dict[str, str]) -> None:
        """Refuse to go on with another run."""
        for name, value in self._about.items():
            if about.get(name) != value:
                change = "" if name == "scene" else f": {about.get(name, 'unknown')}, now {value}"
                raise InputError(f"{self._output.root}: cannot resume, it was run with another {name}{change}")

    @cached_property
    def _about(self) -> dict[str, str]:
        """What makes out the run."""
        return {"scene": _digest(self._stage), **self._options}

    def add_frame(
        self,
        time: float,
        body_q: np.ndarray,
        body_qd: np.ndarray,
        moments: np.ndarray,
    ) -> None:
        """Write one frame.

        Args:
            time: Time since the start of the stage [s]; rises from frame to frame.
            body_q: Body frames in the world (position [m], quaternion x y z w), shape [n, 7].
            body_qd: Linear velocity of the centre of mass [m/s] and angular velocity [rad/s], world, shape [n, 6].
            moments: Moments of the magnets [A·m²], world frame, shape [m, 3].

        Raises:
            InputError: It cannot be written; the stage has the frames before.
        """
        if not time > self._last_time:
            raise ValueError(f"time must rise from frame to frame: {time} after {self._last_time}")
        rows, last = self._rows, self._last
        body_q = np.asarray(body_q, dtype=np.float32).reshape(rows.body_count, 7)
        body_qd = np.asarray(body_qd, dtype=np.float32).reshape(rows.body_count, 6)
        moments = np.asarray(moments, dtype=np.float32).reshape(rows.magnet_count, 3)
        placed = self._bodies.place(body_q[rows.bodies], body_qd[rows.bodies], last and last[1])
        values = [placed.positions, placed.turns, placed.linear, placed.angular, moments[rows.magnets]]
        for swarm, bodies, magnets in rows.of_swarms:
            own = np.where(magnets[:, None] < 0, np.float32(0.0), moments[magnets] if len(moments) else np.float32(0.0))
            turns = last and last[len(values) + 1]
            values += swarm.place(body_q[bodies], body_qd[bodies], own, turns)
        if self._samples is None:
            self._samples = self._begin(time, values)
        else:
            self._append(self._samples, time, values)

    @property
    def save_due(self) -> bool:
        """Whether :meth:`save` should be called after the next frame: about once a second."""
        return clock_time.monotonic() >= self._save_time

    def save(self, state: dict[str, np.ndarray] | None) -> None:
        """Write what changes with every frame besides the cache, after at least one frame.

        Args:
            state: All that the run needs to go on from the last frame; None if it cannot be resumed.

        Raises:
            InputError: It cannot be written.
        """
        assert self._samples is not None
        began = clock_time.monotonic()
        self._place_root()
        if state is not None:
            about = {**self._about, "time": repr(self._last_time)}
            arrays = {f"file/{name}": array for name, array in self._samples.places().items()}
            arrays |= {f"state/{name}": array for name, array in state.items()}
            with self._output.errors(self._output.checkpoint):
                self._output.save_checkpoint(about, arrays)
        spent = clock_time.monotonic() - began
        self._save_time = began + max(_CHECKPOINT_SECONDS, spent / _CHECKPOINT_SHARE)

    def close(self, complete: bool = True) -> None:
        """Close the files; a second call does nothing.

        Args:
            complete: Whether all frames are there, so that nobody will want to resume.
        """
        samples, self._samples = self._samples, None
        output = self._output
        try:
            if samples is None:
                return
            with contextlib.nullcontext() if complete else contextlib.suppress(InputError):  # there is a reason already
                with output.errors(output.cache):
                    samples.close()
                self._place_root()
            if complete:
                output.checkpoint.unlink(missing_ok=True)
        finally:
            output.close()
        for path in (output.beside(".scene.usdc"), output.instances, output.cache, output.root):
            if known := Sdf.Layer.Find(str(path)):  # an earlier run's result that this process has open
                known.Reload(force=True)

    # ---------------------------------------------------------------------------------------------------------------

    def _begin(self, time: float, values: list[np.ndarray]) -> SampleFile:
        """Write the files with the first frame; an earlier result stays until all of them are whole."""
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
            moved = [(own != first).any(axis=1) for own, first in zip(values, self._first, strict=True)]
            changed = np.flatnonzero(np.concatenate(moved) & ~samples.sampled)
        data = b"".join(column.packed(one) for column, one in zip(self._columns, values, strict=True))
        with self._output.errors(self._output.cache):
            samples.append(self._code(time), data, changed)
        self._last_time, self._last = float(time), values

    def _write_scene_and_root(self) -> list[Path]:
        """Write what the root names, without placing it, and the root; return what to place before that."""
        output, written = self._output, []
        self._below = []
        if instances := self._instances_layer():
            written.append(output.instances)
            with output.errors(output.instances):
                output.write(instances, output.instances)
            self._below.append(f"./{output.instances.name}")
        if self._copy_scene:
            with output.errors(output.beside(".scene")):
                target, scene = copy_scene(self._stage, output)
            written.append(target)
            self._below.append(f"./{scene.relative_to(output.root.parent)}")
        else:
            self._below.append(path_between(output.root, Path(self._stage.GetRootLayer().realPath)))
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
        """Return the values of a frame, as they were written."""
        found, place = [], 0
        for column in self._columns:
            found.append(column.unpacked(data, place))
            place += int(column.sizes.sum())
        return found

    def _metadata(self, end: float) -> dict[str, float | str]:
        """Return what says how the numbers of the scene are meant; the cache and the root repeat it."""
        return {
            "metersPerUnit": self._units.metres,
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
        # Players stop at whole frames: the last one, which stands at the step nearest to it, is not to be cut off.
        whole = round(self._last_time * self._clock.frames_per_second) / self._clock.frames_per_second
        for key, value in self._metadata(self._code(max(whole, self._last_time))).items():
            root.pseudoRoot.SetInfo(key, value)
        root.subLayerPaths[:] = [f"./{self._output.cache.name}", *self._below]
        return root

    def _instances_layer(self) -> Sdf.Layer | None:
        """Return the layer with the prims of instances, without those of instancers that stay such; None without."""
        found, swarms = added_layer(self._stage, INSTANCES), [swarm for swarm, *_ in self._rows.of_swarms]
        if found is None or not swarms:
            return found
        layer = Sdf.Layer.CreateAnonymous()
        layer.TransferContent(found)
        for one in swarms:
            spec = layer.GetPrimAtPath(one.path)
            del (spec.nameParent or layer.pseudoRoot).nameChildren[spec.name]
            prim = Sdf.CreatePrimInLayer(layer, one.path)
            moments = Sdf.AttributeSpec(prim, MOMENTS, Sdf.ValueTypeNames.Vector3fArray)
            moments.SetInfo("interpolation", UsdGeom.Tokens.vertex)
        return layer

    def _cache_layer(self) -> crate.Overs:
        """Return the layer with the motion, without its frames."""
        cache, bodies = crate.Overs(self._value_sizes()), self._bodies
        for name, value in self._metadata(self._clock.start).items():
            cache.set_metadata(name, value)
        cache.set_metadata("customLayerData", {"warpmag": self._about})
        for column in self._columns:
            cache.add_sampled(column.paths, column.kind.name, column.kind.type_name, column.kind.kind)
        scaled = ~np.isclose(bodies.scales, 1.0, rtol=0.0, atol=1e-6).all(axis=1)
        orders: dict[tuple[str, ...], list[str]] = {}
        for path, scale, free, has_scale in zip(bodies.paths, bodies.scales, bodies.free, scaled, strict=True):
            if has_scale:
                cache.add_vector(path, SCALE, scale)
            order = (*["!resetXformStack!"] * bool(free), TRANSLATE, ORIENT, *[SCALE] * bool(has_scale))
            orders.setdefault(order, []).append(path)
        for order, paths in orders.items():
            cache.add_tokens(paths, "xformOpOrder", order)
        stage, above = as_written(self._stage), {path.rpartition("/")[0] for one in self._columns for path in one.paths}
        for prim in instances_around(stage.GetPrimAtPath(path or "/") for path in above):
            cache.make_editable(str(prim.GetPath()))  # opinions in it have no effect before
        return cache


def _digest(stage: Usd.Stage) -> str:
    """Return a digest of the layers that a stage is made of, wherever they lie, with edits that nobody has saved."""
    layers = [layer for layer in stage.GetUsedLayers() if layer.realPath or layer == stage.GetRootLayer()]
    in_memory = [layer for layer in layers if layer.dirty or not layer.realPath]
    digests = [hashlib.sha256(layer.ExportToString().encode()).hexdigest() for layer in in_memory]
    for path in {file_with(layer.realPath) for layer in layers if layer not in in_memory}:
        with open(path, "rb") as file:
            digests.append(hashlib.file_digest(file, "sha256").hexdigest())
    return hashlib.sha256("".join(sorted(digests)).encode()).hexdigest()
