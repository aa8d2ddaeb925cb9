"""Advances a model by the step that the user asked for, in as many substeps as its motion needs.

A substep is: clear forces, induction, magnetic forces, collision, solver. Each of these stages is captured once in a
graph, on the CPU too, where replaying it is three times as fast as launching it from Python.

A step is tried and then judged by what the device reports about it: if a body would have moved too far in a substep, if
bodies were pressed into each other, or if a buffer overflowed, the state is put back and the step done again with
shorter substeps or larger buffers.
"""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass

import newton
import numpy as np
import warp as wp

from warpmag.engine.contacts import BodySizes, RigidSolver
from warpmag.engine.magnetics import Magnetics
from warpmag.errors import SimulationError
from warpmag.kernels import monitor

TRAVEL_LIMIT = 0.25
"""How far a body may move in a substep, in parts of its thickness, by its velocity and the forces on it."""
OVERLAP_LIMIT = 0.008
"""How deep a step may newly press one body into another, in parts of the thickness of the thinner one."""
_SHORTEST = 16
"""Substeps are at most this many times shorter than the longest allowed."""
_EASE = 0.2
"""Substeps double in length once the motion, up to four times as long then, would stay well within the limit."""
_EVENTS_EVERY = 8
"""On a GPU every so manieth step is timed."""
_NO_BODY = np.iinfo(np.int32).max

INDUCTION, FORCE, RIGID = "induction", "force", "rigid"


@dataclass(frozen=True)
class StepReport:
    """What happened in one step.

    Attributes:
        substeps: Substeps that the step was done in.
        attempts: How often it was done, 1 if the first attempt held.
        capped: Whether a body moved farther in a substep than allowed, with the shortest substeps there are.
        regrown: Whether buffers had to grow.
        travel: Farthest predicted motion in a substep over the thickness of the body.
        speed: Highest speed of a body [m/s].
        overlap: Deepest penetration over the thickness of the thinner body.
        depth: Deepest penetration [m].
        error: Largest magnetization error of a substep.
        evaluations: Field evaluations of all substeps.
        unconverged: Substeps whose induction did not converge.
        seconds: Time spent in each stage [s]; None where it was not taken, or not worth it, because kernels were
            compiled or captured.
    """

    substeps: int
    attempts: int
    capped: bool
    regrown: bool
    travel: float
    speed: float
    overlap: float
    depth: float
    error: float
    evaluations: int
    unconverged: int
    seconds: dict[str, float] | None


