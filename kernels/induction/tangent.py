"""Linear solve at an equilibrium, for gradients by implicit differentiation (``warpmag.moments.system_gradients``).

The derivative of the curve, f'(H) = k [c' ĥĥᵀ + (c/s) (1 − ĥĥᵀ)] with s = k‖H‖/Ms, is symmetric and not negative. Let S
be the root of V f'(H) of each moment, 0 for permanent moments, and T the tensor of the pairs' fields. :class:`Tangent`
solves (1 − S T S) w = S ρ by conjugate gradients. Each world iterates and converges on its own.

An iteration evaluates the field T S z of one vector z: the start vector at first, then the residual r. With
A z = z − S T S z, direction p and image q of the iteration before,

    β = −z·q/p·q,   p ← z + β p,   q ← A z + β q,   α = r·z/p·q,   w ← w + α p,   r ← r − α q.

All sums of an iteration are known after its evaluation, including the norm of the next residual. A cold start begins
with z = S ρ. A warm start begins with the solution of the last solve, which α scales. Similar cotangents, such as those
of two substeps, then take few iterations.
"""

from functools import cache
from typing import Any

import numpy as np
import warp as wp

from warpmag.kernels.induction.solve_state import BLOCK_CHUNK, state_type, world_summation
from warpmag.kernels.material.curves import CurveParameters, curve_ratio, curve_slope
from warpmag.kernels.pairs.packing import ball_volume
from warpmag.kernels.shared.native import native_options

_MOST_ITERATIONS = 1000  # as of the induction solve; a few dozen reach rounding


@wp.struct
class TangentWorld:
    """State of a world's linear solve."""

    active: int  # 1 while it iterates
    steps: int  # 1 if the last evaluation leads to a step
    warm: int  # 1 if w is a solution of an earlier solve
    iterations: int  # field evaluations of this solve
    failed: int  # 1 if the solve ended without convergence
    alpha: wp.float64
    beta: wp.float64
    curvature: wp.float64  # p·q
    limit: wp.float64  # ‖r‖² at which the solve ends
    left: wp.float64  # ‖r‖² after the next step


@cache
def _arrays_type(dtype):
    vec3 = wp.types.vector(3, dtype)

    @wp.struct
    class TangentArrays:
        # Derivatives of the curves at an equilibrium, shape [n]:
        direction: wp.array[vec3]  # ĥ
        parallel: wp.array[dtype]  # S along ĥ [m^1.5]
        perpendicular: wp.array[dtype]  # S across ĥ [m^1.5]
        by_saturation: wp.array[dtype]  # derivative of V‖f‖ by the saturation [m³]
        by_slope: wp.array[dtype]  # derivative of V‖f‖ by the slope k [A·m²]
        # Linear solve, shape [n]:
        moments: wp.array2d[dtype]  # moments S z whose field is evaluated, rows of packed moments
        vectors: wp.array[vec3]  # the same as vectors
        field: wp.array[vec3]  # their field T S z
        w: wp.array[vec3]
        z: wp.array[vec3]
        image: wp.array[vec3]
        p: wp.array[vec3]
        q: wp.array[vec3]
        r: wp.array[vec3]
        worlds: wp.array[TangentWorld]  # shape [worlds]
        condition: wp.array[int]  # 1 while any world iterates, shape [1]
        rtol: wp.float64  # ‖r‖ over ‖S ρ‖ at which a world ends

    return TangentArrays


