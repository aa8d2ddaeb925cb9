"""Gradients of functions of the fields, forces and torques of permanent bodies near other magnets.

The corrections of permanent bodies (``solids.h``) have the energy U = −μ0 Σ m·C of moments m in their fields C, and
that between bodies. Forces are −∂U/∂q with respect to the poses q. Let v be the motion with the velocities a and the
angular velocities b, the cotangents of forces and torques. Then L = Σ a·F + b·τ is −dU along v, and as second
derivatives commute, gradients of L are derivatives along v:

| gradient | derivative along v | added |
|---|---|---|
| by the position of a moment or of a body's first moment | of the force F | |
| by the rotation of a body about its first moment | of the torque τ | τ × b |
| by a moment | of μ0 C | μ0 C × b |

The added terms are there because rotations do not commute, and because the motion of a moment, b × m, depends on the
moment. A function Σ η·C of the field in the induction is that of moments η: its gradients are the forces and torques of
η, over μ0. Both are linear in the magnetization of each body, so that two values give its gradient.

Derivatives along v are central differences in double precision, along a motion of a millionth of a body. Forces between
two bodies are sums over points, whose second derivatives commute only about: ``body_pair_gradients`` adds the rest.
"""

from dataclasses import replace
from functools import cache

import numpy as np
import warp as wp

from warpmag.kernels.applied.body_pair_gradients import BodyPairGradients
from warpmag.kernels.applied.fields import AppliedForces
from warpmag.kernels.applied.sources import FieldSources
from warpmag.kernels.pairs.packing import PackedMoments
from warpmag.kernels.pairs.wrench import MU0

_STEP = 1e-6  # largest motion, over the mean radius of the bodies' bounding spheres
_UNIT = 1e6  # magnetization [A/m] at which linear functions are evaluated


@wp.struct
class SolidState:
    """Moments and permanent bodies in double precision, and the motion along which their forces are differentiated."""

    world: wp.array[int]  # world of each moment, shape [n]
    solid: wp.array[int]  # permanent body of each moment, or -1, shape [n]
    first: wp.array[int]  # first moment of each body, shape [bodies]
    number: wp.array[int]  # number of each body in its world, shape [bodies]
    volume: wp.array[wp.float64]  # volume of each moment of a body [m³], 0 for other moments, shape [n]
    length: wp.float64  # mean radius of the bodies [m]
    positions: wp.array[wp.vec3d]  # shape [n]
    moments: wp.array[wp.vec3d]  # shape [n]
    frames: wp.array[wp.transformd]  # shape [bodies]
    velocity: wp.array[wp.vec3d]  # a, shape [n]
    rotation: wp.array[wp.vec3d]  # b, shape [n]
    by_field: wp.array[wp.vec3d]  # η, shape [n]
    fastest: wp.array[wp.float64]  # largest |a| + length |b| of each world, shape [worlds]


@wp.func
def _step_of(state: SolidState, i: int):
    """Time step of the motion of moment ``i``, 0 in a world without motion."""
    fastest = state.fastest[state.world[i]]
    return wp.where(fastest > wp.float64(0.0), wp.float64(wp.static(_STEP)) * state.length / fastest, wp.float64(0.0))


