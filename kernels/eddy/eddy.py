"""Braking forces and torques of eddy currents in conducting balls that move through the field.

**One ball.** In a slowly varying field, with B uniform inside, a ball of conductivity σ and radius R has the electric
field E = −½ (dB/dt) × r. With J = σE follow the dissipated power and the moment (L. D. Landau and E. M. Lifshitz,
Electrodynamics of Continuous Media, §59, in the limit of low frequency):

    P = ∫ J·E dV = c |dB/dt|²,    ½ ∫ r × J dV = −c dB/dt,    c = (2π/15) σ R⁵.

dB/dt is taken in the frame that rotates with the ball at ω, and B is the field inside. With H the field of all other
moments, B = μ0 (H + ⅔ M) and M = f(H). With the curve's derivative f' (``material.curves``)

    dB/dt = μ0 N (dH/dt − ω × H),    N = 1 + ⅔ f'(H).

N is 3 μr/(μr + 2) in weak fields, and 1 along the field of a saturated ball; a rotating field still rotates M. A
permanent ball has N = 1.

**Motion.** dH/dt follows from the motion of bodies. Moments m_j, fixed in their bodies, contribute
Σ [(v_i − v_j)·∇ H_ij + H of ω_j × m_j]; sources fixed in the world contribute v_i·∇H. Rayleigh's dissipation function
D = ½ Σ c_i |dB_i/dt|² is then invariant under common translation and rotation of all bodies. So the forces −∂D/∂v and
torques −∂D/∂ω conserve momentum and angular momentum, and dissipate the power 2D. They are the forces and torques of
eddy moments

    e_i = −c_i N dB_i/dt

in the field of all moments, and of all moments in the field of e. So the sums over pairs that compute forces use m + e.
Only the torque on inducible balls needs a separate sum, since the moments alone exert none.

**Neglected** are the skin effect, changes of the applied field other than by motion, and the response of neighbors'
magnetizations to the change of the field: they move and rotate with their balls.

**Time steps.** Explicit forces overshoot if they would stop the ball within a step Δt. Therefore c is replaced by
c / (1 + 2 Δt c K). K bounds the decay rate of the motion due to the braking forces. It is |N|² times a sum over the
bodies of the ball and of all sources: the squared gradient of B over the mass, plus the square of B over the moment of
inertia.
"""

import itertools
from functools import cache

import numpy as np
import warp as wp

from warpmag.kernels.material.curves import CurveParameters, curve_derivative_times, curve_ratio, curve_slope
from warpmag.kernels.pairs.pair_law import INVERSE_4PI
from warpmag.kernels.pairs.wrench import MU0
from warpmag.kernels.shared.native import CHUNK, PASS_ARGUMENTS, native_kernel, native_options
from warpmag.kernels.shared.team import launch_passes, threads_for

_RATES, _FIELDS = range(2)  # the passes; as in ``rates.h``
_FIELD_ROWS = 13  # rows at a conductor: 4π times H, dH/dt and ∇H (xx, yy, zz, xy, yz, zx); the sources' part of K/|N|²
MOTION_ROWS = 8
"""Rows: velocity [m/s], angular velocity [rad/s] of a moment; 1/mass [1/kg], 1/inertia [1/(kg·m²)] of its body."""
_GROUP = 32  # threads of a GPU that share a ball
_PAIRS_PER_THREAD = 10000  # pairs per thread of a CPU, at least


