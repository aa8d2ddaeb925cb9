"""Simulates a scene with magnets, from a USD stage or a Newton builder."""

import math
import os
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import newton
import numpy as np
import warp as wp

from warpmag.declarations.checks import check_count, check_flag, check_positive, short_repr
from warpmag.declarations.magnets import MagneticSettings
from warpmag.deprecation import renamed_arguments
from warpmag.engine.magnets.caller_checks import check_control
from warpmag.engine.magnets.magnetics import Magnetics
from warpmag.engine.magnets.shape_moments import check_start
from warpmag.engine.magnets.workload import moments_line
from warpmag.engine.pile_xpbd.contacts import RigidSolver, body_sizes
from warpmag.engine.pile_xpbd.solvers import SOLVERS, check_solver
from warpmag.engine.stepping.failure_cause import failure_cause
from warpmag.engine.stepping.frame_run import run_frames
from warpmag.engine.stepping.held_bodies import held_bodies
from warpmag.engine.stepping.keyed_values import KeyedModelValues
from warpmag.engine.stepping.model_checks import joint_gap_warnings, joint_gaps
from warpmag.engine.stepping.solver_model import position_coarseness, solver_model
from warpmag.engine.stepping.statistics import Statistics
from warpmag.engine.stepping.stepper import Stepper
from warpmag.errors import InputError, SimulationError, warn_caller
from warpmag.moments.arrays import resolve_device
from warpmag.moments.ranks import current_ranks, errors_on_all_ranks
from warpmag.terminal import collection_paused

DEFAULT_STEP = 1e-3
"""Default time step [s], the paper's."""
LONGEST_SUBSTEP = 5e-4
"""Upper limit of a substep [s]. With it and XPBD's 60 iterations piles of 5 mm balls come to rest."""
_OVERLAP = 1e-4
"""Ratio of the initial overlap to the thickness above which a warning is issued."""
_FRAME_RATE = 60.0
"""Output frame rate of a builder [Hz]."""


