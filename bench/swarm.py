"""What very many balls of one instancer take: from the stage to the first step, and to be written in frames."""

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
"""Frames a second [Hz]."""
_POSES = 8
"""States of the balls that the frames show in turn."""


def run_swarm(count: int, device, frames: int | None = None) -> dict:
    """Read, build and step Sakura Tree with ``count`` balls once, then write balls that are moved without physics.

    Memory is what the process has of the machine beyond what it had when the first step was done, and at most.
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
            "file_mb": 1e-6 * sum(one.stat().st_size for one in Path(folder).glob("out*")),
        }


def _write(simulation: Simulation, output: Path, frames: int) -> tuple[float, list[float]]:
    """Write frames of moving balls; return the seconds that took, and the memory after each frame [MB]."""
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
    """Return the most memory that this process has had of the machine [MB]."""
    return 1e-3 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
