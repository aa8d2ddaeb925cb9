"""Runs of the bundled scenes by one method or another, each in a process of its own.

On a CPU each process is pinned to two cores, and as many run at once as there are pairs of cores; on a GPU they run one
after the other, or several at once where nobody looks at the time.
"""

import multiprocessing
import os
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass

import warpmag
from warpmag.errors import SimulationError
from warpmag.magnets import METHODS
from warpmag.scenes_usd import bundled

SCENES = ("balls_up", "alphabets", "falling_magnet", "sakura_tree")
"""The paper's dynamic scenes."""
_CORES = 2
"""Cores of a trial on a CPU."""


@dataclass(frozen=True)
class Trial:
    """One run.

    Attributes:
        scene: Name of a bundled scene.
        method: Name of a published method, of :data:`warpmag.magnets.METHODS`.
        seconds: Simulated time [s].
        device: Name of the Warp device.
        patience: Time after which the run is ended [s].
        rtol: Magnetization error at which induction ends.
        force: Force law in place of the method's own.
    """

    scene: str
    method: str
    seconds: float
    device: str
    patience: float
    rtol: float = 1e-3
    force: str | None = None


def run_trials(trials: Sequence[Trial], workers: int = 1) -> Iterator[tuple[Trial, dict]]:
    """Run trials and yield each with its outcome, in their order.

    Args:
        trials: What to run, all on one device.
        workers: How many at once on a GPU.
    """
    cores = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []
    if trials and trials[0].device == "cpu":
        workers = max(1, len(cores) // _CORES)
    context = multiprocessing.get_context("spawn")
    shares = context.Queue()
    for worker in range(workers):
        shares.put(cores[_CORES * worker : _CORES * (worker + 1)] if trials[0].device == "cpu" else cores)
    with ProcessPoolExecutor(workers, mp_context=context, initializer=_pin, initargs=(shares,)) as pool:
        yield from zip(trials, pool.map(run_trial, trials), strict=True)


def _pin(shares) -> None:
    share = shares.get()
    if share:
        os.sched_setaffinity(0, share)


def run_trial(trial: Trial) -> dict:
    """Run a trial and return what became of the scene, ready for a JSON line."""
    method = METHODS[trial.method]
    simulation = warpmag.Simulation(
        bundled()[trial.scene],
        dynamics=method.dynamics,
        curve=method.curve,
        force=trial.force or method.force,
        rtol=trial.rtol,
        device=trial.device,
    )
    simulation.step()  # compiles what was not compiled before
    ended, began = "", time.perf_counter()
    frames = max(1, round(trial.seconds * simulation.frame_rate))
    try:
        simulation.run(frames, on_frame=lambda frame: time.perf_counter() - began < trial.patience)
    except SimulationError as error:
        ended = str(error)
    figures = simulation.finish()
    induction, force, rigid = figures.milliseconds
    done = max(figures.steps, 1)
    return {
        **asdict(trial),
        "simulated": simulation.time,
        "ended": ended,
        "substeps": figures.substeps / done,
        "ti_ms": induction,
        "tf_ms": force,
        "tr_ms": rigid,
        "evaluations_per_substep": sum(figures.evaluations) / max(figures.substeps, 1),
        "unconverged": figures.unconverged / max(figures.substeps, 1),
        "magnets": figures.magnets,
        "held": figures.held,
        "held_rms_speed": figures.held_rms_speed,
        "rms_speed": figures.rms_speed,
        "peak_speed": figures.peak_speed,
        "overlap": figures.overlap,
        "farthest": figures.farthest,
    }


def outcome_head() -> list[str]:
    """Column heads of :func:`outcome_cells`."""
    head = ["substeps per step", "field evaluations per substep", "substeps not converged", "held"]
    return [*head, "RMS speed of these [cm/s]", "of all [cm/s]", "peak [m/s]", "farthest [m]", "penetration", "end"]


def outcome_cells(values: dict) -> list[str]:
    """What became of a scene, as cells of a table."""
    return [
        f"{values['substeps']:.1f}",
        f"{values['evaluations_per_substep']:.1f}",
        f"{100.0 * values['unconverged']:.0f} %",
        f"{values['held']} of {values['magnets']}" if values["held"] else "",
        f"{100.0 * values['held_rms_speed']:.2f}" if values["held"] else "",
        f"{100.0 * values['rms_speed']:.2f}",
        f"{values['peak_speed']:.2f}",
        f"{values['farthest']:.3f}",
        f"{100.0 * values['overlap']:.1f} %",
        values["ended"] or f"{values['simulated']:.2f} s",
    ]
