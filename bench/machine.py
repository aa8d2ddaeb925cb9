"""Machine, versions and commit of a measurement, and the JSON lines that contain them."""

import json
import os
import platform
import subprocess
from collections.abc import Callable
from pathlib import Path

import warp as wp

from warpmag.kernels.shared.cores import cores

_CLOCKS = {"NVIDIA H200": 1.98e9}  # clock of GPUs under load [Hz]
_LANES = 128  # float32 operations that a multiprocessor of these GPUs starts per cycle


def describe(device) -> dict:
    """Return machine, device, versions and commit of a measurement on a Warp device.

    ``operations_per_second`` are those in float32 that a GPU can start; None for a CPU and for GPUs of unknown clock.
    """
    device = wp.get_device(device)
    known = device.is_cuda and device.name in _CLOCKS
    return {
        "commit": _commit(),
        "device": device.name if device.is_cuda else "cpu",
        "machine": f"{_processor()}, {cores()} cores",
        "python": platform.python_version(),
        "warp": wp.__version__,
        "operations_per_second": device.sm_count * _LANES * _CLOCKS[device.name] if known else None,
    }


def line_writer(device, output: Path | None = None) -> Callable[[dict], None]:
    """Return a function that prints a dict and its machine as a JSON line, and appends the line to ``output``."""
    machine = describe(device)

    def write(line: dict) -> None:
        text = json.dumps(line | machine)
        print(text, flush=True)
        if output:
            output.parent.mkdir(parents=True, exist_ok=True)
            with output.open("a") as file:
                file.write(text + "\n")

    return write


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


def _commit() -> str:
    """Short hash of the checkout, with ``+`` for uncommitted changes; outside a checkout ``WARPMAG_COMMIT``."""

    def git(*arguments):
        command = ["git", "-C", Path(__file__).parent, *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()

    try:
        changed = git("status", "--porcelain", "--untracked-files=no", "--", "..")
        return git("rev-parse", "--short", "HEAD") + "+" * bool(changed)
    except (OSError, subprocess.CalledProcessError):
        return os.environ.get("WARPMAG_COMMIT", "")