@cache
def _load_kernel(dtype):
    vec3 = wp.types.vector(3, dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def load_vectors(values: wp.array[vec3], out: wp.array[wp.vec3d]):
        out[wp.tid()] = wp.vec3d(values[wp.tid()])

    return load_vectors


@cache
def _load_frames_kernel(dtype):
    @wp.kernel(module="unique", enable_backward=False)
    def load_frames(values: wp.array[wp.types.transformation(dtype)], out: wp.array[wp.transformd]):
        k = wp.tid()
        rotation = wp.quatd(wp.transform_get_rotation(values[k]))
        out[k] = wp.transformation(wp.vec3d(wp.transform_get_translation(values[k])), rotation)

    return load_frames


@cache
def _add_kernel(dtype):
    vec3 = wp.types.vector(3, dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def add_vectors(values: wp.array[wp.vec3d], out: wp.array[vec3]):
        i = wp.tid()
        out[i] = out[i] + vec3(values[i])

    return add_vectors


@wp.kernel(module="unique", enable_backward=False)
def _find_fastest(state: SolidState):
    i = wp.tid()
    speed = wp.length(state.velocity[i]) + state.length * wp.length(state.rotation[i])
    wp.atomic_max(state.fastest, state.world[i], speed)


@wp.kernel(module="unique", enable_backward=False)
def _move(
    state: SolidState,
    sign: wp.float64,
    positions_out: wp.array[wp.vec3d],
    moments_out: wp.array[wp.vec3d],
    frames_out: wp.array[wp.transformd],
):
    i = wp.tid()
    k = state.solid[i]
    leader = i
    if k >= 0:
        leader = state.first[k]
    step = sign * _step_of(state, i)
    turn = step * state.rotation[leader]
    rotation = wp.quat_from_axis_angle(wp.normalize(turn), wp.length(turn))
    origin = state.positions[leader]
    moved = origin + step * state.velocity[leader]
    positions_out[i] = moved + wp.quat_rotate(rotation, state.positions[i] - origin)
    moments_out[i] = wp.quat_rotate(rotation, state.moments[i])
    if k >= 0 and i == leader:
        place = moved + wp.quat_rotate(rotation, wp.transform_get_translation(state.frames[k]) - origin)
        frames_out[k] = wp.transformation(place, rotation * wp.transform_get_rotation(state.frames[k]))


@wp.kernel(module="unique", enable_backward=False)
def _add_difference(
    state: SolidState,
    sign: wp.float64,
    forces: wp.array[wp.vec3d],
    torques: wp.array[wp.vec3d],
    field: wp.array[wp.vec3d],
    by_positions: wp.array[wp.vec3d],
    by_moments: wp.array[wp.vec3d],
    by_rotations: wp.array[wp.vec3d],
):
    i = wp.tid()
    step = _step_of(state, i)
    if step == wp.float64(0.0):
        return
    factor = sign / (wp.float64(2.0) * step)
    k = state.solid[i]
    if k < 0:
        by_positions[i] += factor * forces[i]
        by_moments[i] += (factor * wp.float64(wp.static(MU0))) * field[i]
    elif i == state.first[k]:
        by_positions[i] += factor * forces[i]
        by_rotations[k] += factor * torques[i]


@wp.kernel(module="unique", enable_backward=False)
def _add_commutators(
    state: SolidState,
    torques: wp.array[wp.vec3d],
    field: wp.array[wp.vec3d],
    by_moments: wp.array[wp.vec3d],
    by_rotations: wp.array[wp.vec3d],
):
    i = wp.tid()
    k = state.solid[i]
    if k < 0:
        by_moments[i] += wp.float64(wp.static(MU0)) * wp.cross(field[i], state.rotation[i])
    elif i == state.first[k]:
        by_rotations[k] += wp.cross(torques[i], state.rotation[i])


@wp.kernel(module="unique", enable_backward=False)
def _set_field_cotangents(state: SolidState, sign: wp.float64, effective: wp.array2d[wp.float64]):
    i = wp.tid()
    for c in range(3):
        effective[c, i] = sign * state.by_field[i][c]


@wp.kernel(module="unique", enable_backward=False)
def _add_field_gradients(
    state: SolidState,
    sign: wp.float64,
    forces: wp.array[wp.vec3d],
    torques: wp.array[wp.vec3d],
    by_positions: wp.array[wp.vec3d],
    by_rotations: wp.array[wp.vec3d],
):
    i = wp.tid()
    factor = sign / wp.float64(wp.static(2.0 * MU0))
    by_positions[i] += factor * forces[i]
    k = state.solid[i]
    if k >= 0 and i == state.first[k]:
        by_rotations[k] += factor * torques[i]


@wp.kernel(module="unique", enable_backward=False)
def _magnetize(state: SolidState, number: int, magnetization: wp.vec3d, moments_out: wp.array[wp.vec3d]):
    i = wp.tid()
    k = state.solid[i]
    if k >= 0:
        if state.number[k] == number:
            moments_out[i] = state.volume[i] * magnetization


@wp.kernel(module="unique", enable_backward=False)
def _add_magnetization_gradients(
    state: SolidState,
    owners: wp.array[int],
    forces: wp.array[wp.vec3d],
    torques: wp.array[wp.vec3d],
    field: wp.array[wp.vec3d],
    unit: wp.vec3d,
    by_magnetizations: wp.array[wp.vec3d],
):
    i = wp.tid()
    owner = owners[state.world[i]]
    if owner < 0:
        return
    value = wp.dot(state.velocity[i], forces[i])
    if state.solid[i] < 0:
        turned = wp.cross(state.moments[i], field[i])
        value += wp.float64(wp.static(MU0)) * wp.dot(state.rotation[i], turned) + wp.dot(state.by_field[i], field[i])
    else:
        value += wp.dot(state.rotation[i], torques[i])
    wp.atomic_add(by_magnetizations, owner, value * unit)


@cache
def _split_kernel(dtype):
    vec3 = wp.types.vector(3, dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def split_rotations(
        state: SolidState,
        by_magnetizations: wp.array[wp.vec3d],
        by_moments: wp.array[vec3],
        by_rotations: wp.array[vec3],
    ):
        k = wp.tid()
        i = state.first[k]
        gradient = by_magnetizations[k] / state.volume[i]
        by_moments[i] = by_moments[i] + vec3(gradient)
        by_rotations[k] = by_rotations[k] - vec3(wp.cross(state.moments[i], gradient))

    return split_rotations


class SolidGradients:
    """Gradients of a function of what permanent bodies do near other magnets, evaluated repeatedly in the same arrays.

    Args:
        interaction: The fields and forces of permanent bodies.
        worlds: World of each moment, NumPy, shape [n].
        labels: Body of each moment, Warp array, shape [n].

    Attributes:
        frames: State: frames of the bodies, as ``sources.solid_frames``; written by the caller.
        by_rotations: Gradients by small rotations of the bodies about their first moments; launches add to them,
            shape [bodies].
    """

    def __init__(self, interaction: AppliedForces, worlds, labels):
        """Allocate the buffers."""
        sources, device = interaction.sources, interaction.device
        self._dtype, self._device, self._count = sources.dtype, device, interaction.count
        self._worlds, self._solids = np.asarray(worlds), sources.solids
        packed = sources.packed
        radii = wp.array(packed.radii.numpy(), dtype=wp.float64, device=device)
        self._packed = PackedMoments(
            radii, largest_radius=packed.largest_radius, labels=labels.numpy(), groups=worlds, moving=False
        )
        solids = [replace(solid, movable=True) for solid in sources.solids]
        self._sources = FieldSources((), solids, self._packed, sources.world_count)
        zero = wp.zeros(self._count, dtype=wp.vec3d, device=device)
        all_moments = np.ones(self._count, bool)
        self._forces = AppliedForces(self._sources, self._worlds, zero, all_moments, all_moments)
        self._effective = self._packed.vectors()
        self._state = self._allocate()
        names = "positions", "moments", "forces", "torques", "by_positions", "by_moments"
        self._moved, self._moments, self._force, self._torque, self._by_positions, self._by_moments = (
            wp.zeros(self._count, dtype=wp.vec3d, device=device) for _ in names
        )
        self._by_rotations, self._by_magnetizations = (
            wp.zeros(len(solids), dtype=wp.vec3d, device=device) for _ in range(2)
        )
        motion = self._state.velocity, self._state.rotation
        self._pairs = BodyPairGradients(
            self._forces.arrays, self._sources.solid_worlds, *motion, self._by_positions, self._by_rotations
        )
        self.frames = wp.clone(sources.solid_frames)
        self.by_rotations = wp.zeros(len(solids), dtype=wp.types.vector(3, self._dtype), device=device)

    def _allocate(self) -> SolidState:
        """Return the state, with the layout of the bodies."""
        state, device, solids, n = SolidState(), self._device, self._solids, self._count
        solid, volume = np.full(n, -1), np.zeros(n)
        for number, body in enumerate(solids):
            solid[body.first : body.first + body.count] = number
            if not body.has_few_moments:
                volume[body.first : body.first + body.count] = body.moments.volumes
        worlds = self._sources.solid_worlds
        numbers = np.arange(len(solids)) - np.searchsorted(worlds, worlds)

        def integers(values):
            return wp.array(np.ascontiguousarray(values, np.int32), dtype=wp.int32, device=device)

        state.world, state.solid = integers(self._worlds), integers(solid)
        state.first, state.number = integers([body.first for body in solids]), integers(numbers)
        owners = np.full((numbers.max() + 1, self._sources.world_count), -1)
        owners[numbers, worlds] = np.arange(len(solids))
        self._owners = [integers(row) for row in owners]  # body of each number in each world
        state.volume = wp.array(volume, dtype=wp.float64, device=device)
        state.length = float(np.mean([body.size()[3] for body in solids]))
        for name in ("positions", "moments", "velocity", "rotation", "by_field"):
            setattr(state, name, wp.zeros(n, dtype=wp.vec3d, device=device))
        state.frames = wp.zeros(len(solids), dtype=wp.transformd, device=device)
        state.fastest = wp.zeros(self._sources.world_count, dtype=wp.float64, device=device)
        return state

    def load(self, positions, moments) -> None:
        """Set positions [m] and moments [A·m²] at which gradients are computed, shape [n] each."""
        self._load(positions, self._state.positions)
        self._load(moments, self._state.moments)
        self.by_rotations.zero_()

    def launch_wrench(self, force_cotangents, torque_cotangents, by_positions, by_moments) -> None:
        """Launch the gradients of forces and torques, from a and b, shape [n] each.

        Those by positions and moments are added, shape [n] each, and those by rotations to ``by_rotations``.
        """
        state = self._state
        kernel = _load_frames_kernel(self._dtype)
        wp.launch(kernel, len(self.frames), inputs=[self.frames], outputs=[state.frames], device=self._device)
        self._load(force_cotangents, state.velocity)
        self._load(torque_cotangents, state.rotation)
        state.fastest.zero_()
        self._launch(_find_fastest)
        for total in (self._by_positions, self._by_moments, self._by_rotations):
            total.zero_()
        for sign in (1.0, -1.0):
            self._evaluate(sign)
            results = self._force, self._torque, self._forces.acting
            self._launch(_add_difference, sign, *results, self._by_positions, self._by_moments, self._by_rotations)
        self._evaluate(0.0)
        self._launch(_add_commutators, self._torque, self._forces.acting, self._by_moments, self._by_rotations)
        self._pairs.launch()
        self._add(self._by_positions, by_positions)
        self._add(self._by_moments, by_moments)
        self._add(self._by_rotations, self.by_rotations)

    def launch_field(self, by_field, by_positions) -> None:
        """Launch the gradients of the field in the induction, from η, shape [n]; results as above.

        Follows :meth:`launch_wrench`, at the same state.
        """
        self._load(by_field, self._state.by_field)
        self._by_positions.zero_()
        self._by_rotations.zero_()
        for sign in (1.0, -1.0):  # half the difference leaves out the wrenches between bodies
            self._launch(_set_field_cotangents, sign, self._effective)
            self._evaluate(0.0, self._effective)
            results = self._force, self._torque, self._by_positions, self._by_rotations
            self._launch(_add_field_gradients, sign, *results)
        self._add(self._by_positions, by_positions)
        self._add(self._by_rotations, self.by_rotations)

    def launch_magnetizations(self, by_moments) -> None:
        """Launch the gradients by the magnetizations of all bodies, and add them to those by their first moments.

        Follows :meth:`launch_field`. The rotations of the magnetizations are no longer part of ``by_rotations``, but
        follow from the gradients by moments. Takes six evaluations for each body of a world. No body may have few
        moments (``SolidMagnet.has_few_moments``).
        """
        state, unit = self._state, _UNIT * np.eye(3)
        self._by_magnetizations.zero_()
        for number, owners in enumerate(self._owners):
            for axis in (*unit, *-unit):
                self._launch(_move, 0.0, self._moved, self._moments, self._sources.solid_frames)
                self._launch(_magnetize, number, wp.vec3d(*axis), self._moments)
                self._evaluate_moved()
                results, weight = (self._force, self._torque, self._forces.acting), wp.vec3d(*axis / (2.0 * _UNIT**2))
                self._launch(_add_magnetization_gradients, owners, *results, weight, self._by_magnetizations)
        inputs = [state, self._by_magnetizations, by_moments, self.by_rotations]
        wp.launch(_split_kernel(self._dtype), len(self._solids), inputs=inputs, device=self._device)

    def _evaluate(self, sign: float, effective=None) -> None:
        """Launch forces, torques and fields, at the state moved by a step of the motion times ``sign``."""
        self._launch(_move, sign, self._moved, self._moments, self._sources.solid_frames)
        self._evaluate_moved(effective)

    def _evaluate_moved(self, effective=None) -> None:
        """Launch forces, torques and fields at the moved state."""
        self._packed.pack(self._moved, self._moments)
        self._force.zero_()
        self._torque.zero_()
        self._forces.launch()
        self._forces.add(self._packed.moments if effective is None else effective, self._force, self._torque)

    def _launch(self, kernel, *arguments) -> None:
        """Launch a kernel for all moments."""
        wp.launch(kernel, self._count, inputs=[self._state, *arguments], device=self._device)

    def _load(self, values, out) -> None:
        """Copy vectors to double precision."""
        wp.launch(_load_kernel(self._dtype), len(out), inputs=[values], outputs=[out], device=self._device)

    def _add(self, values, out) -> None:
        """Add vectors of double precision."""
        wp.launch(_add_kernel(self._dtype), len(out), inputs=[values], outputs=[out], device=self._device)
