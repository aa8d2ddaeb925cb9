"""Advances a model by the user's time step, in as many substeps as its motion needs.

A substep clears the forces, solves the induction, adds magnetic forces, finds contacts and runs the rigid-body solver.
Substeps shorter than the maximum share forces: several use one evaluation.

A step is attempted and then checked. If a body moved too far in a substep, or contacts became too deep, the state is
restored and the step repeated with shorter substeps. The device makes these decisions (``kernels.rigid.stepping``), so
that a step is one graph that the host launches without waiting. The host reads the reports of several steps at once.
The device halts if a buffer overflows or the state is not finite. Later steps then do nothing, until the host enlarges
the buffer or raises an error.

Steps that cannot be captured in a graph are launched from Python by the same code.
"""

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import newton
import numpy as np
import warp as wp

from warpmag.engine.magnets.caller_checks import HeldArrays
from warpmag.engine.magnets.magnetics import Magnetics
from warpmag.engine.magnets.world_reset import WorldMask
from warpmag.engine.pile_xpbd.capture import Workspace, without_allocations
from warpmag.engine.pile_xpbd.contacts import BodySizes, RigidSolver
from warpmag.engine.stepping.keyed_values import KeyedModelValues
from warpmag.engine.stepping.state_rows import state_rows
from warpmag.errors import InputError, SimulationError
from warpmag.kernels.rigid import monitor, stepping
from warpmag.kernels.rigid.bodies import predict_poses
from warpmag.kernels.rigid.force_spans import measure_force_spans
from warpmag.kernels.rigid.newton_views import view_bodies
from warpmag.moments.arrays import PersistentArray, restore_snapshot, snapshot_views

TRAVEL_LIMIT = 0.25
"""Largest sliding along another body, or displacement by forces, in a substep, over the body's thickness; see
``kernels.rigid.monitor``."""
_SHARED_TRAVEL_LIMIT = 0.5
"""The same limit while more than two substeps share their forces, over the distance in which forces on the body vary. A
free ball then moves at most two radii."""
OVERLAP_LIMIT = 0.008
"""Largest new penetration in a step over the thickness of the thinner body."""
_GROWTH_MARGIN = 0.8
"""The substep doubles when the predicted motion stays below this fraction of the limit."""
_FUTILE_RATIO = 0.8
"""Substeps are not halved again if halving left more than this fraction of a penetration."""
_RECORDS = 64
"""Largest number of steps without :meth:`Stepper.read_reports`. On a CPU the host reads them after each step."""


@dataclass(frozen=True)
class StepReport:
    """Outcome of one step."""

    substeps: int
    attempts: int  # 1 if the first one was accepted
    capped: bool  # a body moved farther than allowed even in the shortest substep
    regrown: bool  # buffers were enlarged
    travel: float  # largest motion in a substep over the thickness of the body (``kernels.rigid.monitor``)
    speed: float  # highest speed of a body [m/s]
    overlap: float  # deepest penetration over the thickness of the thinner body
    depth: float  # deepest penetration [m]
    error: float  # largest magnetization error of a substep
    evaluations: int  # field evaluations of all substeps
    unconverged: int  # induction solves that did not converge
    seconds: tuple[float, float, float] | None  # times of induction, forces, rigid bodies [s]; None while compiling