class Simulation:
    """A simulation of a scene with magnets::

        simulation = warpmag.Simulation("balls_up.usda")
        statistics = simulation.run(60, output="out.usda")

    A program may also call :meth:`step` itself. The scene is a USD file or a ``newton.ModelBuilder``::

        simulation = warpmag.Simulation(builder, dt=1e-3)
        for _ in range(1000):
            simulation.step()
        poses = simulation.state.body_q.numpy()

    Attributes:
        model: Newton's model.
        step_size: Time step [s].
        frame_rate: Output frames per second [Hz].
        frame_count: Output frames of the stage after the first; None if it has no time range.

    Example:
        >>> import newton
        >>> import warpmag
        >>> builder = newton.ModelBuilder()
        >>> warpmag.register_custom_attributes(builder)
        >>> ball = builder.add_body()
        >>> shape = builder.add_shape_sphere(ball, radius=0.005)
        >>> marked = warpmag.add_inducible(builder, body=ball, material="iron")
        >>> simulation = warpmag.Simulation(builder, dt=1e-3, device="cpu")
        >>> simulation.step()
        >>> round(simulation.time, 6)  # s
        0.001
    """

    @renamed_arguments(step="dt")
    @collection_paused()
    def __init__(
        self,
        scene: str | os.PathLike | newton.ModelBuilder,
        *,
        dt: float | None = None,
        solver: str = "xpbd",
        force: str | None = None,
        dynamics: str | None = None,
        contact_model: str | None = None,
        method: str = "auto",
        rtol: float | None = None,
        max_evaluations: int = 1000,
        external_field: tuple[float, float, float] | None = None,
        curve: str | None = None,
        device: str | None = None,
        graphs: bool | None = None,
        visuals: bool = False,
        on_substep: Callable[[newton.State, float], object] | None = None,
    ):
        """Import the scene and prepare the first step.

        Args:
            scene: USD file, or a builder with magnets. The builder is modified: it gets the articulations and the graph
                coloring that ``solver`` needs.
            dt: Time step [s]; by default the stage's, else 1 ms. Fast motion splits it into substeps.
            solver: Rigid-body solver: ``xpbd``, Newton's XPBD adapted to many bodies in contact, or one of Newton's:
                ``steel``, ``mujoco``, ``semi-implicit``, ``featherstone``, ``kamino`` or ``vbd``.
            force: ``kelvin`` or ``zeeman``; by default the stage's, else ``kelvin``.
            dynamics: ``theta``, ``theta-euler``, ``llg`` or ``llg-damping``; by default the stage's, else ``theta``.
            contact_model: ``dipole`` or ``multipole``; by default the stage's, else ``dipole``, with which two balls
                in line with the field attract too weakly: by 34 % at a gap of 0.3 radii, by 93 % at 0.01.
            method: Summation method: ``direct``, ``fmm`` or ``auto``, see :class:`warpmag.Magnetics`.
            rtol: Relative magnetization error at which the induction solve ends; by default the stage's, else 1e-3.
            max_evaluations: Field evaluations after which an unconverged induction solve ends.
            external_field: Uniform applied field H0 [A/m]; by default the stage's, else that of an imported MJCF (see
                :class:`warpmag.Magnetics`), else none.
            curve: Magnetization curve of all magnets, see :func:`warpmag.add_inducible`; by default each magnet's own.
            device: Warp device; by default Warp's.
            graphs: Replay captured graphs, in place of launching each kernel; by default True, or False with
                ``on_substep``. If a capture fails, kernels are launched one by one; see :attr:`capture_failure`.
            visuals: Also import visual shapes that do not collide, for a viewer.
            on_substep: Function of a state and the length of a substep [s], called in each substep after the magnetic
                forces: it adds other forces to ``state.body_f``, or sets ``simulation.control``. A substep may be
                repeated, so the effects of the function must depend on the state only. With ``graphs=True`` the
                function may launch kernels only, because its Python code runs once.

        Raises:
            InputError: The scene or an argument is invalid; the message names the prim or the argument.
        """
        check_solver(solver)
        graphs = on_substep is None if graphs is None else graphs
        for name, flag in (("graphs", graphs), ("visuals", visuals)):
            check_flag(name, flag)
        if not (on_substep is None or callable(on_substep)):
            raise InputError(f"on_substep: must be a function, got {short_repr(on_substep)}")
        self.device, self._ranks = resolve_device(device), current_ranks()
        graphs &= self._ranks is None  # sums over ranks cannot be captured
        overrides = {"force": force, "dynamics": dynamics, "contact_model": contact_model, "rtol": rtol}
        solve_options = {"curve": curve, "max_evaluations": max_evaluations, "method": method}
        with errors_on_all_ranks(self._ranks):
            articulations = not SOLVERS[solver].maximal
            builder, settings, scene_step = self._open(scene, visuals=visuals, articulations=articulations)
            time_step = next(value for value in (dt, scene_step, DEFAULT_STEP) if value is not None)
            check_positive("dt", time_step)
            self.step_size = float(time_step)
            stage = "" if self._scene is None else str(scene)
            self.model = solver_model(builder, solver, self.device, stage=stage, longest_substep=LONGEST_SUBSTEP)
            self._joint_gaps = joint_gaps(self.model) if SOLVERS[solver].maximal else {}
            settings = settings.replaced(external_field=external_field, **overrides)
            magnetic = vars(settings) | ({"external_field": external_field} if self._scene is None else {})
            self._magnetics = Magnetics(self.model, dt=LONGEST_SUBSTEP, **solve_options, **magnetic)
            keyed_values = self._keyed_values(solver, keyed_field=external_field is None)
            self._builder, self._settings = builder, settings
            self._prepare(solver, graphs=graphs, keyed_values=keyed_values, on_substep=on_substep)
            self._options = self._options_of(settings, solver, **solve_options)
            if self._ranks is not None:
                self._ranks.check_equal(self._options | {"scene": list(self._stepper.save().values())})

    def _open(self, scene: str | os.PathLike | newton.ModelBuilder, **choices) -> tuple:
        """Import a scene; return its builder, its magnetic settings, and its time step [s] or None."""
        self._scene, self.frame_rate, self.frame_count = None, _FRAME_RATE, None
        if isinstance(scene, newton.ModelBuilder):
            return scene, MagneticSettings(), None
        from warpmag.engine.stepping.scene import import_scene  # noqa: PLC0415 - a builder can do without USD

        if not isinstance(scene, str | os.PathLike) or not os.fspath(scene):
            raise InputError(f"scene: must be a file or a newton.ModelBuilder, got {short_repr(scene)}")
        self._scene = import_scene(scene, **choices)
        clock = self._scene.clock
        self.frame_rate = clock.frames_per_second
        seconds = (clock.end - clock.start) / clock.time_codes_per_second
        self.frame_count = round(seconds * self.frame_rate) or None
        return self._scene.builder, self._scene.magnets.settings, clock.step

    def _options_of(self, settings: MagneticSettings, solver: str, **others) -> dict[str, str]:
        """Return the options of the run as text. Only a run with equal options can be resumed."""
        kind = "cuda" if self._magnetics.device.is_cuda else "cpu"
        options = {**vars(settings), **others, "step": self.step_size, "solver": solver, "device": kind}
        options["external_field"] = tuple(np.asarray(settings.external_field, dtype=float).tolist())
        return {name.replace("_", " "): str(value) for name, value in options.items()}

    def _keyed_values(self, solver: str, keyed_field: bool) -> KeyedModelValues | None:
        """Return the keyed values of the stage, with its external field if ``keyed_field``; None without keys."""
        if self._scene is None:
            return None
        keys = self._scene.keys if keyed_field else replace(self._scene.keys, field=None)
        if not any(vars(keys).values()):
            return None
        return KeyedModelValues(self.model, self._magnetics, keys, contacts_at_end=SOLVERS[solver].contacts_at_end)

    def _prepare(self, solver: str, **stepping) -> None:
        """Set up solver and stepper with its options ``stepping``, and measure overlaps at the start."""
        self._sizes = sizes = body_sizes(self.model)
        self._solver = RigidSolver(self.model, sizes, solver=solver)
        options = {"step": self.step_size, "longest_substep": LONGEST_SUBSTEP, **stepping}
        self._stepper = Stepper(self.model, self._magnetics, self._solver, sizes, **options)
        bodies = {magnet.body for magnet in self._magnetics.magnets if magnet.body >= 0}
        self._moving = np.array(sorted(body for body in bodies if math.isfinite(sizes.thickness[body])), dtype=int)
        self._statistics = Statistics(magnets=len(self._moving))
        if self._scene:
            self._start_from_stage()
        self._center = self._positions(self.state).mean(axis=0) if len(self._moving) else np.zeros(3)
        overlap, _, self._statistics.overlapping = self._stepper.measure_contacts(_OVERLAP)
        self._stepper.set_initial_overlap(overlap)
        self._statistics.coarseness = position_coarseness(self.model, self.state, sizes.thickness)

    def _start_from_stage(self) -> None:
        """Start the induction from the moments of the stage, for example the result of an earlier run."""
        magnetizations = {}
        volumes = dict(zip(self._magnetics.shapes.tolist(), self._magnetics.shape_volumes.tolist(), strict=True))
        for prim, moment in self._scene.magnets.initial_moments.items():
            shapes = self._scene.magnet_shapes[prim]
            magnetization = np.array(moment) / sum(volumes[shape] for shape in shapes)
            check_start(f"{prim}: magnetization by warpmag:moment", magnetization.tolist())
            magnetizations |= dict.fromkeys(shapes, magnetization)
        if magnetizations:
            self._magnetics.start_from(magnetizations)

    @property
    def state(self) -> newton.State:
        """The present state; waits for the device.

        Raises:
            SimulationError: A step led to a state that is not finite, or to a speed above 1e7 m/s. The last accepted
                state remains.
        """
        self._read_reports()
        return self._stepper.state

    @property
    def control(self) -> newton.Control:
        """Forces and targets of joints, initially from the scene.

        Change its arrays between steps, by ``simulation.control.joint_target_q.assign(...)`` or by kernels; captured
        steps read them, too. Assigning another control of this model captures the step again.
        """
        return self._stepper.control

    @control.setter
    def control(self, control: newton.Control) -> None:
        self._read_reports()
        check_control(control, self.model)
        if control is not self._stepper.control:
            self._stepper.control = control

    @property
    def magnetics(self) -> Magnetics:
        """The magnets, with the fields of the last solve: in the last step, or at the start before the first step.

        Waits for the device. Call ``magnetics.induce(simulation.state)`` for the fields at the present state.
        """
        self._read_reports()
        if not self._magnetics.is_solved:
            self._magnetics.induce(self._stepper.state)
        return self._magnetics

    @property
    def statistics(self) -> Statistics:
        """Statistics of the run so far; :meth:`finish` adds the final values. Waits for the device."""
        self._read_reports()
        return self._statistics

    def moments_line(self) -> str:
        """Return a line with the number of moments and the body that has most of them, without a solve."""
        return moments_line(self._magnetics)

    def warnings(self) -> list[str]:
        """Return the warnings about the scene and the run so far, one line each; waits for the device."""
        lines = list(self._scene.warnings) if self._scene else joint_gap_warnings(self._joint_gaps)
        if weakness := SOLVERS[self._options["solver"]].warning:
            lines.append(weakness)
        lines += self.statistics.warnings()
        error, rtol = self._statistics.field_error, self._magnetics.rtol
        if error > rtol:
            lines.append(f"fields by multipoles have an error of {error:.2g} > rtol {rtol:g}; use method direct")
        if (crowded := self._magnetics.system.crowded) is not None and crowded.numpy()[0]:
            lines.append("some cells of inducible bodies near too many others acted as balls or uniform boxes")
        return lines

    @property
    def capture_failure(self) -> str:
        """Reason why kernels are launched one by one and not as a faster graph; empty if a step is a graph."""
        return self._stepper.capture_failure

    @property
    def time(self) -> float:
        """Time since the start [s]."""
        return self._stepper.steps * self.step_size

    def step(self) -> None:
        """Advance by one step; does not wait for a GPU.

        Raises:
            SimulationError: A step led to a state that is not finite, or to a speed above 1e7 m/s. A GPU raises it up
                to 64 steps later.
        """
        self._stepper.advance()
        if self._stepper.reports_due:
            self._read_reports()

    def reset(self, worlds: Any = None) -> None:
        """Reset worlds to the start: poses, velocities, induction, currents, fields; capturable in a graph.

        :attr:`time` and time-sampled values continue, and :attr:`control` is kept. :meth:`Magnetics.reset` describes
        the reset of magnets. Worlds share the length of substeps, which depends on the fastest motion in any world::

            simulation.reset(worlds=[True, False, False])

        Args:
            worlds: True for each world to reset, see :meth:`Magnetics.reset`; by default all worlds.

        Raises:
            InputError: ``worlds`` is not such a mask.
            SimulationError: A step led to a state that is not finite, or to a speed above 1e7 m/s. Call this method
                again to go on.
        """
        if not wp.get_device(self.model.device).is_capturing:
            self._read_reports()
        self._stepper.reset(worlds)

    def _read_reports(self) -> None:
        """Add the reports of the last steps to the statistics; waits for the device."""
        self._magnetics.check_model()
        try:
            for report in self._stepper.read_reports():
                self._statistics.add_step(report)
        except SimulationError as error:
            if not (cause := failure_cause(self._magnetics, self._statistics, self._joint_gaps)):
                raise
            raise SimulationError(f"{error}; {cause}") from None

    def _follow(self, state: newton.State) -> None:
        """Record the farthest distance of a magnet from the mean initial position."""
        if len(self._moving):
            distance = np.linalg.norm(self._positions(state) - self._center, axis=1).max()
            self._statistics.farthest = max(self._statistics.farthest, float(distance))

    def _positions(self, state: newton.State) -> np.ndarray:
        return state.body_q.numpy()[self._moving, :3].astype(float)

    def run(
        self,
        frames: int | None = None,
        *,
        output: str | os.PathLike | None = None,
        copy_scene: bool = False,
        resume: bool = False,
        on_frame: Callable[[int], bool | None] | None = None,
    ) -> Statistics:
        """Simulate, and record frames on a USD stage.

        A frame is recorded at the nearest step, with the time of that step. Frames are written one by one, so that they
        survive an interruption.

        Args:
            frames: Output frames after the first; by default all of the stage, or one second without a time range.
            output: USD file to write. It lacks passive springs of a builder, and joints of several axes. A warning
                names each of these joints.
            copy_scene: Copy the scene beside the output instead of referencing it. A scene with unsaved edits is always
                copied.
            resume: Continue the run at the output, if there is one; scene and options must be the same. On a CPU the
                result is bitwise identical to an uninterrupted run.
            on_frame: Called after each frame with its number, from 0; the run ends if it returns False.

        Returns:
            The statistics, after :meth:`finish`.

        Raises:
            InputError: The output cannot be written, or its run cannot be resumed.
            SimulationError: A step led to a state that is not finite.
        """
        frames = self.frames_of(frames)
        for name, flag in (("copy_scene", copy_scene), ("resume", resume)):
            check_flag(name, flag)
        if on_frame is not None and not callable(on_frame):
            raise InputError(f"on_frame: must be a function, got {short_repr(on_frame)}")
        recorder = None if output is None else self._open_recorder(output, copy_scene, frames)
        if resume and (recorder is None or self._scene is None):
            raise InputError("resume: needs an output, and a scene from a stage")
        if resume and self._stepper.steps:
            raise InputError("resume: only a simulation that has not begun can resume another")
        if resume and not SOLVERS[self._options["solver"]].resumable:
            raise InputError(f"resume: runs of the solver {self._options['solver']} cannot be resumed")
        resumed = complete = False
        try:
            try:
                if resume:
                    resumed, complete = recorder.resume(frames, self._steps_at(frames), self.step_size)
                if not complete:
                    options = {"recorder": recorder, "on_frame": on_frame, "resumed": resumed}
                    complete = run_frames(self, self._stepper, frames, self._steps_at, follow=self._follow, **options)
            finally:
                if recorder:
                    recorder.close(complete)
        except (KeyboardInterrupt, InputError, SimulationError) as end:
            if recorder and recorder.written is not None:
                frames_so_far = f"{output} has the frames up to {round(recorder.written * self.frame_rate)}"
                end.args = (", ".join(filter(None, (str(end), frames_so_far))),)
            raise
        return self.finish()

    def frames_of(self, frames: int | None) -> int:
        """Return ``frames`` after a check. None means the time range of the scene, or one second without a time range.

        Raises:
            InputError: ``frames`` is not a whole number from 1 to 2³¹ − 1.
        """
        if frames is None:
            frames = self.frame_count if self.frame_count is not None else round(self.frame_rate)
        check_count("frames", frames)
        return int(frames)

    def _open_recorder(self, output: str | os.PathLike, copy_scene: bool, frames: int):
        from warpmag.engine.stepping.recording import Recorder  # noqa: PLC0415 - a builder can do without USD

        scene = self._scene
        if scene is None:
            from warpmag.engine.stepping.builder_scene import builder_scene  # noqa: PLC0415

            field = self._magnetics.external_field.numpy()[0].tolist()  # of the first world
            settings = self._settings.replaced(external_field=tuple(field))
            scene = builder_scene(self._builder, self.model, self.state, settings, self.frame_rate)
            for line in scene.warnings:
                warn_caller(line)
        options = {"copy_scene": copy_scene, "frames": frames + 1, "options": self._options, "ranks": self._ranks}
        options["resumable"] = SOLVERS[self._options["solver"]].resumable and self._scene is not None
        return Recorder(scene, self._magnetics, self._stepper, self._statistics, output, **options)

    def _steps_at(self, frame: int) -> int:
        """Return the number of steps from the start to a frame."""
        return round(frame / (self.frame_rate * self.step_size))

    def finish(self) -> Statistics:
        """Return the statistics, completed with values of the present state; waits for the device."""
        statistics = self.statistics
        if self._magnetics.is_solved:
            statistics.field_error = self._magnetics.field_error()
        statistics.final_overlap, depth, _ = self._stepper.measure_contacts(_OVERLAP)
        statistics.overlap = max(statistics.overlap, statistics.final_overlap)
        statistics.depth = max(statistics.depth, depth)
        speeds = np.linalg.norm(self.state.body_qd.numpy()[:, :3], axis=1)
        held = np.flatnonzero(held_bodies(self.magnetics, self._solver, self._sizes))
        held = np.intersect1d(held, self._moving)
        statistics.held = len(held)
        statistics.held_rms_speed, statistics.rms_speed = (
            float(np.sqrt(np.mean(speeds[bodies] ** 2))) if len(bodies) else 0.0 for bodies in (held, self._moving)
        )
        statistics.held_median_speed = float(np.median(speeds[held])) if len(held) else 0.0
        return statistics
