"""Records the frames of a run on a USD stage, so that it survives whatever ends it."""

import contextlib
import os
import signal
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import warp as wp

from warpmag.engine.magnets.magnetics import Magnetics
from warpmag.engine.stepping.scene import ImportedScene
from warpmag.engine.stepping.statistics import Statistics
from warpmag.engine.stepping.stepper import Stepper
from warpmag.errors import InputError
from warpmag.moments.ranks import Ranks, errors_on_all_ranks, is_first_rank, on_first_rank
from warpmag.usd import CacheWriter

_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_STATISTICS = "stat."


class Recorder:
    """Takes the frames of a simulation.

    Frames are written as they come, on a GPU during the steps that follow, and the host does not wait for them. What
    interrupts a run waits until the frame that is being written is whole.

    Attributes:
        written: Time of the last frame that stands on the stage since its start [s]; None without any.
    """

    def __init__(
        self,
        scene: ImportedScene,
        magnetics: Magnetics,
        stepper: Stepper,
        statistics: Statistics,
        output: str | os.PathLike,
        *,
        copy_scene: bool,
        frames: int,
        options: dict[str, str],
        resumable: bool,
        ranks: Ranks | None,
    ):
        """Prepare to write; see :class:`warpmag.usd.CacheWriter`.

        Args:
            scene: The scene.
            magnetics: Its magnets.
            stepper: What moves it.
            statistics: Figures of the run so far.
            output: File of the root layer.
            copy_scene: Copy the scene beside it.
            frames: Frames that are expected.
            options: What a run that goes on from this one must have in common with it.
            resumable: Whether one can.
            ranks: Processes of which the first writes; None means that there is but this one.
        """
        shapes = list(scene.magnet_shapes.values())
        row = {shape: index for index, shape in enumerate(magnetics.shapes.tolist())}
        self._magnetics, self._stepper, self._statistics = magnetics, stepper, statistics
        self._output, self._resumable = output, resumable
        self._taken: tuple[float, bool, dict[str, np.ndarray] | None] | None = None
        state = stepper.state
        self._mirrors = _Mirrors((state.body_q, state.body_qd, magnetics.sum_moments()))
        # keyed bodies have samples of their own
        own = {prim: body for prim, body in scene.bodies.items() if body not in scene.keys.motions}
        self._bodies = np.array(list(own.values()), dtype=int)
        self._shapes = np.array([row[shape] for of_prim in shapes for shape in of_prim], dtype=int)
        self._first_shapes = np.cumsum([0, *map(len, shapes[:-1])]) if shapes else np.zeros(0, dtype=int)
        self._ranks, self.written = ranks, None
        self._writer: CacheWriter | _NoWriter = _NoWriter()
        with errors_on_all_ranks(ranks):
            if is_first_rank(ranks):
                self._writer = CacheWriter(
                    scene.stage,
                    output,
                    list(own),
                    list(scene.magnet_shapes),
                    instancers=scene.swarms,
                    copy_scene=copy_scene,
                    frames=frames,
                    options=options,
                )

    def resume(self, frames: int, steps: int, step_size: float) -> tuple[bool, bool]:
        """Go on with the run at the output.

        Args:
            frames: Frames that are wanted.
            steps: Steps that are done then.
            step_size: Time step [s].

        Returns:
            Whether there was a run, and whether it is complete.

        Raises:
            InputError: What is there cannot be resumed.
        """
        with _interrupts_held():
            found = on_first_rank(self._writer.resume, self._ranks)
        if found is None or (found.state is None and found.time <= 0.0):
            return False, False  # nothing there, or no more than the first frame
        done, output = round(found.time / step_size), Path(self._output)
        if done > steps:
            raise InputError(f"frames: {output} has {found.time:g} s already, more than {frames} frames")
        if found.state is not None:
            names = [name for name in found.state if name.startswith(_STATISTICS)]
            try:
                self._stepper.load(found.state)
                self._statistics.load({name.removeprefix(_STATISTICS): found.state[name] for name in names})
            except KeyError as name:
                raise InputError(f"{output}: cannot resume, its checkpoint has no {name}") from None
            except InputError as error:
                raise InputError(f"{output}: cannot resume, {error}") from None
        elif done < steps:
            raise InputError(f"frames: the run of {output} ended at {found.time:g} s, there is nothing to resume")
        self.written = found.time
        return True, found.state is None

    def add_frame(self, time: float, state) -> None:
        """Take a frame, and write it; on a GPU :meth:`write` does that, while the next steps run.

        Moments are those of the last substep. Before the first step there are none: they are solved for, and forgotten.

        Args:
            time: Time since the start [s].
            state: Newton's state, of which no step is being done.
        """
        self.write()
        if time > 0.0:
            self._magnetics.sum_moments()
        else:
            self._magnetics.moments_at(state)
        self._mirrors.take()
        due = self._writer.save_due
        self._taken = time, due, self._save() if due and self._resumable else None
        if not self._magnetics.device.is_cuda:
            self.write()

    def _save(self) -> dict[str, np.ndarray]:
        """Return all that a run has to know to go on from the present state."""
        figures = {f"{_STATISTICS}{name}": one for name, one in self._statistics.save().items()}
        return self._stepper.save() | figures

    def write(self) -> None:
        """Write the frame that has been taken, and a checkpoint if it is time, unless that has been done."""
        with _interrupts_held():
            if self._taken is None:
                return
            (time, due, saved), self._taken = self._taken, None
            body_q, body_qd, moments = self._mirrors.read()
            moments = moments[self._shapes]
            totals = np.add.reduceat(moments, self._first_shapes, axis=0) if len(moments) else moments
            self._writer.add_frame(time, body_q[self._bodies], body_qd[self._bodies], totals)
            self.written = time
            if due:
                self._writer.save(saved)

    def close(self, complete: bool) -> None:
        """Close the files; unless the run is complete, and its last frame written, it can be resumed."""
        written = False
        try:
            self.write()
            written = True
        finally:
            with _interrupts_held():
                self._writer.close(complete and written)


