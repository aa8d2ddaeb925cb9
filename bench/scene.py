"""Times of the steps of a running scene on the device and on the host, and their statistics."""

import contextlib
import copy
import re
import tempfile
import time
from pathlib import Path

import numpy as np
import warp as wp

from bench.cases import PILES
from bench.timing import measure
from warpmag import Simulation
from warpmag.engine.pile_xpbd.capture import without_allocations
from warpmag.scenes_usd import balls_up, bundled

_SETTLING, _STEPS = 32, 60  # steps before the measurement, in which the balls start to move, and measured steps
_AHEAD = 10  # steps that the host may be ahead of the device: with more than about 20 graphs a GPU blocks the host


def run_scene(count: int, device) -> dict:
    """Run Balls Up with ``count`` balls and measure its steps."""
    began = time.perf_counter()
    simulation = _balls_up(device, **PILES[count])
    simulation.step()
    wp.synchronize_device(device)
    first = time.perf_counter() - began
    for _ in range(_SETTLING - 1):
        simulation.step()
    reports = []
    with wp.ScopedMemoryTracker("steps", report_func=reports.append) as tracker:
        tracker.clear()
        values, host = _measured(simulation, _STEPS, device)
    return values | {
        "magnetics_share": (values["ti_ms"] + values["tf_ms"]) / values["tr_ms"],
        "capture_failure": simulation.capture_failure,
        "host_us": 1e6 * float(np.median(host)),
        "host_us_max": 1e6 * max(host),
        "allocations": sum(int(n) for n in re.findall(r"^\s+(?:cpu|pinned|cuda:\d+)\s+(\d+) \(", reports[0], re.M)),
        "evaluations": float(np.median(simulation.statistics.evaluations[_SETTLING:])),
        "error": simulation.statistics.error,
        "unconverged": simulation.statistics.unconverged,
        "first_call_seconds": first,
    }


def run_bundled(name: str, device) -> dict:
    """Run a bundled scene for its first second, Balls Up without eddy currents, and measure the mean step."""
    simulation = _balls_up(device) if name == "balls_up" else Simulation(bundled()[name], device=str(device))
    simulation.step()
    wp.synchronize_device(device)
    return _measured(simulation, round(1.0 / simulation.step_size), device)[0]


def _balls_up(device, **parameters) -> Simulation:
    with tempfile.TemporaryDirectory() as folder:
        stage = Path(folder) / "pile.usdc"
        balls_up.author(stage, conductivity=0.0, **parameters)
        return Simulation(stage, device=str(device))


def _measured(simulation: Simulation, steps: int, device) -> tuple[dict, list[float]]:
    """Return the means of the next steps, the parts of a substep at their end, and the host's time of each step [s]."""
    before = copy.deepcopy(simulation.statistics)
    seconds, host = time_steps(simulation, steps, device)
    after = simulation.statistics
    induction, force, rigid = after.milliseconds_since(before.steps)
    return {
        "seconds": seconds,
        "ti_ms": induction,
        "tf_ms": force,
        "tr_ms": rigid,
        **parts_of_a_substep(simulation),
        "substeps": (after.substeps - before.substeps) / steps,
        "repeated": after.repeated - before.repeated,
        "evaluations": sum(after.evaluations[before.steps :]) / steps,
        "overlap": after.overlap,
    }, host


def time_steps(simulation: Simulation, steps: int, device) -> tuple[float, list[float]]:
    """Return the mean time of a step, and the host's time of each step [s]."""
    host, began = [], time.perf_counter()
    for step in range(steps):
        if step % _AHEAD == 0:
            wp.synchronize_device(device)
        called = time.perf_counter()
        simulation.step()
        host.append(time.perf_counter() - called)
    wp.synchronize_device(device)
    return (time.perf_counter() - began) / steps, host


def parts_of_a_substep(simulation: Simulation) -> dict:
    """Measure the parts of a substep of rigid bodies in the present state, each alone.

    The times [ms] are those of the broad phase (with contacts of balls), of Newton's narrow phase and of the solver.
    """
    solver, stepper, device = simulation._solver, simulation._stepper, simulation.model.device
    now, then, dt = stepper.state, stepper._other, stepper._longest
    solver.collide(now, dt)
    contacts = int(solver.contacts.rigid_contact_count.numpy()[0])
    narrow = solver._pipeline.narrow_phase

    def alone(work) -> float:
        with without_allocations(device, stepper._workspace):
            return 1e3 * measure(work, device, seconds=0.2)

    both = alone(lambda: solver.collide(now, dt))
    with contextlib.ExitStack() as restored:
        restored.callback(setattr, narrow, "launch_custom_write", narrow.launch_custom_write)
        narrow.launch_custom_write = lambda **arguments: None
        search = alone(lambda: solver.collide(now, dt))
    solver.collide(now, dt)
    return {
        "search_ms": search,
        "narrow_ms": both - search,
        "solve_ms": alone(lambda: solver.step(now, then, dt, stepper.control)),
        "contacts": contacts,
        "iterations": solver._solver._contact_iterations,
    }
