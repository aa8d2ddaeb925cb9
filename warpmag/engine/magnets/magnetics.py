"""Magnetic forces on the bodies of a Newton model."""

from typing import Any

import newton
import numpy as np
import numpy.typing as npt
import warp as wp

from warpmag.declarations import materials
from warpmag.declarations.checks import check_positive, check_whole, short_repr
from warpmag.declarations.curves import MagnetizationCurve
from warpmag.declarations.magnets import MagneticSettings, check_magnetization
from warpmag.deprecation import renamed_arguments
from warpmag.engine.magnets.attributes import NAMESPACE
from warpmag.engine.magnets.caller_checks import check_duration, check_state, held_by_model
from warpmag.engine.magnets.caller_values import device_vectors, world_indices
from warpmag.engine.magnets.distant_magnets import DistantMagnets, distant_bodies
from warpmag.engine.magnets.eddy import gather_velocities, set_conductivities
from warpmag.engine.magnets.equal_worlds import equal_worlds
from warpmag.engine.magnets.grouping import find_magnets
from warpmag.engine.magnets.imported_field import imported_field
from warpmag.engine.magnets.kept_solution import KeptSolution
from warpmag.engine.magnets.material_changes import change_materials
from warpmag.engine.magnets.model_values import ModelValues, magnetic_arrays
from warpmag.engine.magnets.placed_moments import PlacedMoments
from warpmag.engine.magnets.pose_gradients import ForceGradients
from warpmag.engine.magnets.shape_moments import PermanentShapes, ShapeMoments
from warpmag.engine.magnets.sources import ModelSources
from warpmag.engine.magnets.workload import Workload, workload
from warpmag.engine.magnets.world_reset import WorldStart
from warpmag.errors import ConvergenceWarning, InputError, warn_caller
from warpmag.kernels.rigid.bodies import (
    set_external_field,
    set_magnetization,
)
from warpmag.kernels.rigid.force_spans import MagneticShapes, magnetic_shapes
from warpmag.kernels.rigid.worlds import number_worlds
from warpmag.moments.arrays import (
    CallContext,
    Numbers,
    PersistentArray,
    host_array,
    largest_coordinate,
)
from warpmag.moments.probe import FieldProbe
from warpmag.moments.ranks import current_ranks
from warpmag.moments.system import MomentSystem
from warpmag.moments.tape import check_untaped, paused_tape
from warpmag.terminal import collection_paused


