"""Eddy currents in conducting balls that move through the field: what they brake by.

**One ball.** In a field that changes slowly, with B uniform inside, a ball of conductivity σ and radius R has the
electric field E = −½ (dB/dt) × r, and with J = σE the power and the moment (L. D. Landau and E. M. Lifshitz,
Electrodynamics of Continuous Media, §59, in the limit of low frequency)

    P = ∫ J·E dV = c |dB/dt|²,    ½ ∫ r × J dV = −c dB/dt,    c = (2π/15) σ R⁵.

dB/dt is that of matter, in the frame that turns with the ball at ω, and B is the one inside: H being the field of all
else, B = μ0 (H + ⅔ M), M = f(H), so that with the curve's derivative f' (``material.curves``)

    dB/dt = μ0 N (dH/dt − ω × H),    N = 1 + ⅔ f'(H):

3 μr/(μr + 2) in weak fields, 1 where the ball is saturated, though a field that turns still turns M. A permanent ball
has N = 1.

**What moves.** dH/dt is what the bodies' motion makes of the field: of moments m_j, which are fixed in their bodies,
Σ [(v_i − v_j)·∇ H_ij + H of ω_j × m_j], and v_i·∇H of what is fixed in the world. Rayleigh's dissipation function
D = ½ Σ c_i |dB_i/dt|² is then the same for who moves or turns along with everything, and the forces −∂D/∂v and torques
−∂D/∂ω that follow keep momentum and angular momentum and take the power 2D. They are those of eddy moments

    e_i = −c_i N dB_i/dt

in the field of all moments, and of all moments in theirs: the sums over pairs that make forces of moments get m + e.
Only the torque on inducible balls, which the moments alone do not turn, needs a sum of its own.

**Left out** are what neighbours' magnetizations answer to the change of the field (they move and turn with their balls
meanwhile), skin effect, and changes of the applied field by anything but motion.

**Time steps.** Explicit forces overshoot where they would stop the ball within a step, of Δt, so that c is
c / (1 + 2 Δt c K), in which K bounds how fast currents decay by the motion that their forces cause: |N|² times the
squared gradients of B, over the masses of both ends of a pair, and the squares of B over their moments of inertia.
"""

import itertools
from functools import cache

import numpy as np
import warp as wp

from warpmag.kernels.material.curves import CurveParameters, curve_derivative_times, curve_ratio, curve_slope
from warpmag.kernels.pairs.pair_law import INVERSE_4PI
from warpmag.kernels.pairs.wrench import MU0
from warpmag.kernels.shared.native import CHUNK, PASS_ARGUMENTS, native_kernel, native_options
from warpmag.kernels.shared.team import team, threads_for

_RATES, _FIELDS = range(2)
"""The passes; as in ``rates.h``."""
_SEEN_ROWS = 13
"""4π times the field H, its rate, and its gradient xx, yy, zz, xy, yz, zx; K over |N|² but of the ball's own motion."""
MOTION_ROWS = 8
"""Velocity [m/s] and angular velocity [rad/s] of a moment; 1/mass [1/kg] and 1/inertia [1/(kg·m²)] of its body."""
_GROUP = 32
"""Threads of a GPU that share a ball."""
_PAIRS_PER_THREAD = 10000
"""Pairs that make another thread of a CPU worth waking."""


@cache
def _arrays_type(dtype):
    kinds = (
        (wp.array[int], "ball slot turned turned_slot number conductor inducible curve"),
        (wp.array[wp.vec4i], "chunk turned_chunk"),
        (wp.array[dtype], "conductivity saturation slope"),
        (wp.array[wp.types.vector(3, dtype)], "h"),
        (wp.array2d[dtype], "packed motion eddy seen field tables"),
    )
    members = {name: kind for kind, names in kinds for name in names.split()}
    doc = "Balls in chunks of a world each, what they are made of, what they are among, and what they see."
    return wp.struct(type("EddyArrays", (), {"__doc__": doc, "__annotations__": members}))


@cache
def _passes(dtype, group: int):
    call = "eddy_passes(thread, first, last, threads, team.data, arrays)"
    arguments = {**PASS_ARGUMENTS, "arrays": _arrays_type(dtype)}
    return native_kernel(call, "eddy/rates.h", arguments, dtype=dtype, MU0_4PI=MU0 * INVERSE_4PI, GROUP=group)


