"""What a command shows on the standard error, which nobody may read any more."""

import contextlib
import os
import sys
import tempfile
from collections.abc import Iterator


def silence(descriptor: int) -> None:
    """Drop what goes to a standard file, also what Python writes there when it ends."""
    nothing = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nothing, descriptor)
    os.close(nothing)


def quiet_warp() -> None:
    """Keep Warp's start-up talk off the terminal; must come before the first import of the engine."""
    import warp  # noqa: PLC0415

    warp.config.log_level = warp.LOG_ERROR
    warp.config.enable_backward = False  # nothing here is differentiated, and it doubles the time to compile
    with _without_lines("Could not find or load the NVIDIA CUDA driver", "no CUDA-capable device is detected"):
        warp.init()


@contextlib.contextmanager
def _without_lines(*texts: str) -> Iterator[None]:
    """Drop the lines with one of ``texts`` from what native code writes to stderr."""
    sys.stderr.flush()
    saved = os.dup(2)
    with tempfile.TemporaryFile() as caught:
        os.dup2(caught.fileno(), 2)
        try:
            yield
        finally:
            os.dup2(saved, 2)
            os.close(saved)
            caught.seek(0)
            for line in caught.read().decode(errors="replace").splitlines():
                if not any(text in line for text in texts):
                    print(line, file=sys.stderr)


class Progress:
    """A progress bar that appears with the first frame, so that bad input is answered by its one line alone."""

    def __init__(self, frames: int):
        """Expect so many frames."""
        self.frames, self.done = frames, None
        self._bar = None

    def show(self, frame: int) -> None:
        """Show that ``frame`` is done."""
        self.done = frame
        try:
            self._draw(frame)
        except OSError:  # nobody reads it any more, which is no reason to end the run
            silence(2)

    def _draw(self, frame: int) -> None:
        if self._bar is None:
            from tqdm import tqdm  # noqa: PLC0415

            interval = 0.2 if sys.stderr.isatty() else 10.0
            self._bar = tqdm(
                total=self.frames,
                initial=frame,
                unit="frame",
                mininterval=interval,
                file=sys.stderr,
                dynamic_ncols=True,
            )
        self._bar.update(frame - self._bar.n)

    def close(self) -> None:
        """Leave the bar as it is."""
        try:
            if self._bar is not None:
                self._bar.close()
        except OSError:
            silence(2)
