"""Records the frames of a run on a USD stage."""

import contextlib
import os
import signal
import threading
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import warp as wp

from warpmag.engine.magnets.magnetics import Magnetics
from warpmag.engine.stepping.scene import ImportedScene
from warpmag.engine.stepping.statistics import Statistics
from warpmag.engine.stepping.stepper import Stepper
from warpmag.errors import ConvergenceWarning, InputError
from warpmag.moments.ranks import Ranks, errors_on_all_ranks, is_first_rank, on_first_rank
from warpmag.terminal import react
from warpmag.usd import CacheWriter

_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_STATISTICS = "stat."


class Recorder:
    """Records the frames of a simulation.

    Frames are written one by one. With a GPU a frame is written while the next steps run. Signals that end the process
    are delayed until a frame is complete.

    ``written`` is the time of the last written frame since the start of the stage [s], None before the first.
    """

    def __init__(
        self,
        scene: ImportedScene,
        magnetics: Magnetics,
        stepper: Stepper,
        statistics: Statistics,
        output: str | os.PathLike,
        *,
        resumable: bool,
        ranks: Ranks | None,
        **writer_options,
    ):
        """Open a :class:`warpmag.usd.CacheWriter` with ``writer_options``; of several ``ranks`` only the first writes.

        If ``resumable``, it writes checkpoints, which include the statistics.
        """
        shapes = list(scene.magnet_shapes.values())
        row_of_shape = {shape: row for row, shape in enumerate(magnetics.shapes.tolist())}
        self._magnetics, self._stepper, self._statistics = magnetics, stepper, statistics
        self._output, self._resumable = output, resumable
        self._pending: tuple[float, bool, dict[str, np.ndarray] | None] | None = None
        state = stepper.state
        coils = magnetics.coils
        self._host_copies = _HostCopies(
            (state.body_q, state.body_qd, magnetics.summed_moments, *([] if coils is None else [coils.currents]))
        )
        row_of_coil = {shape: row for row, shape in enumerate([] if coils is None else coils.shapes)}
        self._coils = [row_of_coil[shape] for shape in scene.circuits.values()]
        # keyed bodies already have time samples
        recorded = {prim: body for prim, body in scene.bodies.items() if body not in scene.keys.motions}
        self._bodies = np.array(list(recorded.values()), dtype=int)
        self._shapes = np.array([row_of_shape[shape] for prim_shapes in shapes for shape in prim_shapes], dtype=int)
        self._first_shapes = np.cumsum([0, *map(len, shapes[:-1])]) if shapes else np.zeros(0, dtype=int)
        self._ranks, self.written = ranks, None
        self._writer: CacheWriter | _NoWriter = _NoWriter()
        with errors_on_all_ranks(ranks):
            if is_first_rank(ranks):
                prims = list(recorded), list(scene.magnet_shapes)
                writer_options |= {"coil_paths": list(scene.circuits), "instancers": scene.swarms}
                self._writer = CacheWriter(scene.stage, output, *prims, **writer_options)

    def resume(self, frames: int, steps: int, step_size: float) -> tuple[bool, bool]:
        """Continue the run at the output; the whole run has ``frames``, and ``steps`` of ``step_size`` [s].

        Return True if there was a run, and True if it is complete. A run that cannot be resumed raises
        :class:`InputError`.
        """
        with _signals_delayed():
            earlier = on_first_rank(self._writer.resume, self._ranks)
        if earlier is None or (earlier.state is None and earlier.time <= 0.0):
            return False, False  # no run, or only its first frame
        done, output = round(earlier.time / step_size), Path(self._output)
        if done > steps:
            raise InputError(f"frames: {output} already has {earlier.time:g} s, more than {frames} frames")
        if earlier.state is not None:
            if not np.array_equal(earlier.state.get("steps"), done):
                raise InputError(f"{output}: cannot resume, its checkpoint is of another time")
            names = [name for name in earlier.state if name.startswith(_STATISTICS)]
            try:
                self._stepper.load(earlier.state)
                self._statistics.load({name.removeprefix(_STATISTICS): earlier.state[name] for name in names})
            except KeyError as name:
                raise InputError(f"{output}: cannot resume, its checkpoint has no {name}") from None
            except InputError as error:
                raise InputError(f"{output}: cannot resume, {error}") from None
        elif done < steps:
            raise InputError(f"frames: the run of {output} ended at {earlier.time:g} s and cannot be extended")
        self.written = earlier.time
        return True, earlier.state is None

    def add_frame(self, time: float, state) -> None:
        """Record a frame ``time`` [s] after the start. With a GPU the next :meth:`write` writes it, while steps run.

        The moments are those of the last substep. Before the first step they are solved, without effect on later steps.
        """
        self.write()
        if time > 0.0:
            self._magnetics.sum_moments()
        else:
            with warnings.catch_warnings():  # the statistics count solves that did not converge
                warnings.simplefilter("ignore", ConvergenceWarning)
                self._magnetics.moments_at(state)
        self._host_copies.copy()
        due = self._writer.save_due
        checkpoint = None
        if due and self._resumable:
            statistics = {f"{_STATISTICS}{name}": value for name, value in self._statistics.save().items()}
            checkpoint = self._stepper.save() | statistics
        self._pending = time, due, checkpoint
        if not self._magnetics.device.is_cuda:
            self.write()

    def write(self) -> None:
        """Write the pending frame, if there is one, and a checkpoint if one is due."""
        with _signals_delayed():
            if self._pending is None:
                return
            (time, due, checkpoint), self._pending = self._pending, None
            body_q, body_qd, moments, *currents = self._host_copies.read()
            moments = moments[self._shapes]
            totals = np.add.reduceat(moments, self._first_shapes, axis=0) if len(moments) else moments
            bodies = body_q[self._bodies], body_qd[self._bodies]
            self._writer.add_frame(time, *bodies, totals, currents[0][self._coils] if currents else ())
            self.written = time
            if due:
                self._writer.save(checkpoint)

    def close(self, complete: bool) -> None:
        """Close the files. A run that is not complete can be resumed."""
        written = False
        try:
            self.write()
            written = True
        finally:
            with _signals_delayed():
                self._writer.close(complete and written)


