"""Wall time of a command, divided into its parts."""

import contextlib
import os
import time

from warpmag.kernel_loading import kernel_seconds

_KERNELS = "kernels"
_SHORTEST = 0.05
"""Shortest part that a line shows [s]: others round to zero."""


def process_age() -> float:
    """Return the time since the start of this process [s], or since the start of Python's clock where unknown."""
    with contextlib.suppress(OSError, ValueError, IndexError, AttributeError):
        with open("/proc/self/stat", encoding="utf-8") as status:
            ticks = int(status.read().rpartition(")")[2].split()[19])  # starttime of proc(5)
        return time.clock_gettime(time.CLOCK_BOOTTIME) - ticks / os.sysconf("SC_CLK_TCK")
    return time.process_time()


class Stopwatch:
    """Parts of the wall time of a command. They add up to the whole, since each begins where the last one ended.

    The compilation and loading of kernels is a part of its own, wherever it happens.
    """

    def __init__(self, age: float = 0.0):
        """Start, for a command that began ``age`` [s] ago."""
        self._last, self._kernels = time.perf_counter() - age, kernel_seconds()
        self._parts: dict[str, float] = {}

    def end_part(self, name: str) -> None:
        """Add the time since the last call to a part, without that of kernels."""
        now, kernels = time.perf_counter(), kernel_seconds()
        loading = kernels - self._kernels
        for part, seconds in ((name, now - self._last - loading), (_KERNELS, loading)):
            self._parts[part] = self._parts.get(part, 0.0) + seconds
        self._last, self._kernels = now, kernels

    @property
    def parts(self) -> dict[str, float]:
        """Duration of each part [s], by name, in the order of their first end."""
        return dict(self._parts)

    def line(self) -> str:
        """Return the whole and its parts in one line, without parts too short to show."""
        parts = ", ".join(f"{name} {seconds:.1f} s" for name, seconds in self._parts.items() if seconds >= _SHORTEST)
        return f"wall time      {sum(self._parts.values()):.1f} s: {parts}"