class Stepper:
    """Steps one model with its magnets.

    Attributes:
        steps: Number of calls of :meth:`advance`.
        capture_failure: Reason why a step was not captured in a graph; empty if it was, or if that was not tried.
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
        keyed_values: KeyedModelValues | None = None,
        on_substep: Callable[[newton.State, float], object] | None = None,
    ):
        """Allocate states and the state machine, for time steps and substeps of at most ``longest_substep`` [s].

        ``graphs`` means to capture a step in a graph where the device and the solver allow it. ``on_substep`` is called
        with the state of each substep, which has its magnetic forces, and the length of the substep [s].
        """
        self._model, self._magnetics, self._solver = model, magnetics, solver
        self._on_substep = on_substep
        self._keyed_values, self._device, self._step = keyed_values, wp.get_device(model.device), step
        # an even number, so that a step ends in the same state object as it begins
        self._min_substeps = 2 ** max(1, math.ceil(math.log2(step / longest_substep) - 1e-9))
        self._longest = step / self._min_substeps
        self._state, self._other, self._saved = model.state(), model.state(), model.state()
        self._control = model.control()
        self._held = {name: HeldArrays(name, getattr(self, f"_{name}")) for name in ("state", "control")}
        self._shared = model.state()  # predicted poses, and forces that several substeps share
        self._machine = stepping.StepMachine(
            _RECORDS, len(solver.buffers), self._device, first_level_substeps=self._min_substeps,
            travel=TRAVEL_LIMIT, shared_travel=_SHARED_TRAVEL_LIMIT, overlap=OVERLAP_LIMIT,
            growth_margin=_GROWTH_MARGIN, futile_ratio=_FUTILE_RATIO,
        )  # fmt: skip
        stepped = [array.flatten() for array in magnetics.stepped_arrays() if array.size]
        self._machine.set_state_arrays(
            _arrays(self._state) + stepped, _arrays(self._saved) + [wp.clone(array) for array in stepped]
        )
        self._arrays = self._machine.arrays
        self._watched = self._machine.make_monitor(sizes.thickness, sizes.force_length, sizes.reach)
        self._magnets = magnetics.magnetic_shapes()
        self._mirrors = {name: getattr(self._arrays, name) for name in ("status", "peaks", "counts", "log")}
        if self._device.is_cuda:
            copies = {name: wp.empty_like(array, device="cpu", pinned=True) for name, array in self._mirrors.items()}
            self._mirrors = copies
        self._clock = _Clock(self._device)
        self._workspace = Workspace(self._device) if self._device.is_cuda else None
        self._capture, self._graph = graphs, None
        self.capture_failure = ""
        self._untimed: set[int] = set()
        self.steps = self._reported = 0
        if keyed_values:
            keyed_values.pose_for_contacts(self._state, 0.0, self._longest)
        self._mask, self._initial_rows = WorldMask(model), state_rows(model, self._state)
        self._prepare()

    def _prepare(self) -> None:
        """Update the sizes of the solver's buffers, and discard the graph. The number of buffers is constant."""
        self._arrays.capacities.assign(np.array([buffer.limit for buffer in self._solver.buffers], np.int32))
        self._watched.fill_counts.assign(self._solver.fills())
        self._machine.invalidate_contacts()
        self._graph, self._warm = None, False

    @property
    def state(self) -> newton.State:
        """The present state, which may be changed; call :meth:`read_reports` first."""
        self._machine.invalidate_contacts()
        return self._state

    @property
    def control(self) -> newton.Control:
        """Forces and targets of joints. Change its arrays, or assign another control, between steps."""
        return self._control

    @control.setter
    def control(self, control: newton.Control) -> None:
        self._control, self._held["control"] = control, HeldArrays("control", control)
        self._graph, self._warm = None, False

    @property
    def reports_due(self) -> bool:
        """True if :meth:`read_reports` has to be called before the next step."""
        return self.steps - self._reported >= (1 if self._device.is_cpu else _RECORDS)

    def reset(self, worlds: Any) -> None:
        """Return chosen worlds to the start, see :class:`WorldMask`; only launches kernels.

        Call :meth:`read_reports` first.
        """
        self._mask.set(worlds)
        for rows in self._initial_rows:
            rows.restore(self._mask)
        self._solver.reset(self._state, self._mask.array)
        self._magnetics.reset(self._mask.array)
        self._machine.invalidate_contacts()

    def advance(self) -> None:
        """Advance :attr:`state` by one step; does not wait for a GPU.

        Replaced arrays of the state or the control raise :class:`InputError`.
        """
        for held in self._held.values():
            held.check()
        if self.steps - self._reported >= _RECORDS:
            raise RuntimeError(f"read_reports() must be called every {_RECORDS} steps")
        self.steps += 1
        self._launch()

    def read_reports(self) -> Iterator[StepReport]:
        """Wait for all steps so far, and yield a report of each step since the last call.

        Buffers that overflowed are enlarged. A step that leads to a state that is not finite raises
        :class:`SimulationError`; the last accepted state remains.
        """
        while self.steps > self._reported:
            status = self._read("status")
            yield from self._reports_until(int(status[stepping.STATUS_DONE]))
            if status[stepping.STATUS_HALT] == stepping.NOT_FINITE:
                self._raise_not_finite()
            if self.steps > self._reported:
                assert status[stepping.STATUS_HALT] == stepping.OVERFLOW, "the device left steps undone"
                self._solver.grow(self._fills())
                self._prepare()
                self._machine.set_status(stepping.STATUS_REGROWN, 1)
                self._machine.set_status(stepping.STATUS_HALT, stepping.RUNNING)
                for _ in range(self.steps - self._reported):
                    self._launch()

    def _reports_until(self, done: int) -> list[StepReport]:
        """Return the reports of the steps since the last call, up to step ``done``."""
        self._clock.calibrate()
        log = self._read("log")
        numbers = range(self._reported, done)
        self._reported = done
        return [self._report(log[number % _RECORDS], number not in self._untimed) for number in numbers]

    def _report(self, record: np.ndarray, timed: bool) -> StepReport:
        """Return the report of a record of the device's log."""
        peaks, ticks = record[stepping.LOG_PEAKS :], record[stepping.LOG_TICKS :]
        return StepReport(
            substeps=int(record[stepping.LOG_SUBSTEPS]),
            attempts=int(record[stepping.LOG_ATTEMPTS]),
            capped=bool(record[stepping.LOG_CAPPED]),
            regrown=bool(record[stepping.LOG_REGROWN]),
            travel=float(peaks[monitor.PEAK_TRAVEL]),
            speed=float(peaks[monitor.PEAK_SPEED]),
            overlap=float(peaks[monitor.PEAK_OVERLAP]),
            depth=float(peaks[monitor.PEAK_DEPTH]),
            error=float(peaks[monitor.PEAK_ERROR]),
            evaluations=int(record[stepping.LOG_EVALUATIONS]),
            unconverged=int(record[stepping.LOG_UNCONVERGED]),
            seconds=tuple((self._clock.seconds_per_tick * ticks).tolist()) if timed else None,
        )

    def _raise_not_finite(self) -> None:
        """Raise :class:`SimulationError` for the first body with a state that is not finite."""
        body = int(self._read("counts")[monitor.COUNT_BAD_BODY]) % self._model.body_count
        self.steps, number = self._reported, self._reported + 1
        for status in (stepping.STATUS_LEVEL, stepping.STATUS_ATTEMPTS):
            self._machine.set_status(status, 0)
        self._machine.set_status(stepping.STATUS_HALT, stepping.RUNNING)  # the user may repair the state
        label = self._model.body_label[body]
        time, most = f"step {number} ({number * self._step:g} s)", monitor.HIGHEST_SPEED
        raise SimulationError(f"{time}: the state of {label} is not finite any more, or faster than {most:g} m/s")

    def _fills(self) -> np.ndarray:
        return self._read("counts")[monitor.COUNT_CAPACITIES :]

    def _read(self, name: str) -> np.ndarray:
        """Wait for the device and return one of the state machine's buffers."""
        source, mirror = getattr(self._arrays, name), self._mirrors[name]
        if mirror is not source:
            wp.copy(mirror, source)
            wp.synchronize_stream(self._device.stream)
        return mirror.numpy()

    def _launch(self) -> None:
        """Launch a step: the first from Python, which compiles its kernels, later steps as a graph if possible."""
        if self._graph:
            wp.capture_launch(self._graph)
            return
        with without_allocations(self._device, self._workspace):
            self._run_step()
            if not self._warm:
                self._warm = True
                self._untimed.add(self._reported)
                if self._capture and self._read("status")[stepping.STATUS_HALT] == stepping.RUNNING:
                    self._capture_step()

    def _capture_step(self) -> None:
        try:
            with wp.ScopedCapture(self._device) as capture:
                self._run_step()
            # the first launch instantiates the graph, or fails; while paused, it computes nothing
            self._machine.set_status(stepping.STATUS_HALT, stepping.PAUSED)
            wp.capture_launch(capture.graph)
            self._graph = capture.graph
        except Exception as error:  # such a step is launched from Python
            self._capture, self.capture_failure = False, " ".join(str(error).split()) or type(error).__name__
            _clear_capture_error(self._device)
        self._machine.set_status(stepping.STATUS_HALT, stepping.RUNNING)

    def save(self) -> dict[str, np.ndarray]:
        """Return the arrays that the next step depends on, and may overwrite; call :meth:`read_reports` first."""
        numbers = {"steps": np.array(self.steps), "buffers": self._solver.limits()}
        return numbers | snapshot_views(self._persistent_arrays())

    def load(self, saved: dict[str, np.ndarray]) -> None:
        """Continue from the arrays that :meth:`save` returned; another model's arrays raise :class:`InputError`."""
        limits, steps = saved["buffers"], saved["steps"]
        if limits.shape != self._solver.limits().shape or steps.shape or {limits.dtype.kind, steps.dtype.kind} != {"i"}:
            raise InputError("checkpoint: steps and buffers do not fit this run")
        if not ((limits >= 0) & (limits < 2**31)).all():
            raise InputError("checkpoint: buffers have sizes out of range")
        self._solver.set_limits(limits)
        self._prepare()
        restore_snapshot(self._persistent_arrays(), saved)
        self.steps = self._reported = int(steps)

    def _persistent_arrays(self) -> dict[str, PersistentArray]:
        """Return the arrays that the next step depends on, by name."""
        machine = {name: getattr(self._arrays, name) for name in ("status", "last_overlap")}
        machine["force_span"] = self._watched.force_span
        parts = {"state": dict(enumerate(_arrays(self._state))), "machine": machine}
        parts["control"] = dict(enumerate(_arrays(self._control)))
        parts |= {"magnetics": self._magnetics.persistent_arrays(), "solver": self._solver.persistent_arrays()}
        return {f"{part}.{name}": array for part, arrays in parts.items() for name, array in arrays.items()}

    def measure_contacts(self, overlap_threshold: float) -> tuple[float, float, int]:
        """Find the contacts of the present state; call :meth:`read_reports` first.

        Return the deepest penetration over the thickness of the thinner body, the deepest penetration [m], and the
        number of contacts with a ratio of penetration to thickness above ``overlap_threshold``.
        """
        while True:
            self._arrays.peaks.zero_()
            self._arrays.counts.zero_()
            self._solver.collide(self._state, 0.0)
            self._solver.watch(self._watched, self._state, substep=0, longest=0.0, threshold=overlap_threshold)
            if not self._solver.grow(self._fills()):
                break
            self._prepare()
        peaks, counts = self._read("peaks"), self._read("counts")
        self._machine.invalidate_contacts()
        depths = float(peaks[monitor.PEAK_OVERLAP]), float(peaks[monitor.PEAK_DEPTH])
        return *depths, int(counts[monitor.COUNT_OVERLAPS])

    def set_initial_overlap(self, overlap: float) -> None:
        """Set the deepest penetration at the start over the thickness; steps do not press bodies deeper."""
        self._arrays.last_overlap.assign(np.array([overlap, math.inf], np.float32))

    # The following methods only launch kernels.

    def _run_step(self) -> None:
        self._machine.begin_step()
        wp.capture_while(self._machine.attempting, self._attempt)

    def _attempt(self) -> None:
        """Run all substeps at the present level, then accept the step or restore the state."""
        machine = self._machine
        for level, remaining in enumerate(machine.remaining):
            wp.capture_while(remaining, self._advance_twice, level=level)
        self._find_first_contacts(substep=monitor.NEXT_SUBSTEP)
        machine.end_attempt()
        machine.restore()
        self._magnetics.discard_attempt(machine.rejected)

    def _advance_twice(self, level: int) -> None:
        """Run a pair of substeps of the longest length over ``2**level``."""
        machine, dt = self._machine, self._longest / (1 << level)
        if self._keyed_values:
            machine.write_time(self._step, self._longest, self._keyed_values.time)
        wp.capture_if(machine.contacts_due, self._find_first_contacts, substep=0)
        if level == 1:  # two substeps share forces
            self._share_forces(dt)
        elif level > 1:
            wp.capture_if(machine.forces_due, self._share_forces, dt=dt)
        for half, (now, then) in enumerate(((self._state, self._other), (self._other, self._state))):
            if half:
                self._find_contacts(now, dt, half)
            if level == 0:
                if self._keyed_values:
                    self._keyed_values.set_values(half * dt)
                self._magnetize(now, dt)
            else:
                wp.copy(now.body_f, self._shared.body_f)
            self._call_user(now, dt)
            self._move(now, then, half * dt, dt)
        machine.end_pair(level)

    def _call_user(self, state: newton.State, dt: float) -> None:
        """Let the user's function add forces, which limit the substep as magnetic ones do."""
        if self._on_substep:
            self._on_substep(state, dt)
            monitor.watch_forces(self._watched, view_bodies(self._model, state), self._model.gravity, self._longest)

    def _move(self, now: newton.State, then: newton.State, begin: float, dt: float) -> None:
        """Run the solver for a substep of ``dt`` [s] that begins ``begin`` [s] after its pair of substeps."""
        if self._keyed_values:
            self._keyed_values.pose_for_solver(now, begin, dt)
        self._solver.step(now, then, dt, self._control)
        if self._keyed_values:
            self._keyed_values.pose_for_contacts(then, begin + dt, self._longest)

    def _find_first_contacts(self, substep: int) -> None:
        """Find the contacts at the start of a pair of substeps.

        The search looks ahead by the longest substep, so that contacts at the end of a step also serve the next step.
        """
        self._find_contacts(self._state, self._longest, substep)

    def _find_contacts(self, state: newton.State, horizon: float, substep: int) -> None:
        self._solver.collide(state, horizon)
        self._solver.watch(self._watched, state, substep=substep, longest=self._longest, threshold=0.0)

    def _share_forces(self, dt: float) -> None:
        """Evaluate the forces that the next substeps of ``dt`` [s] share, at predicted poses."""
        predict_poses(view_bodies(self._model, self._state), self._machine.sharing, dt, self._shared.body_q)
        wp.copy(self._shared.body_qd, self._state.body_qd)
        if self._keyed_values:
            self._keyed_values.set_values(0.0, shared=self._machine.sharing, substep=dt)
        self._magnetize(self._shared, dt, sharing=self._machine.sharing)

    def _magnetize(self, state: newton.State, dt: float, *, sharing: wp.array | None = None) -> None:
        """Solve the induction and write the magnetic forces at ``state``, for one or the shared substeps of ``dt``."""
        magnetics = self._magnetics
        state.clear_forces()
        magnetics.induce(state, dt, sharing=sharing)
        monitor.watch_induction(self._watched, magnetics.error, magnetics.evaluations, magnetics.converged)
        magnetics.add_forces(state)
        bodies = view_bodies(self._model, state)
        measure_force_spans(self._watched, bodies, self._magnets, self._longest)
        monitor.watch_forces(self._watched, bodies, self._model.gravity, self._longest)