@cache
def _seen(dtype):
    """Warp functions: three rows of a table as a vector, and the gradient among what a ball sees, times 4π."""
    vec3, mat33 = wp.types.vector(3, dtype), wp.types.matrix((3, 3), dtype)

    @wp.func
    def three(rows: wp.array2d[dtype], row: int, i: int):
        return vec3(rows[row, i], rows[row + 1, i], rows[row + 2, i])

    @wp.func
    def gradient(seen: wp.array2d[dtype], i: int):
        xx, yy, zz = seen[6, i], seen[7, i], seen[8, i]
        xy, yz, zx = seen[9, i], seen[10, i], seen[11, i]
        return mat33(xx, xy, zx, xy, yy, yz, zx, yz, zz)

    return three, gradient


@cache
def _brake_kernel(dtype):
    vec3, eddy_arrays = wp.types.vector(3, dtype), _arrays_type(dtype)
    three, gradient = _seen(dtype)
    coefficient, part, mu0, unit = (dtype(x) for x in (2.0 * np.pi / 15.0, 2.0 / 3.0, MU0, INVERSE_4PI))

    @wp.kernel(module="unique", enable_backward=False, module_options=native_options("material/curves.h", dtype=dtype))
    def brake(
        # inputs:
        arrays: eddy_arrays,
        applied: wp.array[vec3],
        applied_rates: wp.array[vec3],
        along_x: wp.array[vec3],
        along_y: wp.array[vec3],
        along_z: wp.array[vec3],
        step: dtype,
        # in and out:
        effective: wp.array2d[dtype],
    ):
        slot = arrays.slot[wp.tid()]
        i = arrays.ball[slot]
        h = unit * three(arrays.seen, 0, slot) + applied[i]
        rate = unit * three(arrays.seen, 3, slot) - wp.cross(three(arrays.motion, 3, i), h)
        t = unit * gradient(arrays.seen, slot)
        if applied_rates:
            rate += applied_rates[i]
            t += wp.matrix_from_cols(along_x[i], along_y[i], along_z[i])
        own = arrays.motion[6, i] * wp.ddot(t, t) + arrays.motion[7, i] * wp.dot(h, h)
        k = arrays.seen[12, slot] + mu0 * mu0 * own
        r = arrays.packed[3, i]
        c = coefficient * arrays.conductivity[i] * r * r * r * r * r
        e = -mu0 * rate
        if arrays.inducible[i] == 1:
            slope, saturation, curve = arrays.slope[i], arrays.saturation[i], arrays.curve[i]
            s = slope * wp.length(h) / saturation
            steepest = wp.max(curve_ratio(s, curve, arrays.tables), curve_slope(s, curve, arrays.tables))
            largest = dtype(1.0) + part * slope * steepest
            k *= largest * largest
            for _ in range(2):
                e += part * curve_derivative_times(h, e, slope, saturation, curve, arrays.tables)
        e *= c / (dtype(1.0) + dtype(2.0) * step * c * k)
        arrays.h[wp.tid()] = h
        for n in range(3):
            arrays.eddy[n, i] = e[n]
            arrays.packed[n + 4, i] = arrays.packed[n + 4, i] + e[n]
            if effective:
                effective[n, i] = effective[n, i] + e[n]

    return brake