class _NoWriter:
    """Writes nothing: what ranks other than the first have."""

    save_due = False

    def resume(self):
        """Find nothing."""

    def add_frame(self, *frame):
        """Write no frame."""

    def save(self, state):
        """Write no checkpoint."""

    def close(self, complete):
        """Close nothing."""


class _Mirrors:
    """Copies of arrays on the host, for which it need not wait."""

    def __init__(self, arrays: Sequence[wp.array]):
        """Make room for copies of arrays of one device."""
        self._arrays, device = arrays, arrays[0].device
        self._copies = [wp.empty_like(array, device="cpu", pinned=device.is_cuda) for array in arrays]
        self._taken = wp.Event(device) if device.is_cuda else None

    def take(self) -> None:
        """Copy the arrays as they are once what has been launched so far is done."""
        for copy, array in zip(self._copies, self._arrays, strict=True):
            wp.copy(copy, array)
        if self._taken:
            self._arrays[0].device.stream.record_event(self._taken)

    def read(self) -> list[np.ndarray]:
        """Return the copies, which the next :meth:`take` overwrites."""
        if self._taken:
            wp.synchronize_event(self._taken)
        return [copy.numpy() for copy in self._copies]


@contextlib.contextmanager
def _interrupts_held() -> Iterator[None]:
    """Let signals that end the process wait until what is being recorded is complete."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    caught = []
    before = {one: signal.getsignal(one) for one in _SIGNALS}
    held = [one for one, handler in before.items() if handler not in (signal.SIG_IGN, None)]
    for one in held:
        signal.signal(one, lambda number, _: caught.append(number))
    try:
        yield
    finally:
        for one in held:
            signal.signal(one, before[one])
    for one in caught[:1]:
        signal.raise_signal(one)
