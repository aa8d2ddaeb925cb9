"""Records the frames of a run on a USD stage, so that it survives whatever ends it."""

import contextlib
import os
import signal
import threading
from collections.abc import Callable, Iterator

import numpy as np

from warpmag.engine.magnetics import Magnetics
from warpmag.engine.scene import ImportedScene
from warpmag.usd import CacheWriter, Earlier

_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class Recorder:
    """Takes the frames of a simulation.

    Frames are written as they come, on a GPU during the steps that follow. What interrupts a run waits until the frame
    that is being written is whole.
    """

    def __init__(
        self,
        scene: ImportedScene,
        magnetics: Magnetics,
        output: str | os.PathLike,
        *,
        copy_scene: bool,
        frames: int,
        options: dict[str, str],
    ):
        """Prepare to write; see :class:`warpmag.usd.CacheWriter`."""
        shapes = list(scene.magnet_shapes.values())
        row = {shape: index for index, shape in enumerate(magnetics.shapes.tolist())}
        self._magnetics = magnetics
        self._taken: tuple | None = None
        # keyed bodies have samples of their own
        own = {prim: body for prim, body in scene.bodies.items() if body not in scene.keys.motions}
        self._bodies = np.array(list(own.values()), dtype=int)
        self._shapes = np.array([row[shape] for of_prim in shapes for shape in of_prim], dtype=int)
        self._first_shapes = np.cumsum([0, *map(len, shapes[:-1])]) if shapes else np.zeros(0, dtype=int)
        self._writer = CacheWriter(
            scene.stage,
            output,
            list(own),
            list(scene.magnet_shapes),
            copy_scene=copy_scene,
            frames=frames,
            options=options,
        )

    def resume(self) -> Earlier | None:
        """Go on with the run that is at the output; returns what was found."""
        with _interrupts_held():
            return self._writer.resume()

    def add_frame(self, time: float, state, save: Callable[[], dict[str, np.ndarray]] | None) -> None:
        """Take a frame, and write it; on a GPU :meth:`write` does that, while the next steps run.

        Moments are those of the last substep. Before the first step there are none: they are solved for, and forgotten.

        Args:
            time: Time since the start [s].
            state: Newton's state.
            save: Returns all that the run needs to go on from here; None if it cannot be resumed.
        """
        moments = (self._magnetics.shape_moments() if time > 0.0 else self._magnetics.moments_at(state))[self._shapes]
        totals = np.add.reduceat(moments, self._first_shapes, axis=0) if len(moments) else moments
        body_q, body_qd = state.body_q.numpy()[self._bodies], state.body_qd.numpy()[self._bodies]
        self.write()
        self._taken = (time, body_q, body_qd, totals)
        if self._writer.save_due:
            self.write()
            with _interrupts_held():
                self._writer.save(save() if save else None)
        elif not self._magnetics.system.device.is_cuda:
            self.write()

    def write(self) -> None:
        """Write the frame that has been taken, if it has not been written yet."""
        with _interrupts_held():
            if taken := self._taken:
                self._taken = None
                self._writer.add_frame(*taken)

    def close(self, complete: bool) -> None:
        """Close the files; unless the run is complete, it can be resumed."""
        try:
            self.write()
        finally:
            with _interrupts_held():
                self._writer.close(complete)


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