@cache
def _arrays_type(dtype):
    """Struct of conducting balls, the inducible balls of their worlds, and all moments."""
    vec3 = wp.types.vector(3, dtype)

    @wp.struct
    class EddyArrays:
        # Model: conductors, and inducible balls whose torque is computed, in padded chunks of CHUNK balls of one world
        ball: wp.array[int]  # moment of each slot of the chunks
        slot: wp.array[int]  # slot of each conductor
        chunk: wp.array[wp.vec4i]  # number of balls, range of moments of their world
        torque_ball: wp.array[int]  # the same arrays for inducible balls
        torque_slot: wp.array[int]
        torque_chunk: wp.array[wp.vec4i]  # number of balls, range of conductors of their world
        conductor: wp.array[int]  # moment of each conductor
        torque_conductor: wp.array[int]  # conductor of each inducible ball, or -1
        # Model: material of each moment
        conductivity: wp.array[dtype]  # [S/m]
        inducible: wp.array[int]
        saturation: wp.array[dtype]
        slope: wp.array[dtype]
        curve: wp.array[int]
        tables: wp.array2d[dtype]
        # Data in:
        motion: wp.array2d[dtype]  # rows of MOTION_ROWS
        # Data in and out:
        packed: wp.array2d[dtype]
        # Data out:
        at_conductor: wp.array2d[dtype]  # rows of _FIELD_ROWS at conductors
        h: wp.array[vec3]  # field at conductors [A/m]
        eddy: wp.array2d[dtype]  # eddy moments [A·m²]
        field: wp.array2d[dtype]  # 4π times the field of eddy moments at inducible balls

    return EddyArrays


@cache
def _passes(dtype, group: int):
    call = "eddy_passes(thread, first, last, threads, team.data, arrays)"
    arguments = {**PASS_ARGUMENTS, "arrays": _arrays_type(dtype)}
    return native_kernel(call, "eddy/rates.h", arguments, dtype=dtype, MU0_4PI=MU0 * INVERSE_4PI, GROUP=group)


@cache
def _field_readers(dtype):
    """Warp functions that read a vector from three rows of a table, and 4π times the field gradient at a conductor."""
    vec3, mat33 = wp.types.vector(3, dtype), wp.types.matrix((3, 3), dtype)

    @wp.func
    def vector_at(rows: wp.array2d[dtype], row: int, i: int):
        return vec3(rows[row, i], rows[row + 1, i], rows[row + 2, i])

    @wp.func
    def gradient(at_conductor: wp.array2d[dtype], i: int):
        xx, yy, zz = at_conductor[6, i], at_conductor[7, i], at_conductor[8, i]
        xy, yz, zx = at_conductor[9, i], at_conductor[10, i], at_conductor[11, i]
        return mat33(xx, xy, zx, xy, yy, yz, zx, yz, zz)

    return vector_at, gradient


@cache
def _eddy_kernel(dtype):
    vec3, eddy_arrays = wp.types.vector(3, dtype), _arrays_type(dtype)
    vector_at, gradient = _field_readers(dtype)
    coefficient, two_thirds, mu0, inverse_4pi = (dtype(x) for x in (2.0 * np.pi / 15.0, 2.0 / 3.0, MU0, INVERSE_4PI))

    @wp.kernel(module="unique", enable_backward=False, module_options=native_options("material/curves.h", dtype=dtype))
    def add_eddy_moments(
        arrays: eddy_arrays,
        applied: wp.array[vec3],
        applied_rates: wp.array[vec3],
        along_x: wp.array[vec3],
        along_y: wp.array[vec3],
        along_z: wp.array[vec3],
        step: dtype,
        effective: wp.array2d[dtype],
    ):
        slot = arrays.slot[wp.tid()]
        i = arrays.ball[slot]
        h = inverse_4pi * vector_at(arrays.at_conductor, 0, slot) + applied[i]
        rate = inverse_4pi * vector_at(arrays.at_conductor, 3, slot) - wp.cross(vector_at(arrays.motion, 3, i), h)
        t = inverse_4pi * gradient(arrays.at_conductor, slot)
        if applied_rates:
            rate += applied_rates[i]
            t += wp.matrix_from_cols(along_x[i], along_y[i], along_z[i])
        # K/|N|² = Σ over both bodies of μ0² (|∇H|²/mass + |H|²/inertia)
        own = arrays.motion[6, i] * wp.ddot(t, t) + arrays.motion[7, i] * wp.dot(h, h)
        k = arrays.at_conductor[12, slot] + mu0 * mu0 * own
        r = arrays.packed[3, i]
        # e = −c N dB/dt, dB/dt = μ0 N (dH/dt − ω × H), c = (2π/15) σ R⁵
        c = coefficient * arrays.conductivity[i] * r * r * r * r * r
        e = -mu0 * rate
        if arrays.inducible[i] == 1:
            slope, saturation, curve = arrays.slope[i], arrays.saturation[i], arrays.curve[i]
            s = slope * wp.length(h) / saturation
            steepest = wp.max(curve_ratio(s, slope, curve, arrays.tables), curve_slope(s, slope, curve, arrays.tables))
            largest = dtype(1.0) + two_thirds * slope * steepest
            k *= largest * largest
            for _ in range(2):
                e += two_thirds * curve_derivative_times(h, e, slope, saturation, curve, arrays.tables)
        e *= c / (dtype(1.0) + dtype(2.0) * step * c * k)
        arrays.h[wp.tid()] = h
        for n in range(3):
            arrays.eddy[n, i] = e[n]
            arrays.packed[n + 4, i] = arrays.packed[n + 4, i] + e[n]
            if effective:
                effective[n, i] = effective[n, i] + e[n]

    return add_eddy_moments