class Stepper:
    """Steps one model with its magnets.

    Attributes:
        state: The present state.
        substeps: Substeps of the next step.
    """

    def __init__(
        self,
        model: newton.Model,
        magnetics: Magnetics,
        solver: RigidSolver,
        sizes: BodySizes,
        *,
        step: float,
        longest_substep: float,
        graphs: bool = True,
    ):
        """Prepare to step.

        Args:
            model: The model.
            magnetics: Its magnets.
            solver: Its collision and solver.
            sizes: Sizes of its bodies.
            step: Time step [s].
            longest_substep: Upper limit of a substep [s].
            graphs: Capture the stages in graphs where the device and the solver allow it.
        """
        self._model, self._magnetics, self._solver = model, magnetics, solver
        self._device = wp.get_device(model.device)
        self._step = step
        # An even number, so that a step ends in the state that it began in; powers of two, so that few graphs do.
        self._fewest = 2 ** max(1, math.ceil(math.log2(step / longest_substep) - 1e-9))
        self.substeps = self._fewest
        self.state, self._other, self._saved = model.state(), model.state(), model.state()
        self._thickness = wp.array(sizes.thickness, dtype=float, device=self._device)
        self._reach = wp.array(sizes.reach, dtype=float, device=self._device)
        self._peaks = wp.zeros(monitor.PEAKS, dtype=float, device=self._device)
        self._count_start()
        self._graphs: dict[tuple, wp.Graph | None] = {}
        self._capture = graphs
        self._settled = False
        self._steps = 0
        self._overlap = 0.0

    def _count_start(self) -> None:
        counts = np.zeros(monitor.COUNT_CAPACITIES + len(self._solver.buffers), dtype=np.int32)
        counts[monitor.COUNT_BAD_BODY] = _NO_BODY
        self._no_counts = wp.array(counts, dtype=wp.int32, device=self._device)
        self._counts = wp.clone(self._no_counts)

    def advance(self) -> StepReport:
        """Advance :attr:`state` by one step.

        Raises:
            SimulationError: The state is not finite any more.
        """
        timed = self._device.is_cpu or self._steps % _EVENTS_EVERY == 0
        watch = _Stopwatch(self._device) if timed else None
        self._saved.assign(self.state)
        self._settled = True
        attempts, regrown = 0, False
        while True:
            attempts += 1
            peaks, counts = self._attempt(watch)
            travel, bad = float(peaks[monitor.PEAK_TRAVEL]), counts[monitor.COUNT_BAD_BODY] != _NO_BODY
            pressed = peaks[monitor.PEAK_OVERLAP] > max(OVERLAP_LIMIT, self._overlap)
            if self._solver.grow(counts[monitor.COUNT_CAPACITIES :]):
                regrown = True
                self._count_start()
                self._graphs = {}
            elif (travel > TRAVEL_LIMIT or pressed or bad) and self.substeps < _SHORTEST * self._fewest:
                self.substeps *= 2
            else:
                break
            self.state.assign(self._saved)
        if bad:
            body = int(counts[monitor.COUNT_BAD_BODY])
            raise SimulationError(
                f"step {self._steps + 1} ({(self._steps + 1) * self._step:g} s): "
                f"{self._model.body_label[body]} has left all finite numbers"
            )
        report = self._report(attempts, regrown, peaks, counts, watch.seconds() if watch and self._settled else None)
        self._steps += 1
        self._overlap = report.overlap
        calm = travel < _EASE * TRAVEL_LIMIT and report.overlap < 0.5 * OVERLAP_LIMIT
        if calm and self.substeps > self._fewest:
            self.substeps //= 2
        return report

    def _report(self, attempts, regrown, peaks, counts, seconds) -> StepReport:
        return StepReport(
            substeps=self.substeps,
            attempts=attempts,
            capped=bool(peaks[monitor.PEAK_TRAVEL] > TRAVEL_LIMIT),
            regrown=regrown,
            travel=float(peaks[monitor.PEAK_TRAVEL]),
            speed=float(peaks[monitor.PEAK_SPEED]),
            overlap=float(peaks[monitor.PEAK_OVERLAP]),
            depth=float(peaks[monitor.PEAK_DEPTH]),
            error=float(peaks[monitor.PEAK_ERROR]),
            evaluations=int(counts[monitor.COUNT_EVALUATIONS]),
            unconverged=int(counts[monitor.COUNT_UNCONVERGED]),
            seconds=seconds,
        )

    def _attempt(self, watch) -> tuple[np.ndarray, np.ndarray]:
        """Do one step from :attr:`state` and return what the device reports about it."""
        self._clear()
        now, then = self.state, self._other
        for parity in range(self.substeps):
            odd = parity % 2
            for stage, key, run in (
                (INDUCTION, (odd,), self._induce),
                (FORCE, (odd,), self._add_forces),
                (RIGID, (odd, self.substeps), self._move),
            ):
                if watch:
                    watch.start(stage)
                self._run((stage, *key), run, now, then)
                if watch:
                    watch.stop()
            now, then = then, now
        if watch:
            watch.start(RIGID)
        self._run(("end", self.substeps), self._look, now, then)
        if watch:
            watch.stop()
        return self._peaks.numpy().copy(), self._counts.numpy().copy()

    def _clear(self) -> None:
        self._peaks.zero_()
        wp.copy(self._counts, self._no_counts)

    def _induce(self, now, then) -> None:
        now.clear_forces()
        self._magnetics.induce(now)
        system = self._magnetics.system
        monitor.watch_induction(system.error, system.evaluations, system.converged, self._peaks, self._counts)

    def _add_forces(self, now, then) -> None:
        self._magnetics.add_forces(now)

    def _move(self, now, then) -> None:
        dt = self._step / self.substeps
        monitor.watch_motion(self._model, now, self._thickness, self._reach, dt, self._peaks)
        self._find_contacts(now, dt, 0.0)
        self._solver.step(now, then, dt)

    def _look(self, now, then) -> None:
        self._find_contacts(now, self._step / self.substeps, 0.0)
        monitor.watch_finite(now, self._counts)

    def _find_contacts(self, state, dt, overlap_threshold) -> None:
        solver = self._solver
        solver.collide(state, dt)
        solver.watch(monitor.COUNT_CAPACITIES, self._counts)
        monitor.watch_contacts(
            self._model,
            state,
            solver.contacts,
            self._thickness,
            overlap_threshold,
            solver.overlaps,
            self._peaks,
            self._counts,
        )

    def measure_contacts(self, overlap_threshold: float) -> tuple[float, float, int]:
        """Find the contacts of the present state.

        Returns:
            Deepest penetration over the thickness of the thinner body, the same [m], and the number of contacts deeper
            than ``overlap_threshold`` of the thickness.
        """
        while True:
            self._clear()
            self._find_contacts(self.state, 0.0, overlap_threshold)
            peaks, counts = self._peaks.numpy(), self._counts.numpy()
            if not self._solver.grow(counts[monitor.COUNT_CAPACITIES :]):
                break
            self._count_start()
            self._graphs = {}
        self._overlap = float(peaks[monitor.PEAK_OVERLAP])
        return self._overlap, float(peaks[monitor.PEAK_DEPTH]), int(counts[monitor.COUNT_OVERLAPS])

    def _run(self, key: tuple, stage: Callable, now: newton.State, then: newton.State) -> None:
        """Run a stage: launched from Python the first time, which compiles its kernels, then captured and replayed."""
        if key not in self._graphs:
            self._graphs[key] = None
            self._settled = False
        elif self._graphs[key] is None and self._capture:
            self._settled = False
            try:
                with wp.ScopedCapture(self._device) as capture:
                    stage(now, then)
                self._graphs[key] = capture.graph
            except Exception:  # whatever a solver does that cannot be captured, it can still be launched
                self._capture = False
        if self._graphs[key] is None:
            stage(now, then)
        else:
            wp.capture_launch(self._graphs[key])


class _Stopwatch:
    """Adds up the time spent in stages: by the clock on the CPU, by events on a GPU."""

    def __init__(self, device):
        self._device = device
        self._laps: list[tuple] = []

    def _now(self):
        if self._device.is_cpu:
            return time.perf_counter()
        return self._device.stream.record_event(wp.Event(self._device, enable_timing=True))

    def start(self, stage: str) -> None:
        self._stage, self._begin = stage, self._now()

    def stop(self) -> None:
        self._laps.append((self._stage, self._begin, self._now()))

    def seconds(self) -> dict[str, float]:
        totals: dict[str, float] = dict.fromkeys((INDUCTION, FORCE, RIGID), 0.0)
        for stage, begin, end in self._laps:
            lap = end - begin if self._device.is_cpu else 1e-3 * wp.get_event_elapsed_time(begin, end)
            totals[stage] += lap
        return totals