@cache
def _linearize_kernel(dtype):
    vec3 = wp.types.vector(3, dtype)
    zero, arrays_type = dtype(0.0), _arrays_type(dtype)

    @wp.kernel(module="unique", enable_backward=False, module_options=native_options("material/curves.h", dtype=dtype))
    def linearize(
        packed: wp.array2d[dtype],
        h: wp.array[vec3],
        inducible: wp.array[int],
        saturation: wp.array[dtype],
        slope: wp.array[dtype],
        curve: wp.array[int],
        tables: wp.array2d[dtype],
        arrays: arrays_type,
    ):
        i = wp.tid()
        if inducible[i] == 0:
            return
        k = slope[i]
        norm = wp.length(h[i])
        s = k * norm / saturation[i]
        ratio = curve_ratio(s, k, curve[i], tables)
        steepness = wp.where(s > zero, curve_slope(s, k, curve[i], tables), ratio)
        volume = ball_volume(packed[3, i])
        arrays.direction[i] = wp.normalize(h[i])
        arrays.parallel[i] = wp.sqrt(volume * k * steepness)
        arrays.perpendicular[i] = wp.sqrt(volume * k * ratio)
        # M = Ms c(s): ∂M/∂Ms = c − s c', ∂M/∂k = H c'
        arrays.by_saturation[i] = volume * s * (ratio - steepness)
        arrays.by_slope[i] = volume * norm * steepness

    return linearize


@wp.func
def _times_root(arrays: Any, i: int, v: Any):
    """Product S v of moment ``i``."""
    u = arrays.direction[i]
    across = arrays.perpendicular[i]
    return across * v + ((arrays.parallel[i] - across) * wp.dot(u, v)) * u


@wp.func
def _set_moment(arrays: Any, i: int, m: Any):
    """Set the moment whose field is evaluated next."""
    arrays.vectors[i] = m
    for c in range(3):
        arrays.moments[c, i] = m[c]