class Magnetics:
    """The magnets of a Newton model: their induction, forces and fields.

    A ball without a ``moment_spacing`` is one moment. Most permanent boxes and cylinders are 2 to 8 moments with a
    closed-form near field. Any other magnet is a lattice of moments with the exact volume; fewer moments represent iron
    that is far from all other magnets. Moments of one body exert no forces on each other, and magnets of different
    worlds do not interact. Use any solver that reads ``State.body_f``::

        magnetics = warpmag.Magnetics(model)
        ...
        state.clear_forces()
        magnetics.apply(state)
        solver.step(state, state_out, None, contacts, dt)

    Attributes:
        magnets: The magnets, in the order of their moments.
        system: The moments on the device. Call its ``refresh`` before reading its ``positions`` and ``moments``,
            because in the last solve fewer moments, in another system, may have represented a distant body. Probes and
            :meth:`sum_moments` call it themselves.
        shapes: Indices of the magnetic shapes, in the order of :meth:`shape_moments`, shape [n].
        shape_volumes: Magnetic volume of each of these shapes [m³], shape [n]. Where shapes of one body overlap, the
            common volume belongs to the first of them.
        coils: The coils with a resistance, None without any: their ``labels``, and on the device their ``currents``
            [A].

    Example:
        >>> import newton
        >>> import warpmag
        >>> builder = newton.ModelBuilder()
        >>> warpmag.register_custom_attributes(builder)
        >>> ball = builder.add_body()
        >>> shape = builder.add_shape_sphere(ball, radius=0.005)
        >>> marked = warpmag.add_inducible(builder, body=ball, material="iron")
        >>> coil = warpmag.add_coil(builder, radius=0.02, ampere_turns=500.0, xform=((0, 0, 0.02), (0, 0, 0, 1)))
        >>> model = builder.finalize(device="cpu")
        >>> magnetics, state = warpmag.Magnetics(model), model.state()
        >>> magnetics.apply(state)
        >>> bool(state.body_f.numpy()[ball, 2] > 0.0)  # the coil attracts the ball
        True
    """

    @renamed_arguments(step="dt")
    @collection_paused()
    def __init__(
        self,
        model: newton.Model,
        *,
        force: str = "kelvin",
        dynamics: str = "theta",
        contact_model: str = "dipole",
        method: str = "auto",
        rtol: float = 1e-3,
        external_field: tuple[float, float, float] | None = None,
        max_evaluations: int = 1000,
        curve: str | MagnetizationCurve | None = None,
        dt: float = 1e-3,
    ):
        """Sample the magnets of ``model`` and allocate all buffers.

        Args:
            model: A finalized model with shapes marked by :func:`warpmag.add_inducible` or
                :func:`warpmag.add_permanent`.
            force: Force law, ``kelvin`` (Eqs. 13, 14) or ``zeeman`` (Eq. 4).
            dynamics: ``theta`` (exact flow, accelerated), ``theta-euler`` (the paper's explicit step), ``llg`` or
                ``llg-damping`` (Eq. 6, with and without precession).
            contact_model: ``dipole``, or ``multipole``, which adds higher multipoles of balls that nearly touch each
                other or flat faces of iron. With ``dipole`` two balls in line with the field attract too weakly: by
                34 % at a gap of 0.3 radii, by 93 % at 0.01.
            method: Summation of fields and forces: ``direct`` over all pairs, ``fmm`` by the fast multipole method
                with an error within ``rtol``, or ``auto`` for the faster one.
            rtol: Relative magnetization error at which the induction solve ends. With bodies of cells the error in the
                energy norm and the relative residual must both be at most ``rtol``.
            external_field: Uniform applied field H0 [A/m], world frame. By default the option ``magnetic`` of an
                imported MJCF, B/μ0, with a warning; else none.
            max_evaluations: Field evaluations after which an unconverged induction solve ends.
            curve: Magnetization curve of all magnets, see :func:`warpmag.add_inducible`; by default each magnet's own.
            dt: Longest time between calls of :meth:`apply` [s]. Drag by eddy currents is limited so that it stops no
                body within this time.

        Raises:
            InputError: The model has no magnets, a setting is out of range, or several worlds have magnets and another
                magnet is outside all worlds.
        """
        self._held = held_by_model(model)
        imported = None
        if external_field is None:
            external_field, imported = (0.0, 0.0, 0.0), imported_field(model)
        settings = MagneticSettings(external_field, force, dynamics, contact_model, rtol)
        if (all_ranks := current_ranks()) is not None:
            others = {"method": method, "max_evaluations": max_evaluations, "curve": curve, "dt": dt}
            all_ranks.check_equal(vars(settings) | others | magnetic_arrays(model), "Magnetics: ")
        settings.check("Magnetics")
        check_positive("Magnetics: dt", dt)
        if curve is not None:
            curve = materials.measured("Magnetics: curve", curve)
        self.magnets, self._worlds = find_magnets(model)
        self._model, self._values = model, ModelValues(model, measured=isinstance(curve, MagnetizationCurve))
        self._sources = ModelSources(model, self._worlds)
        self._induced = False
        options = {"sources": self._sources.applied, "curve": curve, "method": method}
        options["max_evaluations"] = max_evaluations
        worlds = equal_worlds(model, self.magnets)
        self._placed = placed = PlacedMoments(model, worlds, settings, **options)
        self.system, self._distant = placed.system, None
        bodies = distant_bodies(model, worlds.magnets, settings, method=method, has_sources=bool(self._sources.applied))
        if bodies:
            self._distant = DistantMagnets(model, placed, bodies, settings, **options)
        self._refresh_resting, self.system.refresh = self.system.refresh, self._refresh
        self._sources.bind(self.system)
        self.coils = self._sources.circuits
        self._shape_moments = ShapeMoments(model, worlds)
        self.shapes, self.shape_volumes = self._shape_moments.shapes, self._shape_moments.volumes
        self._permanent_shapes = PermanentShapes(model, self.magnets)
        newton_worlds = wp.array(self._worlds, dtype=wp.int32, device=model.device)
        self._newton_world = number_worlds(newton_worlds, self.system.world_of_moments)
        self._gradients = ForceGradients(placed, self._sources, model)
        self._start = WorldStart(model, newton_worlds, self.external_field, self._newton_world)
        set_conductivities(model, self.magnets, self.system, float(dt))
        if imported is not None:
            self.set_external_field(imported)

    @property
    def _systems(self) -> list[MomentSystem]:
        """The system, and those with fewer moments in place of cells."""
        return [self.system] if self._distant is None else self._distant.systems

    @property
    def device(self) -> wp.Device:
        """Device of the model."""
        return self.system.device

    @property
    def rtol(self) -> float:
        """Relative magnetization error at which the induction solve ends."""
        return self.system.rtol

    @property
    def external_field(self) -> wp.array:
        """Uniform applied field H0 [A/m], repeated for each moment, on the device, world frame, shape [moments]."""
        return self.system.external_field

    @property
    def error(self) -> wp.array:
        """Estimated relative magnetization error of the last solve, on the device, shape [worlds with magnets].

        In worlds with bodies of cells, such as plates and bars, it is the larger of the error in the energy norm and
        the relative residual. Closed loops of magnetization inside iron, which have no field, hardly affect either.
        """
        return self.system.error

    @property
    def evaluations(self) -> wp.array:
        """Field evaluations of the last solve, on the device, shape [worlds with magnets]."""
        return self.system.evaluations

    @property
    def converged(self) -> wp.array:
        """1 where the last solve reached ``rtol``, else 0, on the device, shape [worlds with magnets]."""
        return self.system.converged

    @property
    def is_solved(self) -> bool:
        """True after the first :meth:`induce` or :meth:`apply`."""
        return self._induced

    @property
    def needs_velocities(self) -> bool:
        """True if forces depend on velocities, ``State.body_qd``, because a magnet conducts."""
        return self.system.eddy is not None

    def magnetic_shapes(self) -> MagneticShapes:
        """Return the shapes of magnets and coils, whose gaps limit how many substeps share forces."""
        radii = self._model.shape_collision_radius.numpy()[self.shapes]
        coils = {k: radius for k, radius in zip(self._sources.shapes, self._sources.radii, strict=True) if radius > 0.0}
        shapes, spacing = [*self.shapes, *coils], self._sources.spacing
        return magnetic_shapes(self._model, shapes, [*radii, *coils.values()], spacing)

    def field_error(self) -> float:
        """Return the relative error of the last field that the fast multipole method summed; 0 for direct sums.

        The reference is the sum over all pairs at 256 random magnets. Waits for the device.
        """
        self._check_induced()
        return self.system.field_error()

    @property
    def worlds(self) -> np.ndarray:
        """Newton worlds with magnets, [-1] for a model without worlds; NumPy."""
        return self._worlds

    @property
    def model(self) -> newton.Model:
        """The model."""
        return self._model

    def _check_state(self, state: newton.State, *names: str) -> None:
        """Raise :class:`InputError` unless kernels can read the model and the arrays ``names`` of ``state``."""
        for held in self._held:
            held.check()
        check_state(state, self._model, *names, *(("body_qd",) if self.needs_velocities else ()))

    def reset(self, worlds: Any = None) -> None:
        """Reset worlds to the initial state; capturable in a graph with an array on the device.

        Their next induction starts from zero magnetization. Their coil currents and voltages, factors of field maps,
        magnetizations and external fields return to the values from which this object was made; set others afterwards.
        Poses in the state, changed materials and other worlds do not change. Neighbor lists of touching magnets are
        rebuilt in all worlds, which may change later results of the others within ``rtol``::

            done = wp.array([True, False, False], dtype=wp.bool)  # or a tensor of torch
            magnetics.reset(worlds=done)

        Args:
            worlds: True for each world to reset, shape [worlds], or [worlds + 1] as for Newton's solvers, with a last
                entry for magnets outside all worlds. A Warp array of bool or a tensor of bool on the model's device,
                NumPy's bools or a list of bools; by default all worlds.

        Raises:
            InputError: ``worlds`` is not such a mask.
        """
        mask, chosen = self._start.restore(worlds)
        if self.coils is not None:
            self.coils.reset(mask)
        for system in self._systems:
            system.start_cold(chosen)

    def apply(self, state: newton.State, dt: float | None = None) -> None:
        """Add the magnetic forces at the poses of ``state`` to ``state.body_f``; capturable in a graph.

        On an active ``wp.Tape`` the forces have gradients with respect to each of these arrays with ``requires_grad``:
        ``state.body_q``, ``model.shape_transform`` (placement of coils that no body carries),
        ``model.warpmag.strength`` (currents), ``model.warpmag.magnetization`` and :attr:`external_field`.

        Args:
            state: State with poses ``body_q``. Forces are added to ``body_f``, which is not cleared. Conducting magnets
                also need velocities, ``body_qd``.
            dt: Time for which the forces act [s], the time step of the solver. The currents of coils with a resistance
                advance by it; a model with such coils needs it.

        Raises:
            InputError: ``model.warpmag`` has changed without :meth:`notify_model_changed`. On a GPU a later call raises
                this error, because this method does not wait for the device. Or a ``wp.Tape`` is active, ``body_q``
                requires a gradient, and the forces have no gradient. Or ``dt`` is missing or not positive.

        Warns:
            ConvergenceWarning: ``max_evaluations`` did not reach ``rtol``. On a GPU only methods that return arrays to
                the host warn; see :attr:`converged`.
        """
        if dt is None and self.coils is not None:
            raise InputError(f"apply: dt is missing, by which the current of {self.coils.labels[0]} advances")
        with paused_tape() as tape:
            if tape is not None:
                self._check_state(state, "body_q")
                if self.coils is not None and state.body_q.requires_grad:
                    raise InputError(f"apply: forces with the voltage of {self.coils.labels[0]} have no gradient")
            self._solve(state, dt, taped=tape is not None and bool(self._gradients.arguments(state)))
            self.add_forces(state)
            if tape is not None:
                self._gradients.record(tape, state)
        if self.device.is_cpu and not self.device.is_capturing:
            self._warn_unconverged()

    def induce(self, state: newton.State, dt: float | None = None, *, sharing: wp.array | None = None) -> None:
        """Solve the induction at the poses of ``state``, starting from the last magnetizations.

        Args:
            state: State with poses ``body_q``.
            dt: Time [s] by which the currents of coils with a resistance advance; by default they stay.
            sharing: Number n ≥ 2 of substeps of length ``dt`` that share this solve; the currents advance by n·dt. On
                the device, int32, shape [1].

        Raises:
            InputError: An argument has a wrong type, size or device, or ``dt`` is not positive.
        """
        self._solve(state, dt, sharing)

    def _solve(self, state: newton.State, dt: float | None, sharing=None, *, taped: bool = False) -> None:
        """Solve the induction, see :meth:`induce`; ``taped`` excludes fewer moments for distant bodies."""
        values, system = self._values, self.system
        check_duration(dt, sharing, self._model.device)
        self._check_state(state, "body_q")
        check_untaped(self._gradients.arguments(state), "only Magnetics.apply records one")
        self._induced = True
        (self._distant or self._placed).gather(state.body_q, values)
        values.check(wait=False)
        self._sources.gather(state.body_q)
        gather_velocities(self._model, state, self._placed.table, self._sources, system)
        if self._distant is not None:
            self._distant.solve(values, allowed=not taped)
        elif self.coils is None or dt is None:
            system.solve()
        else:
            self.coils.step(float(dt), sharing)

    def add_forces(self, state: newton.State) -> None:
        """Add the forces on the present moments to ``state.body_f``: the second half of :meth:`apply`.

        Raises:
            InputError: There is no solve yet, or ``state`` does not fit the model.
        """
        self._check_state(state, "body_q", "body_f")
        self._check_induced()
        if self._distant is not None:
            self._distant.add_forces(state)
            return
        self.system.apply_forces()
        self._placed.add_wrenches(self._model, state)
        self._sources.add_reactions(state)

    def notify_model_changed(self, flags: newton.ModelFlags | int = newton.ModelFlags.SHAPE_PROPERTIES) -> None:
        """Read changed saturations and susceptibilities from ``model.warpmag``; captured graphs stay valid.

        Without this call a later :meth:`apply` raises an error, on a CPU the next one. Changes of magnetizations need
        no call.

        Args:
            flags: Kinds of changes, as for Newton's solvers. Nothing happens without ``SHAPE_PROPERTIES``.

        Raises:
            InputError: A value is out of range, or the contact model has tables for the old value. Or another attribute
                was changed, such as the kind, the curve or the moment spacing of a magnet.
        """
        check_whole("flags", flags)
        if not int(flags) & int(newton.ModelFlags.SHAPE_PROPERTIES):
            return
        levels = () if self._distant is None else self._distant.levels
        self.magnets = change_materials(self._values, (self._placed, *levels), self.magnets)

    def persistent_arrays(self) -> dict[str, PersistentArray]:
        """Return the arrays that determine the next step, by name: values set by the user and the last solution."""
        attributes = getattr(self._model, NAMESPACE)
        values = {"magnetization": attributes.magnetization, "strength": attributes.strength}
        values["field"] = self.external_field
        if self.coils is not None:
            values |= {f"coils.{name}": array for name, array in self.coils.persistent_arrays().items()}
        return values | self._values.persistent_arrays() | self._solutions()

    def _solutions(self) -> dict[str, PersistentArray]:
        """Return the arrays that solves pass to the next ones, by name."""
        few = {} if self._distant is None else self._distant.persistent_arrays()
        return self.system.persistent_arrays() | {f"few.{name}": array for name, array in few.items()}

    def stepped_arrays(self) -> list[wp.array]:
        """Return the arrays that a step changes. To repeat a step, restore copies and call ``discard_attempt``."""
        currents = [] if self.coils is None else self.coils.stepped_arrays()
        return currents + [array for system in self._systems for array in system.start_arrays()]

    def discard_attempt(self, rejected: wp.array) -> None:
        """Discard what the induction remembers of a step that is repeated, if ``rejected`` is not 0, shape [1].

        Its magnetizations belong to other poses. Starting from them, the induction would converge slowly.
        """
        for system in self._systems:
            system.restart(rejected)

    def check_model(self) -> None:
        """Raise :class:`InputError` if ``model.warpmag`` was changed without a notification; waits for the device."""
        self._values.check(wait=True)

    def set_external_field(self, external_field: Numbers) -> None:
        """Set the uniform applied field; capturable in a graph with a Warp array.

        Args:
            external_field: H0 [A/m], world frame, shape [3] for all worlds, or [model.world_count, 3]. Or a Warp array
                of vectors on the model's device, shape [1] or [model.world_count]; its values are not checked.

        Raises:
            InputError: The field has another shape, or is not finite.
        """
        counts = 1, max(self._model.world_count, 1)
        field = device_vectors("external_field", external_field, counts, self._model.device)
        set_external_field(field, self._newton_world, self.system.external_field)

    def set_current(self, coil: int | str, ampere_turns: Numbers) -> None:
        """Set the current of coils.

        A graph can capture a call with a Warp array, after a first call for the same ``coil``. The values are
        written to ``model.warpmag.strength``, where a program may write as well. For a field map, the value is the
        factor of its field.

        Args:
            coil: Index of the coil's shape in the model, or a pattern of labels, with wildcards as in a shell. The
                index is the return value of :func:`warpmag.add_coil`, unless builders were combined. Coils of
                replicated worlds have the same label, in the order of the worlds.
            ampere_turns: Current times turns [A], one number or shape [coils]. Or a Warp array of float32 on the
                model's device; its values are not checked.

        Raises:
            InputError: No coil matches, the numbers of values and coils differ, or a value is not finite. Or a coil has
                a resistance: use :meth:`set_voltage`.
        """
        self._sources.set_strength("set_current", coil, ampere_turns)

    def set_voltage(self, coil: int | str, voltage: Numbers) -> None:
        """Set the voltage of coils with a resistance.

        A graph can capture a call with a Warp array, after a first call for the same ``coil``. The values are
        written to ``model.warpmag.voltage``, where a program may write as well. Read the currents from
        ``coils.currents``.

        Args:
            coil: Index of the coil's shape or a pattern of labels, as in :meth:`set_current`.
            voltage: Voltage [V], one number or shape [coils]. Or a Warp array of float32 on the model's device; its
                values are not checked.

        Raises:
            InputError: No coil matches, one has no resistance, the numbers of values and coils differ, or a value is
                not finite.
        """
        self._sources.set_voltage("set_voltage", coil, voltage)

    def set_magnetization(self, magnetization: Numbers, *, body: int = -1, shape: int | None = None) -> None:
        """Set the magnetization of a permanent magnet; capturable in a graph with a Warp array.

        The value is written to ``model.warpmag.magnetization``, in the frame of each shape, where a program may write
        as well.

        Args:
            magnetization: M [A/m] in the frame of the body, or of a static shape, shape [3]. Or a Warp array of one
                vector on the model's device; its value is not checked.
            body: The body; all its permanent shapes are set.
            shape: The only shape to set, in place of ``body``.

        Raises:
            InputError: The body or shape has no permanent magnet, or the magnetization has another shape or is not
                finite.
        """
        if not isinstance(magnetization, wp.array):
            magnetization = host_array("magnetization", magnetization)
            if magnetization.shape == (3,):
                check_magnetization("magnetization", magnetization)
        shapes = self._permanent_shapes.select(body, shape)
        vector = device_vectors("magnetization", magnetization, (1,), self._model.device)
        set_magnetization(vector, shapes, self._model, self._placed.table)

    def probe(self, points: Numbers, *, worlds: npt.ArrayLike | None = None, gradients: bool = False) -> FieldProbe:
        """Return a probe of the field at points; its :meth:`FieldProbe.measure` is capturable in a graph::

            probe = magnetics.probe([[0.0, 0.0, 0.1]])
            magnetics.apply(state)
            probe.measure()
            flux_density = probe.b.numpy()

        Args:
            points: The points [m], shape [p, 3], or a Warp array of vectors on the model's device.
            worlds: World of each point, a number or shape [p]; by default the only world with magnets.
            gradients: Compute gradients as well.

        Raises:
            InputError: A point is not finite, a coordinate exceeds 1e7 m or 1e9 times the largest radius of a moment,
                or the world of a point holds no magnets.
        """
        system = self.system
        context = CallContext(system.device, system.dtype, warp_out=False)
        points = context.vectors("points", points, farthest=largest_coordinate(system.dtype, system.largest_radius))
        indices = world_indices(worlds, self._worlds, len(points))
        probe = FieldProbe(system, len(points), worlds=indices, gradients=gradients)
        wp.copy(probe.points, points)
        return probe

    def h_field(self, points: Numbers, *, worlds: npt.ArrayLike | None = None) -> np.ndarray:
        """Return the field H [A/m] at points, shape [p, 3]; see :meth:`probe` for arguments and errors."""
        return self._measured_probe(points, worlds).h.numpy()

    def b_field(self, points: Numbers, *, worlds: npt.ArrayLike | None = None) -> np.ndarray:
        """Return the flux density B [T] at points, also inside bodies, shape [p, 3]; see :meth:`probe`."""
        return self._measured_probe(points, worlds).b.numpy()

    def field_gradient(self, points: Numbers, *, worlds: npt.ArrayLike | None = None) -> np.ndarray:
        """Return the gradient ∂H_i/∂x_k [A/m²] at points, shape [p, 3, 3]; see :meth:`probe`."""
        gradient = self._measured_probe(points, worlds, gradients=True).gradient
        assert gradient is not None
        return gradient.numpy()

    def _measured_probe(self, points, worlds, *, gradients: bool = False) -> FieldProbe:
        """Return a probe of the points with the present field."""
        self._check_solved()
        probe = self.probe(points, worlds=worlds, gradients=gradients)
        self.check_model()
        probe.measure()
        return probe

    def workload(self) -> Workload:
        """Return the time of each part of a step, and estimated times of each body and world.

        Parts of the last solve, such as neighbor search and field evaluations, are launched again on their own, on a
        GPU in graphs. The time of a body is estimated from its share of moments, of pairs, and of near cells: cells so
        close to a permanent magnet that its field is averaged over them. Bodies that fewer moments represent in all
        worlds are listed with these moments. The result of the last solve does not change. Waits for the device::

            magnetics.apply(state)
            print(magnetics.workload())

        Raises:
            InputError: There is no solve yet.
        """
        self._check_solved()
        self.check_model()
        return workload(self, self._placed if self._distant is None else self._distant.most_moments())

    def _check_solved(self) -> None:
        """Raise :class:`InputError` before the first solve, warn if the last one did not converge."""
        self._check_induced()
        self._warn_unconverged()

    def _check_induced(self) -> None:
        """Raise :class:`InputError` before the first solve; does not wait for the device."""
        if not self._induced:
            raise InputError("Magnetics: there is no field yet, call apply(state) or induce(state) first")

    def _refresh(self) -> None:
        """Check that there was a solve, and write the moments of worlds that it solved with fewer moments."""
        self._check_induced()
        if self._refresh_resting is not None:
            self._refresh_resting()

    def _warn_unconverged(self) -> None:
        """Warn if the last solve did not converge; waits for the device."""
        if self.converged.numpy().all():
            return
        error, count = float(self.error.numpy().max()), int(self.evaluations.numpy().max())
        text = f"Magnetics: did not converge, error {error:.2g} > rtol {self.rtol:g} after {count} evaluations"
        warn_caller(text, ConvergenceWarning)

    def energy(self) -> np.ndarray:
        """Return the energy of each world at the last solve [J], shape [worlds]; 0 for a world without magnets.

        It is the energy of all fields and of the magnetization curves. Only differences between poses are meaningful.
        Its negative gradient with respect to positions is the Kelvin force. Waits for the device.

        Raises:
            InputError: There is no solve yet, or the contact model is ``multipole``.
        """
        self._check_solved()
        self.check_model()
        energies = np.zeros(max(self._model.world_count, 1))
        energies[np.maximum(self._worlds, 0)] = (self._distant or self.system).energy()
        return energies

    def shape_moments(self) -> np.ndarray:
        """Return the total moment of each magnetic shape [A·m²], world frame, shape [n, 3]; order as in :attr:`shapes`.

        Where shapes of one body overlap, the common volume belongs to the first of them. Waits for the device.
        """
        self._check_solved()
        self.check_model()
        return self.sum_moments().numpy().copy()

    def sum_moments(self) -> wp.array:
        """Return :meth:`shape_moments` as a Warp array, which the next call overwrites; capturable in a graph."""
        self._refresh()
        return self._shape_moments.sum(self.system.moments)

    @property
    def summed_moments(self) -> wp.array:
        """The array that :meth:`sum_moments` writes [A·m²], on the device, shape [n]; zeros before the first call."""
        return self._shape_moments.totals

    def moments_at(self, state: newton.State) -> np.ndarray:
        """Return the total equilibrium moments at a state; present fields and later steps are not affected.

        Args:
            state: State with poses ``body_q``.

        Returns:
            Total moment of each magnetic shape [A·m²], world frame, shape [n, 3].
        """
        self._check_state(state, "body_q")
        fields = [array for system in self._systems for array in system.field_arrays()]
        kept, induced = KeptSolution(self._solutions(), fields), self._induced
        try:
            self.induce(state)
            self.check_model()
            self._warn_unconverged()
            return self.sum_moments().numpy().copy()
        finally:
            kept.restore()
            self._induced = induced
            if induced:
                (self._distant or self.system).evaluate_again()
                kept.restore()

    def start_from(self, magnetizations: dict[int, np.ndarray]) -> None:
        """Set the magnetizations that the next induction starts from.

        Args:
            magnetizations: Magnetization [A/m], world frame, shape [3], by index of magnetic shape. Permanent magnets
                keep their own. The other shapes start from zero.

        Raises:
            InputError: A shape has no magnet, or a magnetization is not three numbers of at most 1e30.
        """
        inducible = ~self._placed.table.permanent.numpy()
        start = self._shape_moments.spread(magnetizations, inducible)
        self.system.start_from(wp.array(start, dtype=wp.vec3, device=self._model.device))


def check_magnetics(magnetics: Magnetics, model: newton.Model) -> None:
    """Raise :class:`InputError` unless ``magnetics`` are the magnets of ``model``."""
    if not isinstance(magnetics, Magnetics):
        raise InputError(f"magnetics: must be a warpmag.Magnetics, got {short_repr(magnetics)}")
    if magnetics.model is not model:
        raise InputError("model, magnetics: the magnets belong to another model")