@cache
def _turn_kernel(dtype):
    vec3, eddy_arrays = wp.types.vector(3, dtype), _arrays_type(dtype)
    three, _ = _seen(dtype)
    mu0, unit = dtype(MU0), dtype(INVERSE_4PI)

    @wp.kernel(module="unique", enable_backward=False)
    def turn(arrays: eddy_arrays, torques: wp.array[vec3]):
        slot = arrays.turned_slot[wp.tid()]
        i = arrays.turned[slot]
        torque = wp.cross(three(arrays.packed, 4, i), unit * three(arrays.field, 0, slot))
        conductor = arrays.number[wp.tid()]
        if conductor >= 0:
            torque += wp.cross(three(arrays.eddy, 0, i), arrays.h[conductor])
        torques[i] += mu0 * torque

    return turn


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
    """Eddy currents of the balls among some moments, again and again in the same arrays.

    Args:
        packed: The moments, packed, and placed by the caller (``packing.PackedMoments``).
        ranges: Their first and the one after the last, of each world.
        conductivity: Conductivity of each moment's ball [S/m], zero where there is none, shape [n].
        turned: Whether a moment is an inducible ball whose torque is wanted, shape [n].
        material: What the moments are made of.
        step: Time [s] for which forces count, below which they stop no ball.

    Attributes:
        motion: How each moment moves, ``MOTION_ROWS``, shape [8, n]; written by the caller.
    """

    def __init__(self, packed, ranges, conductivity, turned, material: CurveParameters, step: float):
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
        wanted = [  # those of worlds with a conductor
            first + np.flatnonzero(turned[first:last]) if len(own) else own
            for (first, last), own in zip(ranges, balls, strict=True)
        ]
        ends = np.cumsum([0, *map(len, balls)])
        conductors = self._lay_out("ball", "chunk", "slot", balls, ranges)
        number = np.full(packed.count, -1)
        number[conductors] = np.arange(len(conductors))
        also_turned = self._lay_out("turned", "turned_chunk", "turned_slot", wanted, itertools.pairwise(ends))
        self._put("conductor", conductors)
        self._put("number", number[also_turned])
        arrays.seen = wp.zeros((_SEEN_ROWS, len(arrays.ball)), dtype=dtype, device=device)
        arrays.field = wp.zeros((3, len(arrays.turned)), dtype=dtype, device=device)
        arrays.h = wp.zeros(len(conductors), dtype=wp.types.vector(3, dtype), device=device)
        pairs = sum(len(own) * (last - first) for own, (first, last) in zip(balls, ranges, strict=True))
        self._threads = threads_for(pairs, _PAIRS_PER_THREAD)

    def _put(self, name: str, values, kind=wp.int32):
        setattr(self._arrays, name, wp.array(np.ascontiguousarray(values, np.int32), dtype=kind, device=self._device))

    def _lay_out(self, name: str, chunks: str, slots: str, balls, sources) -> np.ndarray:
        """Put the balls of worlds into chunks, with their sources, and list where each stands; return all balls."""
        nothing = np.zeros(0, int)
        places, rows, stands = [nothing], [], [nothing]
        for own, (begin, end) in zip(balls, sources, strict=True):
            for k in range(0, len(own), CHUNK):
                part = own[k : k + CHUNK]
                stands.append(CHUNK * len(rows) + np.arange(len(part)))
                places.append(np.resize(part, CHUNK))
                rows.append((len(part), begin, end, 0))
        self._put(name, np.concatenate(places))
        self._put(chunks, np.reshape(rows, (-1, 4)), wp.vec4i)
        self._put(slots, np.concatenate(stands))
        return np.concatenate([nothing, *balls])

    def _run(self, one: int, places: int):
        cuda = self._device.is_cuda
        if places:
            wp.launch(
                _passes(self._packed.dtype, _GROUP if cuda else 1),
                dim=_GROUP * places if cuda else 1,
                inputs=[one, one + 1, self._threads, None if cuda else team(), self._arrays],
                device=self._device,
            )

    def add(self, applied, sources=None, effective=None):
        """Add the eddy moments to the packed moments, for the sums over pairs that make forces.

        Args:
            applied: Field of what is no moment [A/m], shape [n].
            sources: What makes it change, ``applied.fields.AppliedForces`` that follow the motion; None without such.
            effective: Effective moments (``wrench``) that they are added to as well, shape [3, n]; or None.
        """
        self._run(_RATES, len(self._arrays.ball))
        changes = (sources.rates, *sources.along) if sources else (None,) * 4
        inputs = [self._arrays, applied, *changes, self._step, effective]
        wp.launch(_brake_kernel(self._packed.dtype), len(self._arrays.slot), inputs=inputs, device=self._device)

    def finish(self, moments, torques):
        """Add the torques on inducible balls, and take the eddy moments off the packed moments.

        Args:
            moments: The moments [A·m²], shape [n].
            torques: Torques that are added to [N·m], shape [n].
        """
        arrays, dtype, device = self._arrays, self._packed.dtype, self._device
        self._run(_FIELDS, len(arrays.turned))
        wp.launch(_turn_kernel(dtype), len(arrays.turned_slot), inputs=[arrays, torques], device=device)
        wp.launch(_restore_kernel(dtype), len(arrays.slot), inputs=[arrays, moments], device=device)
