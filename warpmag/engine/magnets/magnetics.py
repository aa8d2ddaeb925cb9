"""Magnetic forces on the bodies of a Newton model."""

from dataclasses import replace

import newton
import numpy as np
import numpy.typing as npt
import warp as wp

from warpmag.declarations import materials
from warpmag.declarations.checks import check_positive
from warpmag.declarations.curves import MagnetizationCurve
from warpmag.declarations.magnets import MagneticSettings
from warpmag.engine.magnets.attributes import NAMESPACE
from warpmag.engine.magnets.eddy import BodyEddies
from warpmag.engine.magnets.grouping import BodyMagnet, find_magnets
from warpmag.engine.magnets.magnet_system import KINEMATIC, make_system
from warpmag.engine.magnets.model_values import ModelValues, magnetic_arrays
from warpmag.engine.magnets.sources import ModelSources
from warpmag.errors import InputError
from warpmag.kernels.rigid.bodies import (
    BodyMoments,
    add_wrenches,
    gather_bias,
    gather_frames,
    gather_moments,
    gather_rotations,
    set_external_field,
    set_magnetization,
    sum_moments,
)
from warpmag.moments.arrays import (
    CallContext,
    Numbers,
    host_array,
    largest_coordinate,
    restore_snapshot,
    take_snapshot,
)
from warpmag.moments.probe import FieldProbe
from warpmag.moments.ranks import current_ranks
from warpmag.terminal import collection_paused


