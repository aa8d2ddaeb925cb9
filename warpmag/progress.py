"""The progress bar of a run, and the line before it."""

import contextlib
import sys
import threading
from typing import Any, ClassVar

from warpmag.terminal import silence

_TICK = 0.5
"""Time between two readings of the clock in a line [s]."""


class Progress:
    """A progress bar on stderr. It appears with the first frame, before the first step, after errors of the input."""

    _drawn: ClassVar[Any] = None
    """The bar that is on the terminal now, if there is one."""

    def __init__(self, frames: int):
        """Prepare a bar for ``frames`` frames."""
        self.frames, self.done = frames, None
        self._bar = None

    def show(self, frame: int) -> None:
        """Show that ``frame`` is done."""
        self.done = frame
        try:
            self._draw(frame)
        except OSError:  # a closed stderr does not end the run
            silence(2)

    def _draw(self, frame: int) -> None:
        if self._bar is None:
            from tqdm import tqdm  # noqa: PLC0415

            Waiting.end()
            style = {"unit": "frame", "mininterval": 0.2 if sys.stderr.isatty() else 10.0, "dynamic_ncols": True}
            self._bar = Progress._drawn = tqdm(total=self.frames, initial=frame, file=sys.stderr, **style)
        self._bar.update(frame - self._bar.n)

    def close(self) -> None:
        """Close the bar; it stays visible."""
        Progress._drawn = None
        try:
            if self._bar is not None:
                self._bar.close()
        except OSError:
            silence(2)

    @staticmethod
    def interrupt(line: str) -> None:
        """Print a line on stderr, above a bar if there is one."""
        try:
            if Progress._drawn is None:
                print(line, file=sys.stderr, flush=True)
            else:
                Progress._drawn.write(line, file=sys.stderr)
        except OSError:
            silence(2)


class Waiting:
    """A line on stderr, where it is a terminal, with a text and the time so far, from the first second of a command.

    Lines of :meth:`Progress.interrupt` appear above it.
    """

    _now: ClassVar["Waiting | None"] = None

    def __init__(self, text: str):
        """Draw the line, until :meth:`end` or the first frame of a :class:`Progress`."""
        Waiting.end()
        if not sys.stderr.isatty():
            return
        from tqdm import tqdm  # noqa: PLC0415

        style = {"bar_format": "{desc}, {elapsed}", "leave": False, "dynamic_ncols": True}
        self._bar = Progress._drawn = tqdm(total=0, desc=text, file=sys.stderr, **style)
        self._ended = threading.Event()
        self._clock = threading.Thread(target=self._tick, daemon=True)
        self._clock.start()
        Waiting._now = self

    def _tick(self) -> None:
        with contextlib.suppress(OSError):  # a closed stderr does not end the command
            while not self._ended.wait(_TICK):
                self._bar.refresh()

    @classmethod
    def end(cls) -> None:
        """Remove the line, if there is one."""
        line, cls._now = cls._now, None
        if line is None:
            return
        line._ended.set()
        line._clock.join()
        Progress._drawn = None
        with contextlib.suppress(OSError):
            line._bar.close()