@cache
def _torque_kernel(dtype):
    vec3, eddy_arrays = wp.types.vector(3, dtype), _arrays_type(dtype)
    vector_at, _ = _field_readers(dtype)
    mu0, inverse_4pi = dtype(MU0), dtype(INVERSE_4PI)

    @wp.kernel(module="unique", enable_backward=False)
    def add_torques(arrays: eddy_arrays, torques: wp.array[vec3]):
        slot = arrays.torque_slot[wp.tid()]
        i = arrays.torque_ball[slot]
        torque = wp.cross(vector_at(arrays.packed, 4, i), inverse_4pi * vector_at(arrays.field, 0, slot))
        conductor = arrays.torque_conductor[wp.tid()]
        if conductor >= 0:
            torque += wp.cross(vector_at(arrays.eddy, 0, i), arrays.h[conductor])
        torques[i] += mu0 * torque

    return add_torques


@cache
def _restore_kernel(dtype):
    vec3, eddy_arrays = wp.types.vector(3, dtype), _arrays_type(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def restore(arrays: eddy_arrays, moments: wp.array[vec3]):
        i = arrays.ball[arrays.slot[wp.tid()]]
        for n in range(3):
            arrays.packed[n + 4, i] = moments[i][n]

    return restore


class EddyCurrents:
    """Eddy currents of the conducting balls among n moments, evaluated repeatedly in the same arrays.

    Args:
        packed: Packed moments (``packing.PackedMoments``), whose positions the caller updates.
        ranges: Begin and end of the moments of each world.
        conductivity: Conductivity of each moment's ball [S/m], zero for insulators, shape [n].
        with_torque: True for inducible balls whose torque is computed, shape [n].
        material: Magnetization curves of the moments.
        step: Time step Δt [s] of the forces.

    Attributes:
        motion: Motion of each moment, ``MOTION_ROWS``, shape [8, n]; written by the caller.
    """

    def __init__(self, packed, ranges, conductivity, with_torque, material: CurveParameters, step: float):
        """Allocate the results."""
        dtype, device = packed.dtype, packed.device
        self._packed, self._step, self._device = packed, step, device
        self._arrays = arrays = _arrays_type(dtype)()
        conductivity = np.asarray(conductivity, float)
        self.motion = arrays.motion = packed.vectors(MOTION_ROWS)
        arrays.conductivity = wp.array(conductivity, dtype=dtype, device=device)
        arrays.packed, arrays.eddy, arrays.tables = packed.packed, packed.vectors(), material.tables
        arrays.saturation, arrays.slope = material.saturation, material.slope
        arrays.inducible, arrays.curve = material.inducible, material.curve
        balls = [first + np.flatnonzero(conductivity[first:last]) for first, last in ranges]
        torque_balls = [  # in worlds with a conductor
            first + np.flatnonzero(with_torque[first:last]) if len(own) else own
            for (first, last), own in zip(ranges, balls, strict=True)
        ]
        ends = np.cumsum([0, *map(len, balls)])
        conductors = self._lay_out("ball", "chunk", "slot", balls, ranges)
        conductor_of_moment = np.full(packed.count, -1)
        conductor_of_moment[conductors] = np.arange(len(conductors))
        conductor_ranges = itertools.pairwise(ends)
        inducible = self._lay_out("torque_ball", "torque_chunk", "torque_slot", torque_balls, conductor_ranges)
        self._put("conductor", conductors)
        self._put("torque_conductor", conductor_of_moment[inducible])
        arrays.at_conductor = wp.zeros((_FIELD_ROWS, len(arrays.ball)), dtype=dtype, device=device)
        arrays.field = wp.zeros((3, len(arrays.torque_ball)), dtype=dtype, device=device)
        arrays.h = wp.zeros(len(conductors), dtype=wp.types.vector(3, dtype), device=device)
        pairs = sum(len(own) * (last - first) for own, (first, last) in zip(balls, ranges, strict=True))
        self._threads = threads_for(pairs, _PAIRS_PER_THREAD)

    def _put(self, name: str, values, kind=wp.int32):
        setattr(self._arrays, name, wp.array(np.ascontiguousarray(values, np.int32), dtype=kind, device=self._device))

    def _lay_out(self, name: str, chunks: str, slots: str, balls, sources) -> np.ndarray:
        """Store the balls of all worlds in chunks, with their sources and their slots; return the balls."""
        empty = np.zeros(0, int)
        moments, rows, ball_slots = [empty], [], [empty]
        for own, (begin, end) in zip(balls, sources, strict=True):
            for k in range(0, len(own), CHUNK):
                part = own[k : k + CHUNK]
                ball_slots.append(CHUNK * len(rows) + np.arange(len(part)))
                moments.append(np.resize(part, CHUNK))
                rows.append((len(part), begin, end, 0))
        self._put(name, np.concatenate(moments))
        self._put(chunks, np.reshape(rows, (-1, 4)), wp.vec4i)
        self._put(slots, np.concatenate(ball_slots))
        return np.concatenate([empty, *balls])

    def _make_pass(self, number: int, slots: int):
        if slots:
            kernel = _passes(self._packed.dtype, _GROUP if self._device.is_cuda else 1)
            sizes = dict(threads=self._threads, gpu_threads=_GROUP * slots)
            launch_passes(kernel, number, number + 1, self._arrays, device=self._device, **sizes)

    def add(self, applied, sources=None, effective=None):
        """Add the eddy moments to the packed moments, for the sums over pairs that compute forces.

        Args:
            applied: Field of external sources [A/m], shape [n].
            sources: ``applied.fields.AppliedForces`` with the gradients and rates of that field; None if it is uniform.
            effective: Effective moments (``wrench``) to which the eddy moments are also added, shape [3, n]; or None.
        """
        self._make_pass(_RATES, len(self._arrays.ball))
        changes = (sources.rates, *sources.along) if sources else (None,) * 4
        inputs = [self._arrays, applied, *changes, self._step, effective]
        wp.launch(_eddy_kernel(self._packed.dtype), len(self._arrays.slot), inputs=inputs, device=self._device)

    def finish(self, moments, torques):
        """Add the torques [N·m] on inducible balls, and restore the packed moments without eddy moments."""
        arrays, dtype, device = self._arrays, self._packed.dtype, self._device
        self._make_pass(_FIELDS, len(arrays.torque_ball))
        wp.launch(_torque_kernel(dtype), len(arrays.torque_slot), inputs=[arrays, torques], device=device)
        wp.launch(_restore_kernel(dtype), len(arrays.slot), inputs=[arrays, moments], device=device)
