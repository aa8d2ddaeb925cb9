"""The progress bar of a run."""

import sys
from typing import Any, ClassVar

from warpmag.terminal import silence


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
