"""Runs of the bundled scenes by published methods, each in its own process.

On a CPU each process is pinned to two cores, and one process runs per pair of cores. On a GPU they run one after the
other, or several at once if their times are not reported.
"""

import multiprocessing
import os
import tempfile
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, field
from importlib import import_module
from pathlib import Path
from unittest import mock

import warpmag
from warpmag.declarations.magnets import PRESETS
from warpmag.errors import SimulationError
from warpmag.moments import dynamics
from warpmag.scenes_usd import bundled

SCENES = ("balls_up", "alphabets", "falling_magnet", "sakura_tree")  # the paper's dynamic scenes
_CORES = 2  # cores of a trial on a CPU
_AS_PUBLISHED = {"balls_up": {"conductivity": 0.0}}  # parameters that remove features beyond the paper's method
_FIGURES = "magnets held held_rms_speed held_median_speed rms_speed peak_speed overlap farthest".split()
"""Statistics of a run that are reported."""
_CURVES = {"tanh": "tanh-applied"}  # the paper's Eq. 10 for the letters of every method


@dataclass(frozen=True)
class Trial:
    """One run."""

    scene: str  # name of a bundled scene
    method: str  # name of a published method, of :data:`warpmag.declarations.magnets.PRESETS`
    seconds: float  # simulated time [s]
    device: str  # name of the Warp device
    time_limit: float  # wall time after which the run is ended [s], without the first step
    rtol: float = 1e-3  # magnetization error at which induction ends
    max_evaluations: int = 1000  # largest number of field evaluations of an induction
    pair_step: float = dynamics.STEP  # step κ of pairs of submagnetizations, see ``warpmag.moments.dynamics``
    force: str | None = None  # force law in place of the method's own; None keeps it
    parameters: dict = field(default_factory=dict)  # parameters of the scene's script that differ from its defaults


def run_trials(trials: Sequence[Trial], workers: int = 1) -> Iterator[tuple[Trial, dict]]:
    """Run trials on one device, ``workers`` at once on a GPU; yield each with its outcome, in their order."""
    cores = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []
    if trials and trials[0].device == "cpu":
        workers = max(1, len(cores) // _CORES)
    context = multiprocessing.get_context("spawn")
    queue = context.Queue()
    for worker in range(workers):
        queue.put(cores[_CORES * worker : _CORES * (worker + 1)] if trials[0].device == "cpu" else cores)
    with ProcessPoolExecutor(workers, mp_context=context, initializer=_pin, initargs=(queue,)) as pool:
        yield from zip(trials, pool.map(run_trial, trials), strict=True)


def _pin(queue) -> None:
    """Pin this process to the next cores of the queue."""
    if cores := queue.get():
        os.sched_setaffinity(0, cores)


def run_trial(trial: Trial) -> dict:
    """Run a trial and return the values of its JSON line."""
    with tempfile.TemporaryDirectory() as folder:
        simulation = _load(trial, Path(folder))
    simulation.frame_rate = 1.0 / simulation.step_size  # checks the time limit after every step
    simulation.run(1)  # compiles kernels, grows buffers and captures graphs
    ended, began = "", time.perf_counter()
    steps = max(1, round(trial.seconds / simulation.step_size))
    try:
        simulation.run(steps, on_frame=lambda frame: time.perf_counter() - began < trial.time_limit)
    except SimulationError as error:
        ended = str(error)
    statistics = simulation.finish()
    induction, force, rigid = statistics.milliseconds
    done = max(statistics.steps, 1)
    return {
        **asdict(trial),
        "simulated": simulation.time,
        "ended": ended,
        "steps": statistics.steps,
        "substeps": statistics.substeps / done,
        "ti_ms": induction,
        "tf_ms": force,
        "tr_ms": rigid,
        "evaluations_per_substep": sum(statistics.evaluations) / max(statistics.substeps, 1),
        "unconverged": statistics.unconverged / max(statistics.substeps, 1),
        **{name: getattr(statistics, name) for name in _FIGURES},
    }


def _load(trial: Trial, folder: Path) -> warpmag.Simulation:
    """Load the scene of a trial, authored in ``folder`` if it differs from the bundled one."""
    stage, method = bundled()[trial.scene], PRESETS[trial.method]
    parameters = _AS_PUBLISHED.get(trial.scene, {}) | trial.parameters
    if parameters:
        stage = folder / f"{trial.scene}.usdc"
        import_module(f"warpmag.scenes_usd.{trial.scene}").author(stage, **parameters)
    settings = {"rtol": trial.rtol, "max_evaluations": trial.max_evaluations, "device": trial.device}
    settings |= {"dynamics": method.dynamics, "force": trial.force or method.force}
    settings["curve"] = _CURVES.get(method.curve, method.curve)
    with mock.patch.object(dynamics, "STEP", trial.pair_step):  # scenes have no attribute for it
        return warpmag.Simulation(stage, **settings)


def outcome_cells(values: dict) -> dict[str, str]:
    """Outcome of a scene as cells of a table, by the heads of their columns."""
    held = values["held"]
    return {
        "substeps per step": f"{values['substeps']:.1f}",
        "field evaluations per substep": f"{values['evaluations_per_substep']:.1f}",
        "unconverged solves per substep": f"{100.0 * values['unconverged']:.0f} %",
        "held": f"{held} of {values['magnets']}" if held else "",
        "RMS speed of held [cm/s]": f"{100.0 * values['held_rms_speed']:.2f}" if held else "",
        "median speed of held [cm/s]": f"{100.0 * values['held_median_speed']:.2f}" if held else "",
        "RMS speed of all [cm/s]": f"{100.0 * values['rms_speed']:.2f}",
        "highest speed [m/s]": f"{values['peak_speed']:.2f}",
        "farthest [m]": f"{values['farthest']:.3f}",
        "deepest overlap": f"{100.0 * values['overlap']:.1f} %",
        "end": values["ended"] or f"{values['simulated']:.2f} s",
    }
