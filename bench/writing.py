"""Cost of writing: runs with and without output in turns, and the growth of their memory."""

import os
import statistics
import tempfile
import time
from pathlib import Path

from bench.cases import PILES
from warpmag import Simulation
from warpmag.scenes_usd import balls_up

_FRAMES = {"cpu": 20, "cuda": 600}
"""Default number of frames of a run, at 60 per second."""
_PAIRS = 3
"""Number of runs with output, and of runs without."""
_SETTLED = 10
"""Frames after which the memory of a run without output stays constant; a run has at least one more."""


def run_writing(count: int, device, frames: int | None = None) -> dict:
    """Run Balls Up with ``count`` balls in turns with and without output, after two short runs that are not timed."""
    frames = max(frames or _FRAMES["cpu" if device.is_cpu else "cuda"], _SETTLED + 1)
    walls: dict[bool, list[float]] = {True: [], False: []}
    growth = []
    with tempfile.TemporaryDirectory() as folder:
        stage, output = Path(folder) / "pile.usdc", Path(folder) / "out.usda"
        balls_up.author(stage, conductivity=0.0, **PILES[count])
        for writes in (True, False):
            _run(stage, device, 2, output if writes else None)
        for writes in (True, False) * _PAIRS:
            seconds, memory = _run(stage, device, frames, output if writes else None)
            walls[writes].append(seconds)
            if writes:
                growth.append(1000.0 * (memory[-1] - memory[_SETTLED]) / (frames - _SETTLED))
    written, plain = (statistics.median(walls[writes]) for writes in (True, False))
    return {
        "frames": frames,
        "seconds": written,
        "seconds_without": plain,
        "share_percent": 100.0 * (written - plain) / written,
        "runs": walls[True],
        "runs_without": walls[False],
        "growth_mb_per_1000_frames": statistics.median(growth),
    }


def _run(stage: Path, device, frames: int, output: Path | None) -> tuple[float, list[float]]:
    """Return the seconds of a run, including opening and closing its files, and the memory after each frame [MB]."""
    memory = []
    simulation = Simulation(stage, device=str(device))
    began = time.perf_counter()
    simulation.run(frames, output=output, on_frame=lambda _: memory.append(resident()))
    return time.perf_counter() - began, memory


def resident() -> float:
    """Return the resident memory of this process [MB], from /proc."""
    return 1e-6 * os.sysconf("SC_PAGE_SIZE") * int(Path("/proc/self/statm").read_text().split()[1])