@cache
def _start_kernel(dtype):
    vec3, arrays_type = wp.types.vector(3, dtype), _arrays_type(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def start_solve(state: state_type(dtype), rho: wp.array[vec3], warm: int, arrays: arrays_type):
        row = state.row[wp.tid()]
        i = row[0]
        w = row[1]
        if i == row[2]:
            arrays.worlds[w].active = 1
            arrays.worlds[w].iterations = 0
            arrays.worlds[w].curvature = wp.float64(0.0)
            arrays.condition[0] = 1
        r = _times_root(arrays, i, rho[i])
        z = r
        if warm == 1 and arrays.worlds[w].warm == 1:
            z = arrays.w[i]
        arrays.z[i] = z
        arrays.r[i] = r
        arrays.w[i] = vec3()
        arrays.p[i] = vec3()
        arrays.q[i] = vec3()
        _set_moment(arrays, i, _times_root(arrays, i, z))

    return start_solve


@cache
def _measure_kernel(dtype):
    """Return the kernel that sums chunks of worlds; the last block of a world chooses its step."""
    state_struct, arrays_type, vec8 = state_type(dtype), _arrays_type(dtype), wp.types.vector(8, wp.float64)
    sum_world = world_summation(dtype, 8)

    @wp.func
    def wide(v: wp.types.vector(3, dtype)):
        return wp.vec3d(wp.float64(v[0]), wp.float64(v[1]), wp.float64(v[2]))

    options = native_options("shared/block_sum.h", dtype=dtype)

    @wp.kernel(module="unique", enable_backward=False, module_options=options)
    def measure(state: state_struct, arrays: arrays_type):
        c, lane = wp.tid()
        chunk = state.chunk[c]
        if arrays.worlds[chunk[2]].active == 0:
            if c == state.chunk_begin[chunk[2]] and lane == 0:
                arrays.worlds[chunk[2]].steps = 0
            return
        terms = vec8()
        for row in range(chunk[0] + lane, chunk[1], wp.block_dim()):
            i = state.row[row][0]
            image = arrays.z[i] - _times_root(arrays, i, arrays.field[i])
            arrays.image[i] = image
            a, z, r, q = wide(image), wide(arrays.z[i]), wide(arrays.r[i]), wide(arrays.q[i])
            terms += vec8(
                wp.dot(r, z), wp.dot(z, a), wp.dot(z, q), wp.dot(r, r),
                wp.dot(r, a), wp.dot(a, a), wp.dot(a, q), wp.dot(q, q),
            )  # fmt: skip
        last, sums = sum_world(terms, c, lane, chunk[2], state)
        if last:
            _choose_step(arrays, chunk[2], sums)

    return measure


@wp.func
def _choose_step(arrays: Any, w: int, sums: Any):
    """Choose α and β of a world, and end its solve if the step reaches the limit."""
    world = arrays.worlds[w]
    zero = wp.float64(0.0)
    rz, za, zq, rr, ra, aa, aq, qq = sums[0], sums[1], sums[2], sums[3], sums[4], sums[5], sums[6], sums[7]
    if world.iterations == 0:
        world.limit = arrays.rtol * arrays.rtol * rr
    world.beta = wp.where(world.curvature > zero, -zq / world.curvature, zero)
    world.curvature = za + world.beta * zq
    world.alpha = wp.where(world.curvature > zero, rz / world.curvature, zero)
    # r·q = z·q: β is 0 in the first iteration, and z is r in all others
    along = ra + world.beta * zq
    square = aa + world.beta * (wp.float64(2.0) * aq + world.beta * qq)
    world.left = rr + world.alpha * (world.alpha * square - wp.float64(2.0) * along)
    world.iterations += 1
    finite = wp.isfinite(world.left)
    world.steps = 1
    world.failed = 0
    if not finite or world.left <= world.limit or world.iterations == wp.static(_MOST_ITERATIONS):
        world.active = 0
        world.warm = wp.where(finite, 1, 0)
        if not world.left <= world.limit:
            world.failed = 1
    else:
        arrays.condition[0] = 1
    arrays.worlds[w] = world


@cache
def _advance_kernel(dtype):
    arrays_type = _arrays_type(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def advance(state: state_type(dtype), arrays: arrays_type):
        row = state.row[wp.tid()]
        i = row[0]
        world = arrays.worlds[row[1]]
        if world.steps == 0:
            return
        alpha, beta = dtype(world.alpha), dtype(world.beta)
        p = arrays.z[i] + beta * arrays.p[i]
        q = arrays.image[i] + beta * arrays.q[i]
        r = arrays.r[i] - alpha * q
        arrays.p[i] = p
        arrays.q[i] = q
        arrays.w[i] = arrays.w[i] + alpha * p
        arrays.r[i] = r
        arrays.z[i] = r
        _set_moment(arrays, i, _times_root(arrays, i, r))

    return advance


@cache
def _finish_kernel(dtype):
    vec3, arrays_type = wp.types.vector(3, dtype), _arrays_type(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def finish_solve(by_field: wp.array[vec3], arrays: arrays_type, eta_out: wp.array[vec3]):
        i = wp.tid()
        eta = _times_root(arrays, i, arrays.w[i])
        if by_field:
            eta += by_field[i]
        eta_out[i] = eta
        _set_moment(arrays, i, eta)

    return finish_solve


@cache
def _parameters_kernel(dtype):
    vec3, arrays_type = wp.types.vector(3, dtype), _arrays_type(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def parameter_gradients(
        slope: wp.array[dtype],
        rho: wp.array[vec3],
        arrays: arrays_type,
        saturation_out: wp.array[dtype],
        susceptibility_out: wp.array[dtype],
    ):
        i = wp.tid()
        along = wp.dot(arrays.direction[i], rho[i])
        saturation_out[i] = arrays.by_saturation[i] * along
        # 1/k = 1/3 + 1/χ, so dk/dχ = (k/χ)² = (1 − k/3)²
        share = dtype(1.0) - slope[i] / dtype(3.0)
        susceptibility_out[i] = arrays.by_slope[i] * share * share * along

    return parameter_gradients


class Tangent:
    """Linear solve at an equilibrium of n moments, repeatedly in the same arrays. Its launches can be captured.

    Args:
        state: State of the induction solve (``solve_state``), which has its worlds.
        moments: Packed moments (``packing.PackedMoments``) that the solve writes; their field T is evaluated.
        field: Their field, which the caller evaluates after :meth:`start` and :meth:`iterate`, shape [n].
        material: Materials of the moments.
        rtol: Residual over the right-hand side S ρ at which a world ends.

    Attributes:
        condition: 1 while any world iterates, shape [1].
        vectors: The moments that the solve writes, as vectors [A·m²], shape [n].
        rho: Cotangents ρ [1/(A·m²)], written by the caller before :meth:`start`, shape [n].
        eta: ∂L/∂H + S w [m/A], written by :meth:`finish`, shape [n].
    """

    def __init__(self, state, moments, field, material: CurveParameters, rtol: float):
        """Allocate the buffers."""
        self._state, self._moments, self._material, self._recorded = state, moments, material, {}
        self._device, self._dtype, n, worlds = moments.device, moments.dtype, moments.count, state.worlds.shape[0]
        self._arrays = a = _arrays_type(self._dtype)()
        a.moments, a.field, a.rtol = moments.moments, field, rtol
        for name in ("direction", "vectors", "w", "z", "image", "p", "q", "r"):
            setattr(a, name, wp.zeros_like(field))
        for name in ("parallel", "perpendicular", "by_saturation", "by_slope"):
            setattr(a, name, wp.zeros(n, dtype=self._dtype, device=self._device))
        a.worlds = wp.zeros(worlds, dtype=TangentWorld, device=self._device)
        self.condition = a.condition = wp.zeros(1, dtype=wp.int32, device=self._device)
        self.rho, self.eta, self.vectors = wp.zeros_like(field), wp.zeros_like(field), a.vectors

    def linearize(self, h) -> None:
        """Launch the derivatives of the curves in the field ``h`` [A/m], the same array at each call, shape [n]."""
        material = self._material
        inputs = [self._moments.packed, h, material.inducible, material.saturation, material.slope, material.curve]
        self._launch(_linearize_kernel, len(h), [*inputs, material.tables, self._arrays])

    def start(self, warm: bool) -> None:
        """Launch the start of a solve, from the solution of the last one if ``warm``."""
        inputs = [self._state, self.rho, int(warm), self._arrays]
        self._launch(_start_kernel, self._state.row.shape[0], inputs, key=warm)

    def iterate(self) -> None:
        """Launch the check of convergence and a step, after the evaluation of the field."""
        self.condition.zero_()  # set again by any world that needs another evaluation
        inputs, chunks = [self._state, self._arrays], self._state.chunk.shape[0]
        self._launch(_measure_kernel, (chunks, BLOCK_CHUNK), inputs, block_dim=BLOCK_CHUNK)
        self._launch(_advance_kernel, self._state.row.shape[0], inputs)

    def finish(self, by_field=None) -> None:
        """Launch the end of a solve: write ``eta``, also to the moments.

        ``by_field`` is ∂L/∂H [m/A], the same array at each call, shape [n]; None means 0.
        """
        self._launch(_finish_kernel, len(self.eta), [by_field, self._arrays, self.eta], key=by_field is None)

    def parameter_gradients(self, rho) -> tuple[wp.array, wp.array]:
        """Return the gradients by saturations and by susceptibilities, shape [n], from ρ at the solution."""
        out = wp.zeros_like(self._arrays.by_slope), wp.zeros_like(self._arrays.by_slope)
        inputs = [self._material.slope, rho, self._arrays, *out]
        wp.launch(_parameters_kernel(self._dtype), len(rho), inputs=inputs, device=self._device)
        return out

    def evaluations(self) -> np.ndarray:
        """Return the field evaluations of the last solve, shape [worlds]. Waits for the device."""
        return self._arrays.worlds.numpy()["iterations"]

    def largest_residual(self) -> float:
        """Return the largest residual over ``rtol`` of worlds that did not converge, else 0. Waits for the device."""
        worlds = self._arrays.worlds.numpy()
        worlds = worlds[worlds["failed"] == 1]
        if not len(worlds):
            return 0.0
        with np.errstate(all="ignore"):
            return float(np.max(np.sqrt(worlds["left"] / worlds["limit"])))

    def _launch(self, kernel, dim, inputs, key=None, **options) -> None:
        """Launch a kernel of this module. The launch is recorded, because packing the structs takes long."""
        if (kernel, key) not in self._recorded:
            options |= {"device": self._device, "record_cmd": True}
            self._recorded[kernel, key] = wp.launch(kernel(self._dtype), dim, inputs=inputs, **options)
        self._recorded[kernel, key].launch()
