"""The process that the command runs in: its standard files, and the signals that end it."""

import contextlib
import os
import signal
import sys
import tempfile
import threading
from collections.abc import Iterator


class Stopped(KeyboardInterrupt):
    """A signal that ends the command."""

    def __init__(self, number: int):
        """Name the signal ``number``."""
        self.number = number
        super().__init__("interrupted" if number == signal.SIGINT else f"ended by {signal.Signals(number).name}")


def open_standard_files() -> None:
    """Put something in the place of standard files that are closed, or files of a run would take their numbers."""
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w" if number else "r", encoding="utf-8"))


@contextlib.contextmanager
def signals_raised() -> Iterator[None]:
    """Raise :class:`Stopped` for signals that would end the process; those that are ignored stay so."""

    def stop(number, _):
        raise Stopped(number)

    ends = {signal.SIGINT: signal.default_int_handler, signal.SIGTERM: signal.SIG_DFL, signal.SIGHUP: signal.SIG_DFL}
    before = {}
    if threading.current_thread() is threading.main_thread():
        before = {number: handler for number, handler in ends.items() if signal.getsignal(number) == handler}
    for number in before:
        signal.signal(number, stop)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def silence(descriptor: int) -> None:
    """Drop what goes to a standard file, also what Python writes there when it ends."""
    nothing = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nothing, descriptor)
    os.close(nothing)


def tell(what) -> None:
    """Print a line on stderr, if somebody reads it."""
    try:
        print(f"warpmag: {what}", file=sys.stderr, flush=True)
    except OSError:
        silence(2)


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
