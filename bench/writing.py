"""Cost of writing: runs with and without output in turns, and frames of very many balls of one PointInstancer."""

import os
import resource
import statistics
import tempfile
import time
from pathlib import Path

import numpy as np
import warp as wp

from bench.cases import PILES
from warpmag import Simulation
from warpmag.engine.stepping.recording import Recorder
from warpmag.scenes_usd import balls_up, sakura_tree

_FRAMES = {"cpu": 20, "cuda": 600}  # default number of frames of a run, at 60 per second
_PAIRS = 3  # number of runs with output, and of runs without
_SETTLED = 10
"""Frames after which the memory of a run without output stays constant; a run has at least one more."""
_SWARM_FRAMES, _RATE = 240, 60.0  # default number of frames of a swarm, and frames per second [Hz]
_STATES = 8  # number of states of a swarm, which the frames show in turn


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
    simulation.run(frames, output=output, on_frame=lambda _: memory.append(_resident()))
    return time.perf_counter() - began, memory


def run_swarm(count: int, device, frames: int | None = None) -> dict:
    """Read, build and step Sakura Tree with ``count`` balls once, then write balls that move without physics.

    ``growth_mb`` is the growth of resident memory after the first step, the larger of current and peak values.
    """
    frames = frames or _SWARM_FRAMES
    with tempfile.TemporaryDirectory() as folder:
        stage, output = Path(folder) / "many.usdc", Path(folder) / "out.usda"
        sakura_tree.author(stage, balls=count)
        began, began_cpu = time.perf_counter(), time.process_time()
        simulation = Simulation(stage, device=str(device))
        built, built_cpu = time.perf_counter() - began, time.process_time() - began_cpu
        simulation.step()
        wp.synchronize_device(device)
        first = time.perf_counter() - began
        before, peak = _resident(), _peak()
        began_cpu = time.process_time()
        seconds, memory = _write_swarm(simulation, output, frames)
        return {
            "built_seconds": built,
            "built_cpu_seconds": built_cpu,
            "first_step_seconds": first,
            "frames": frames,
            "seconds": seconds,
            "cpu_seconds": time.process_time() - began_cpu,
            "growth_mb": max(max(memory) - before, _peak() - peak),
            "file_mb": 1e-6 * sum(file.stat().st_size for file in Path(folder).glob("out*")),
        }


def _write_swarm(simulation: Simulation, output: Path, frames: int) -> tuple[float, list[float]]:
    """Write frames of moving balls; return the time of writing [s], and the memory after each frame [MB]."""
    rng, memory, seconds = np.random.default_rng(0), [], -time.perf_counter()
    recorder: Recorder = simulation._open_recorder(output, False, frames)
    seconds += time.perf_counter()
    state = simulation.state
    start = state.body_q.numpy().copy()
    poses = [(start + rng.normal(0.0, 1e-3, start.shape)).astype(np.float32) for _ in range(_STATES)]
    for frame in range(1, frames + 1):
        state.body_q.assign(poses[frame % _STATES])
        seconds -= time.perf_counter()
        recorder.add_frame(frame / _RATE, state)
        seconds += time.perf_counter()
        memory.append(_resident())
    seconds -= time.perf_counter()
    recorder.close(True)
    return seconds + time.perf_counter(), memory


def _resident() -> float:
    """Return the resident memory of this process [MB], from /proc."""
    return 1e-6 * os.sysconf("SC_PAGE_SIZE") * int(Path("/proc/self/statm").read_text().split()[1])


def _peak() -> float:
    """Return the peak resident memory of this process [MB]."""
    return 1e-3 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
