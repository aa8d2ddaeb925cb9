"""Standard files, signals and garbage collection of the process."""

import atexit
import contextlib
import gc
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Collection, Iterator
from types import FrameType
from typing import Any

STOPPED = 128
"""A command that a signal ends exits with this plus the signal's number."""
_PATIENCE, _ENDING = 1.0, 10.0
"""Times in which Python has to react to a signal, and then to end the command, before the command is killed [s]."""
_GUARD = """
import os, select, sys, time
pipe, command, patience, ending = int(sys.argv[1]), int(sys.argv[2]), float(sys.argv[3]), float(sys.argv[4])
deadline = None
while True:
    now = time.monotonic()
    if not select.select([pipe], [], [], deadline and max(deadline - now, 0.0))[0]:
        os.write(2, b"warpmag: ended by a signal\\n")
        os.kill(command, 9)
        break
    byte, now = os.read(pipe, 1), time.monotonic()
    if not byte:
        break
    if byte == b"\\0":
        deadline = now + ending
    elif str(byte[0]) in sys.argv[5:]:
        deadline = min(deadline or now + patience, now + patience)
"""
"""Program of a process that kills the command when native code keeps Python from reacting to a signal.

It reads the number of each signal, and 0 when Python has reacted.
"""


class Stopped(KeyboardInterrupt):
    """A signal that ends the command."""

    def __init__(self, number: int):
        """Store the signal's number, and name the signal in the message."""
        self.number = number
        super().__init__("interrupted" if number == signal.SIGINT else f"ended by {signal.Signals(number).name}")


def open_standard_files() -> None:
    """Open the null device for each closed standard file, so that no other file gets its descriptor."""
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w" if number else "r", encoding="utf-8"))


@contextlib.contextmanager
def _signals_guarded(numbers: Collection[signal.Signals]) -> Iterator[None]:
    """Kill the process soon after a signal to which Python does not react, because native code does not return.

    The C handlers of Python write each signal to a pipe, and :func:`react` writes 0. A child process reads the pipe.
    """
    if not numbers or not sys.executable or os.name != "posix":
        yield
        return
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    limits = map(str, (reader, os.getpid(), _PATIENCE, _ENDING, *map(int, numbers)))
    options = {"pass_fds": [reader], "stdin": subprocess.DEVNULL, "stdout": subprocess.DEVNULL}
    unblocked = signal.pthread_sigmask(signal.SIG_BLOCK, numbers)  # the guard inherits it: it outlives the signals
    try:
        guard = subprocess.Popen([sys.executable, "-S", "-E", "-c", _GUARD, *limits], **options)
        earlier = signal.set_wakeup_fd(writer, warn_on_full_buffer=False)
    except OSError:  # no process can be started
        guard = None
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, unblocked)
        os.close(reader)
    try:
        yield
    finally:
        if guard:
            signal.set_wakeup_fd(earlier)
            guard.kill()
            guard.wait()
        os.close(writer)


def react() -> None:
    """Record that Python has reacted to a signal."""
    if threading.current_thread() is threading.main_thread():
        writer = signal.set_wakeup_fd(-1)
        if writer >= 0:
            with contextlib.suppress(OSError):
                os.write(writer, b"\0")
            signal.set_wakeup_fd(writer, warn_on_full_buffer=False)


def _is_importing(frame: FrameType | None) -> bool:
    """Return True if a module is being imported by the code of a frame or by its callers."""
    while frame and not frame.f_code.co_filename.startswith("<frozen importlib"):
        frame = frame.f_back
    return frame is not None


@contextlib.contextmanager
def interrupted_silently() -> Iterator[None]:
    """End the process at Ctrl-C without a traceback, while the command is imported."""
    usual = signal.default_int_handler
    if threading.current_thread() is not threading.main_thread() or signal.getsignal(signal.SIGINT) is not usual:
        yield
        return
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, usual)


@contextlib.contextmanager
def signals_raised() -> Iterator[None]:
    """Raise :class:`Stopped` for signals that would end the process, or kill it. Ignored signals stay ignored.

    The process is killed where native code does not return to Python within a second.
    """

    def stop(number, frame):
        react()
        stopped = Stopped(number)
        if _is_importing(frame):  # native modules that are half imported lose the exception, or turn it into others
            os.write(2, f"warpmag: {stopped}\n".encode())
            os._exit(STOPPED + number)
        raise stopped

    defaults = {
        signal.SIGINT: signal.default_int_handler,
        signal.SIGTERM: signal.SIG_DFL,
        signal.SIGHUP: signal.SIG_DFL,
    }
    replaced = {}
    if threading.current_thread() is threading.main_thread():
        replaced = {number: handler for number, handler in defaults.items() if signal.getsignal(number) == handler}
    for number in replaced:
        signal.signal(number, stop)
    try:
        with _signals_guarded(replaced):
            yield
    finally:
        for number, handler in replaced.items():
            signal.signal(number, handler)


def silence(descriptor: int) -> None:
    """Redirect a standard file to the null device, including output that Python flushes at exit."""
    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, descriptor)
    os.close(null)


def log(message) -> None:
    """Print a line on stderr. A closed stderr raises no error."""
    try:
        print(f"warpmag: {message}", file=sys.stderr, flush=True)
    except OSError:
        silence(2)


def quiet_warp() -> None:
    """Initialize Warp without its messages. Call this before the engine is imported."""
    import warp  # noqa: PLC0415

    warp.config.log_level = warp.LOG_ERROR
    warp.config.enable_backward = False  # gradients are not used, and take time to compile
    with _without_lines("Could not find or load the NVIDIA CUDA driver", "no CUDA-capable device is detected"):
        try:
            warp.init()
            folder = warp.config.kernel_cache_dir
            usable = os.access(folder, os.W_OK) or bool(
                os.listdir(folder)
            )  # a folder of compiled kernels may be enough
            reason = "" if usable else f"{folder} cannot be written"
        except OSError as error:
            reason = f"{error.filename}: {error.strerror}"
        if reason:
            _use_temporary_cache(warp, reason)


def _use_temporary_cache(warp: Any, reason: str) -> None:
    """Initialize Warp with a cache that is removed at exit, because of ``reason``."""
    folder = tempfile.mkdtemp(prefix="warpmag_kernels_")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    log(f"warning: kernels are compiled for this command only, since Warp's cache is of no use ({reason})")
    warp.config.kernel_cache_dir = folder
    warp.init()


@contextlib.contextmanager
def _without_lines(*texts: str) -> Iterator[None]:
    """Suppress the lines of native code on stderr that contain one of ``texts``."""
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


@contextlib.contextmanager
def collection_paused() -> Iterator[None]:
    """Pause Python's garbage collection while very many objects are created and none is released. Also a decorator.

    Collection takes a fifth of the time to read and build a stage of 100,000 balls, and a seventh of the time to import
    Newton. If the caller has disabled collection, it stays disabled.
    """
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


def skip_last_collection() -> None:
    """Make Python exit without a last garbage collection, which takes seconds with the modules of Newton and Warp."""
    gc.freeze()