class _NoWriter:
    """Writer of all ranks but the first; its methods do nothing."""

    save_due = False

    def add_frame(self, *_):
        pass

    resume = save = close = add_frame


class _HostCopies:
    """Copies of device arrays on the host, made without waiting for the device."""

    def __init__(self, arrays: Sequence[wp.array]):
        """Allocate copies of arrays of one device."""
        self._arrays, device = arrays, arrays[0].device
        self._copies = [wp.empty_like(array, device="cpu", pinned=device.is_cuda) for array in arrays]
        self._copied = wp.Event(device) if device.is_cuda else None

    def copy(self) -> None:
        """Queue copies of the arrays, after all work launched so far."""
        for host_copy, array in zip(self._copies, self._arrays, strict=True):
            wp.copy(host_copy, array)
        if self._copied:
            self._arrays[0].device.stream.record_event(self._copied)

    def read(self) -> list[np.ndarray]:
        """Return the copies; the next :meth:`copy` overwrites them."""
        if self._copied:
            wp.synchronize_event(self._copied)
        return [host_copy.numpy() for host_copy in self._copies]


@contextlib.contextmanager
def _signals_delayed() -> Iterator[None]:
    """Delay signals that end the process until the context is left."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    caught: list[int] = []

    def delay(number, _):
        react()
        caught.append(number)

    handlers = {number: signal.getsignal(number) for number in _SIGNALS}
    delayed = [number for number, handler in handlers.items() if handler not in (signal.SIG_IGN, None)]
    for number in delayed:
        signal.signal(number, delay)
    try:
        yield
    finally:
        for number in delayed:
            signal.signal(number, handlers[number])
    for number in caught[:1]:
        signal.raise_signal(number)