class Magnetics:
    """The magnets of a Newton model: finds the moments, brings the inducible ones to equilibrium, adds the forces.

    A ball is one moment, any other shape a lattice of moments whose total is exact. Moments of one body exert no force
    on each other, magnets of different worlds none either. Works with any solver that reads ``State.body_f``::

        state.clear_forces()
        magnetics.apply(state)
        solver.step(state, state_out, None, contacts, dt)

    Attributes:
        magnets: The magnets found, in the order of their moments.
        system: The moments on the device.
        shapes: The shapes that :meth:`shape_moments` reports, [n].
        shape_volumes: Magnetic volume of each of them [m³], what it shares with an earlier one left out, [n].
    """

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
        external_field: tuple[float, float, float] = (0.0, 0.0, 0.0),
        max_evaluations: int = 1000,
        curve: str | MagnetizationCurve | None = None,
        step: float = 1e-3,
    ):
        """Sample the magnets of ``model`` and allocate everything that :meth:`apply` needs.

        Args:
            model: A finished model with shapes marked by :func:`warpmag.add_inducible`, :func:`warpmag.add_permanent`.
            force: ``kelvin`` (Eqs. 13, 14) or ``zeeman`` (Eq. 4).
            dynamics: ``theta`` (exact flow, accelerated), ``theta-euler`` (the paper's explicit step), ``llg`` or
                ``llg-damping`` (Eq. 6, with and without precession).
            contact_model: ``dipole``, or ``multipole``, which adds what balls of one moment lack where they nearly
                touch.
            method: How fields and forces are summed: ``direct``, over all pairs; ``fmm``, by the fast multipole
                method, to an error that ``rtol`` allows; or ``auto``, the faster one.
            rtol: Relative magnetization error at which induction ends.
            external_field: Uniform applied field H0 [A/m], world frame.
            max_evaluations: Field evaluations after which induction gives up.
            curve: Magnetization curve of all magnets, as :func:`warpmag.add_inducible` takes it; by default their own.
            step: Longest time [s] between calls of :meth:`apply`, in which eddy currents stop nothing that conducts.

        Raises:
            InputError: The model has no magnets, a setting is out of range, or a magnet outside all worlds would be
                felt in several.
        """
        settings = MagneticSettings(external_field, force, dynamics, contact_model, rtol)
        if (all_ranks := current_ranks()) is not None:
            more = {"method": method, "max_evaluations": max_evaluations, "curve": curve, "step": step}
            all_ranks.check_equal(vars(settings) | more | magnetic_arrays(model), "Magnetics: ")
        settings.check("Magnetics")
        check_positive("Magnetics: step", step)
        if curve is not None:
            curve = materials.measured("Magnetics: curve", curve)
        self.magnets, self._worlds = find_magnets(model)
        self._model, self._values = model, ModelValues(model, measured=isinstance(curve, MagnetizationCurve))
        self._sources = ModelSources(model, self._worlds)
        self._induced = False
        self.system, celled, solid = make_system(
            model, self.magnets, settings, sources=self._sources.applied, curve=curve,
            method=method, max_evaluations=max_evaluations,
        )  # fmt: skip
        self._celled, self._solid_bodies = (
            wp.array(one, dtype=wp.int32, device=model.device) for one in (celled, solid)
        )
        self._sources.bind(self.system)
        self._map_bodies()
        self._eddies = BodyEddies(model, self.magnets, self._body_moments, self._sources, self.system, step)

    @property
    def device(self) -> wp.Device:
        """Device of the model."""
        return self.system.device

    @property
    def rtol(self) -> float:
        """Relative magnetization error at which induction ends."""
        return self.system.rtol

    @property
    def external_field(self) -> wp.array:
        """Uniform applied field H0 [A/m] at each moment on the device, world frame, shape [moments]."""
        return self.system.external_field

    @property
    def error(self) -> wp.array:
        """Relative magnetization error of the last solve, on the device, shape [worlds with magnets]."""
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
    def needs_velocities(self) -> bool:
        """Whether forces depend on velocities, ``State.body_qd``: they do where eddy currents flow."""
        return self.system.eddy is not None

    def field_error(self) -> float:
        """Return the relative error of the last field by the fast multipole method; 0 for sums over all pairs.

        Measured at 256 random magnets by sums over all pairs; waits for the device.
        """
        return self.system.field_error()

    def _map_bodies(self) -> None:
        """List for the kernels which moments belong to which body and to which shape."""
        device = self._model.device
        lattices = [one.lattice for one in self.magnets]
        counts = [len(one.volumes) for one in lattices]
        body = np.repeat([one.body for one in self.magnets], counts)
        permanent = np.repeat([one.magnet.fixed for one in self.magnets], counts)
        self._volumes = np.concatenate([one.volumes for one in lattices])
        self.shapes = np.concatenate([one.shapes for one in self.magnets])
        of_shape = np.concatenate([one.counts for one in lattices])

        start = np.concatenate([[0], np.cumsum(counts)])
        run_body = np.array([one.body for one in self.magnets])
        order = np.argsort(run_body, kind="stable")
        bodies, first = np.unique(run_body[order], return_index=True)
        dynamic = bodies >= 0

        def put(values, dtype):
            return wp.array(np.ascontiguousarray(values), dtype=dtype, device=device)

        self._body_moments = moments = BodyMoments()
        moments.body, moments.permanent = put(body, wp.int32), put(permanent, wp.bool)
        moments.local_positions = put(np.concatenate([one.positions for one in lattices]), wp.vec3)
        moments.volumes, moments.shape = put(self._volumes, float), put(np.repeat(self.shapes, of_shape), wp.int32)
        moments.shape_frames = self._model.shape_transform
        moments.magnetizations = getattr(self._model, NAMESPACE).magnetization
        recoil = np.repeat([one.magnet.recoil_permeability - 1.0 for one in self.magnets], counts)
        recoils = np.flatnonzero(np.repeat([one.magnet.recoils for one in self.magnets], counts))
        self._recoiling, self._coercivity = put(recoils, wp.int32), put(1.0 / recoil[recoils], float)
        moments.body_list = put(bodies[dynamic], wp.int32)
        moments.body_run_start = put(np.append(first[dynamic], len(order)), wp.int32)
        moments.runs = put(np.stack([start[:-1], start[1:]], axis=1)[order], wp.vec2i)
        moments.kinematic_flag = KINEMATIC

        self._parts = np.concatenate([[0], np.cumsum(of_shape)])
        volume = np.concatenate([[0.0], np.cumsum(self._volumes)])
        self.shape_volumes = np.diff(volume[self._parts])
        self._part_start = put(self._parts, wp.int32)
        self._totals = wp.zeros(len(self.shapes), dtype=wp.vec3, device=device)
        self._newton_world = put(np.maximum(self._worlds, 0)[self.system.worlds], wp.int32)
        fixed = np.repeat(
            [one.magnet.kind == "permanent" for one in self.magnets], [len(one.shapes) for one in self.magnets]
        )
        shape_body = self._model.shape_body.numpy()
        shapes = self.shapes[fixed]
        shapes = shapes[np.argsort(shape_body[shapes], kind="stable")]
        self._permanent_shapes, self._permanent_list = shapes, put(shapes, wp.int32)
        self._permanent_bodies = shape_body[shapes]

    def apply(self, state: newton.State) -> None:
        """Add the magnetic forces at the poses of ``state`` to ``state.body_f``; capturable in a graph.

        Args:
            state: State with poses ``body_q``; its ``body_f`` is added to, not cleared.

        Raises:
            InputError: ``model.warpmag`` has changed, see :meth:`notify_model_changed`; on a GPU some steps later.
        """
        self.induce(state)
        self.add_forces(state)

    def induce(self, state: newton.State) -> None:
        """Bring the inducible magnets to equilibrium at the poses of ``state``, starting from where they were."""
        values, system = self._values, self.system
        self._induced = True
        gather_moments(
            *(state.body_q, self._body_moments, values.now, values.then, system.positions, system.moments),
            values.changed,
        )
        values.check(wait=False)
        if self.system.rotations is not None:
            gather_rotations(state.body_q, self._celled, self.system.rotations)
        self._sources.gather(state.body_q)
        if len(self._solid_bodies):
            gather_frames(state.body_q, self._solid_bodies, self.system.sources.solid_frames)
        if len(self._recoiling):
            gather_bias(state.body_q, self._body_moments, self._recoiling, self._coercivity, self.system.bias)
        self._eddies.gather(state)
        self.system.solve()

    def add_forces(self, state: newton.State) -> None:
        """Add the forces of the present moments to ``state.body_f``: the second half of :meth:`apply`."""
        self.system.apply_forces()
        system = self.system
        add_wrenches(self._body_moments, self._model, state, system.positions, system.forces, system.torques)
        self._sources.add_reactions(state)

    def notify_model_changed(self, flags: newton.ModelFlags | int = newton.ModelFlags.SHAPE_PROPERTIES) -> None:
        """Take over what was changed in ``model.warpmag``, as Newton's solvers do for what they keep.

        Saturations and susceptibilities can be changed so; graphs that were captured stay right. A change of which
        nobody tells is refused at the next step. Magnetizations count in any case.

        Args:
            flags: What was changed: nothing happens without ``SHAPE_PROPERTIES``.

        Raises:
            InputError: A material is out of range, the contact model has tables of it, or what cannot be changed was:
                which shapes are magnets, of which kind, with which curve, or how far their moments are apart.
        """
        if not int(flags) & int(newton.ModelFlags.SHAPE_PROPERTIES):
            return
        changed = self._values.changed_materials()
        moment_shapes = self._body_moments.shape.numpy()
        made = np.isin(moment_shapes, changed) & ~self._body_moments.permanent.numpy()
        made[self._recoiling.numpy()] = False
        moments = np.flatnonzero(made)
        self.system.set_material(moments, *self._values.material(moment_shapes[moments]))
        self.magnets = [self._with_material(one) for one in self.magnets]
        self._values.take()

    def _with_material(self, one: BodyMagnet) -> BodyMagnet:
        """The same magnet, of the material that its first shape has now."""
        (saturation,), (susceptibility,) = self._values.material(list(one.shapes[:1]))
        magnet = replace(one.magnet, saturation=float(saturation), susceptibility=float(susceptibility))
        return replace(one, magnet=magnet)

    def carried(self) -> dict[str, wp.array]:
        """Return the arrays by which a later step goes on as it would, by name: what was set, and what a solve left."""
        given, system = getattr(self._model, NAMESPACE), self.system
        values = {"magnetization": given.magnetization, "strength": given.strength, "field": system.external_field}
        return values | self._values.carried() | system.carried()

    def check_model(self) -> None:
        """Raise :class:`InputError` if ``model.warpmag`` has changed meanwhile; waits for the device."""
        self._values.check(wait=True)

    def set_external_field(self, external_field: Numbers) -> None:
        """Set the uniform applied field of all worlds, or of each; capturable in a graph if given as a Warp array.

        Args:
            external_field: H0 [A/m], world frame, shape [3] or [worlds, 3], rows by the model's worlds; NumPy, or a
                Warp array of vectors on the model's device, shape [1] or [worlds], whose values are not checked.

        Raises:
            InputError: It is of another shape, or not finite.
        """
        field = self._vectors("external_field", external_field, (1, max(self._model.world_count, 1)))
        set_external_field(field, self._newton_world, self.system.external_field)

    def set_current(self, coil: int | str, ampere_turns: Numbers) -> None:
        """Set the current of coils; after a first call capturable in a graph, if given as a Warp array.

        It is the model's attribute ``model.warpmag.strength`` that is set. Who writes there has the same effect. Of a
        field map it is the factor of its field.

        Args:
            coil: The coil, as :func:`warpmag.add_coil` returned it if the model has no other builder's, or a pattern of
                labels as in a shell: coils of replicated worlds have one label, and are in the order of worlds.
            ampere_turns: Current times turns [A], one number, or one for each of the coils, shape [coils]; NumPy, or a
                Warp array of float32 on the model's device, whose values are not checked.

        Raises:
            InputError: There is no such coil, or there are other numbers than coils, or one is not finite.
        """
        self._sources.set_strength("set_current", coil, ampere_turns)

    def set_magnetization(self, magnetization: Numbers, *, body: int = -1, shape: int | None = None) -> None:
        """Set what a permanent magnet is magnetized to; capturable in a graph if given as a Warp array.

        It is the model's attribute ``model.warpmag.magnetization`` that is set, in the frame of each shape. Who writes
        there has the same effect.

        Args:
            magnetization: M [A/m] in the frame of the body, of the shape if that is static, shape [3]; NumPy, or a Warp
                array of one vector on the model's device, whose value is not checked.
            body: The body, with all its permanent shapes.
            shape: Instead of these only this one.

        Raises:
            InputError: There is no such permanent magnet, or the magnetization is of another shape, or not finite.
        """
        which = self._permanent_bodies == body if shape is None else self._permanent_shapes == shape
        found = np.flatnonzero(which)
        if not len(found) or (shape is None and body < 0):
            raise InputError(f"set_magnetization: {'body' if shape is None else 'shape'} has no permanent magnet")
        shapes = self._permanent_list[int(found[0]) : int(found[-1]) + 1]
        set_magnetization(self._vectors("magnetization", magnetization, (1,)), shapes, self._model, self._body_moments)

    def _vectors(self, name: str, value, counts: tuple[int, ...]) -> wp.array:
        """Vectors on the model's device, as many as one of ``counts``, from a Warp array or from numbers."""
        if isinstance(value, wp.array):  # only looked at from outside: it may be in a graph
            if value.dtype is not wp.vec3 or value.ndim != 1 or value.device != self._model.device:
                raise InputError(f"{name}: must be a Warp array of vec3 on {self._model.device}")
            found = value
        else:
            context = CallContext(wp.get_device(self._model.device), wp.float32, warp_out=False)
            found = context.vectors(name, np.atleast_2d(host_array(name, value)))
        if len(found) not in counts:
            wanted = " or ".join(f"[{count}, 3]" for count in dict.fromkeys(counts))
            raise InputError(f"{name}: shape must be [3] or {wanted}, got {list(np.shape(value))}")
        return found

    def probe(self, points: Numbers, *, worlds: npt.ArrayLike | None = None, gradients: bool = False) -> FieldProbe:
        """Return what measures the field at points; :meth:`FieldProbe.measure` is capturable in a graph.

        Args:
            points: The points [m], shape [p, 3], NumPy, or a Warp array of vectors on the model's device.
            worlds: World of the model that each is in, a number or shape [p]; None means the only one with magnets.
            gradients: Whether gradients are wanted.

        Raises:
            InputError: A point is not finite, or too far away (see ``warpmag.moments.arrays``), or its world holds no
                magnets.
        """
        largest = max(float(one.lattice.radii.max()) for one in self.magnets)
        context = CallContext(self.system.device, self.system.dtype, warp_out=False)
        points = context.vectors("points", points, farthest=largest_coordinate(self.system.dtype, largest))
        probe = FieldProbe(self.system, len(points), worlds=self._numbers_of(worlds, len(points)), gradients=gradients)
        wp.copy(probe.points, points)
        return probe

    def _numbers_of(self, worlds, count: int) -> np.ndarray:
        """Number of each point's world among those that hold magnets, shape [count]."""
        if worlds is None:
            if len(self._worlds) > 1:
                raise InputError(f"worlds: must be given, {len(self._worlds)} worlds hold magnets")
            return np.zeros(count, int)
        worlds = np.asarray(worlds)
        if worlds.dtype.kind not in "iu" or worlds.shape not in ((), (count,)):
            raise InputError(
                f"worlds: must be whole numbers, one or {count}, got {worlds.dtype} of {list(worlds.shape)}"
            )
        strangers = worlds[~np.isin(worlds, self._worlds)]
        if strangers.size:
            raise InputError(f"worlds: world {strangers.flat[0]} holds no magnets")
        return np.broadcast_to(np.searchsorted(self._worlds, worlds), count)

    def h_field(self, points: Numbers, *, worlds: npt.ArrayLike | None = None) -> np.ndarray:
        """Return the field H [A/m] at points, shape [p, 3], as :meth:`probe` measures it."""
        return self._measured(points, worlds).h.numpy()

    def b_field(self, points: Numbers, *, worlds: npt.ArrayLike | None = None) -> np.ndarray:
        """Return the flux density B [T] at points, inside bodies too, shape [p, 3], as :meth:`probe` measures it."""
        return self._measured(points, worlds).b.numpy()

    def field_gradient(self, points: Numbers, *, worlds: npt.ArrayLike | None = None) -> np.ndarray:
        """Return the gradient ∂H_i/∂x_k [A/m²] at points, shape [p, 3, 3], as :meth:`probe` measures it."""
        gradient = self._measured(points, worlds, gradients=True).gradient
        assert gradient is not None
        return gradient.numpy()

    def _measured(self, points, worlds, *, gradients: bool = False) -> FieldProbe:
        if not self._induced:
            raise InputError("Magnetics: nothing is to be measured yet, call apply(state) or induce(state) first")
        probe = self.probe(points, worlds=worlds, gradients=gradients)
        self.check_model()
        probe.measure()
        return probe

    def energy(self) -> np.ndarray:
        """Return the energy of the magnets of each world as they are now [J], shape [worlds]; zero without magnets.

        See :meth:`MomentSystem.energy`: its gradient by positions is minus Kelvin's force.
        """
        self.check_model()
        energies = np.zeros(max(self._model.world_count, 1))
        energies[np.maximum(self._worlds, 0)] = self.system.energy()
        return energies

    def shape_moments(self) -> np.ndarray:
        """Return the total moment of each magnetic shape [A·m²], world frame, rows as :attr:`shapes`, shape [n, 3].

        Where shapes of one body overlap, the common volume belongs to the first of them.
        """
        self.check_model()
        return self.sum_moments().numpy()

    def sum_moments(self) -> wp.array:
        """Return what :meth:`shape_moments` does, on the device, in an array that the next call overwrites."""
        sum_moments(self._part_start, self.system.moments, self._totals)
        return self._totals

    def moments_at(self, state: newton.State) -> np.ndarray:
        """Return what :meth:`shape_moments` is once :meth:`induce` has been called; nothing goes on differently for it.

        Args:
            state: State with poses ``body_q``.

        Returns:
            Total moment of each magnetic shape in equilibrium at these poses [A·m²], world frame, shape [n, 3].
        """
        carried = self.system.carried()
        before = take_snapshot(carried)
        self.induce(state)
        moments = self.shape_moments().copy()
        restore_snapshot(carried, before)
        return moments

    def start_from(self, magnetizations: dict[int, np.ndarray]) -> None:
        """Let induction start from given magnetizations.

        Args:
            magnetizations: Magnetization [A/m], world frame, of inducible shapes; of the others zero.
        """
        start = np.zeros((len(self._volumes), 3))
        inducible = ~self._body_moments.permanent.numpy()
        for part, shape in enumerate(self.shapes.tolist()):
            rows = slice(self._parts[part], self._parts[part + 1])
            if shape in magnetizations and inducible[rows].all():
                start[rows] = magnetizations[shape]
        self.system.start_from(wp.array(start, dtype=wp.vec3, device=self._model.device))