def _clear_capture_error(device) -> None:
    """Sort a dummy array: after a failed capture the first sort on a GPU has no effect."""
    if device.is_cuda:
        keys = wp.zeros(2, dtype=wp.int32, device=device)
        wp.utils.radix_sort_pairs(keys, wp.zeros_like(keys), 1)


def _arrays(state: newton.State | newton.Control) -> list[wp.array]:
    """Return the arrays of a state or a control, flattened, without forces, which each substep clears."""
    arrays = []
    for name, value in vars(state).items():
        if isinstance(value, newton.Model.AttributeNamespace):
            arrays += _arrays(value)
        elif isinstance(value, wp.array) and value.size and name not in ("body_f", "particle_f"):
            arrays.append(value.flatten())
    return arrays


class _Clock:
    """Clock of a device. :meth:`calibrate` sets the duration ``seconds_per_tick`` of its tick."""

    def __init__(self, device):
        self._time = wp.zeros(1, dtype=wp.uint64, device=device)
        self._fixed = device.is_cuda
        self.seconds_per_tick = 1e-9
        self._began = (0, 0.0) if self._fixed else self._read()

    def _read(self) -> tuple[int, float]:
        stepping.launch_read_clock(self._time)
        return int(self._time.numpy()[0]), time.perf_counter()

    def calibrate(self) -> None:
        """Compare the device's clock with the host's. The clock of a GPU counts nanoseconds."""
        if not self._fixed:
            ticks, seconds = np.subtract(self._read(), self._began)
            self.seconds_per_tick = float(seconds / ticks)
