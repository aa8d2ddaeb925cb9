"""Cost of very many balls of one PointInstancer: time from stage to first step, and time to write frames."""

import resource
import tempfile
import time
from pathlib import Path

import numpy as np
import warp as wp

from bench.writing import resident
from warpmag import Simulation
from warpmag.engine.stepping.recording import Recorder
from warpmag.scenes_usd import sakura_tree

_FRAMES = 240
_RATE = 60.0
"""Frames per second [Hz]."""
_POSES = 8
"""Number of states of the balls, which the frames show in turn."""


def run_swarm(count: int, device, frames: int | None = None) -> dict:
    """Read, build and step Sakura Tree with ``count`` balls once, then write balls that move without physics.

    ``growth_mb`` is the growth of resident memory after the first step, the larger of current and peak values.
    """
    frames = frames or _FRAMES
    with tempfile.TemporaryDirectory() as folder:
        stage, output = Path(folder) / "many.usdc", Path(folder) / "out.usda"
        sakura_tree.author(stage, balls=count)
        began, spent = time.perf_counter(), time.process_time()
        simulation = Simulation(stage, device=str(device))
        built, spent = time.perf_counter() - began, time.process_time() - spent
        simulation.step()
        wp.synchronize_device(device)
        first = time.perf_counter() - began
        before, peak = resident(), _peak()
        spent_before = time.process_time()
        seconds, memory = _write(simulation, output, frames)
        writing = time.process_time() - spent_before
        return {
            "built_seconds": built,
            "built_cpu_seconds": spent,
            "first_step_seconds": first,
            "frames": frames,
            "seconds": seconds,
            "cpu_seconds": writing,
            "growth_mb": max(max(memory) - before, _peak() - peak),
            "file_mb": 1e-6 * sum(file.stat().st_size for file in Path(folder).glob("out*")),
        }


def _write(simulation: Simulation, output: Path, frames: int) -> tuple[float, list[float]]:
    """Write frames of moving balls; return the seconds taken, and the memory after each frame [MB]."""
    rng, memory, seconds = np.random.default_rng(0), [], -time.perf_counter()
    recorder: Recorder = simulation._open_recorder(output, False, frames)
    seconds += time.perf_counter()
    state = simulation.state
    start = state.body_q.numpy().copy()
    poses = [(start + rng.normal(0.0, 1e-3, start.shape)).astype(np.float32) for _ in range(_POSES)]
    for frame in range(1, frames + 1):
        state.body_q.assign(poses[frame % _POSES])
        seconds -= time.perf_counter()
        recorder.add_frame(frame / _RATE, state)
        seconds += time.perf_counter()
        memory.append(resident())
    seconds -= time.perf_counter()
    recorder.close(True)
    return seconds + time.perf_counter(), memory


def _peak() -> float:
    """Return the peak resident memory of this process [MB]."""
    return 1e-3 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
