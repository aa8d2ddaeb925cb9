"""Time that Warp takes to compile and load kernels, measured for the command."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

_BINARIES = {True: (".o",), False: (".ptx", ".cubin")}
"""Suffixes of compiled kernels in Warp's cache, for a CPU and for a GPU."""


@dataclass
class _Loading:
    """State of the measurement in this process."""

    seconds: float = 0.0  # time of all loads so far
    announce: Callable[[], None] | None = None  # called before the first compilation
    watched: bool = False  # True once loads are timed


_loading = _Loading()


def kernel_seconds() -> float:
    """Return the time that Warp took to compile and load kernels [s]; 0 without :func:`watch_kernels`."""
    return _loading.seconds


def watch_kernels(announce: Callable[[], None]) -> None:
    """Measure the loading of kernels from now on, and call ``announce`` once, before a kernel is compiled.

    Warp reports a compilation only after its end. So this replaces ``warp.Module.load``, for the whole process: only
    the command calls it.
    """
    import warp as wp  # noqa: PLC0415 - the engine reads the time without Warp

    _loading.announce = announce
    if _loading.watched:
        return
    _loading.watched = True
    modules: Any = wp.Module
    load = modules.load

    def timed_load(module: Any, device: Any, block_dim: int | None = None, *others: Any, **named: Any) -> Any:
        began = time.perf_counter()
        if _loading.announce is not None and not _is_compiled(module, wp.get_device(device), block_dim):
            _loading.announce()
            _loading.announce = None
        try:
            return load(module, device, block_dim, *others, **named)
        finally:
            _loading.seconds += time.perf_counter() - began

    modules.load = timed_load


def _is_compiled(module: Any, device: Any, block_dim: int | None) -> bool:
    """Return True if a module is loaded, or Warp's cache has it for this kind of device."""
    import warp as wp  # noqa: PLC0415

    if module.execs:
        return True
    files = Path(wp.config.kernel_cache_dir, module.get_module_identifier(block_dim)).glob("*")
    return any(file.suffix in _BINARIES[device.is_cpu] for file in files)
