"""Circuits of coils: currents from voltages, resistances and linked flux.

A moment m at x, permanent or induced, links the flux μ0 m·h_k(x) with a turn of coil k, where h_k is the field of one
ampere-turn: by reciprocity it is the derivative of the co-energy by the current. With the ampere-turns S, the voltage
u and the resistance r of one turn (V/N and R/N² of a winding), and the inductances L of single turns in air, flux and
current follow

    Φ_k = Σ_j L_kj S_j + μ0 Σ_i m_i·h_k(x_i),      dΦ_k/dt = u_k − r_k S_k.

So u·S dt is the heat r S² dt plus S dΦ, which is the change of the stored energy plus the work of the magnetic forces.

**A time step** Δt integrates the flux, which iron and motion do not disturb, and finds the currents that belong to it:

    Φ_n = Φ_{n−1} + Δt (u − r ((1 − θ) S_{n−1} + θ S_n)).

With θ = 1/(1 − e^(−z)) − 1/z, z = Δt r/(L + D), the decay of a lone coil is exact, and any step is stable. θ is ½ for
short steps and approaches 1. The moments depend on S_n, too. Newton's iteration solves the induction at S_n, and
corrects S_n by the remaining flux over L + D + θ Δt r. D = ∂Φ/∂S of the moments is Broyden's secant estimate from the
iterations; it stays for the next step. The first guess uses the moments of the last step at their new positions. Then
one solve suffices in most steps. A remaining error does not accumulate, because the flux is the state.
"""

from functools import cache

import warp as wp

from warpmag.kernels.applied.sources import FieldSources, SourceKind, coil_arrays_type
from warpmag.kernels.pairs.wrench import MU0
from warpmag.kernels.shared.native import native_kernel

MOST_SOLVES = 6  # largest number of induction solves in a step
_PARTS_CUDA = 64  # threads of a GPU that share the moments of a circuit
_LINKED_SHARE = 0.05  # share of the moments' flux that counts for the tolerance, for coils without a current
_SECANT_CHANGE = 10.0  # least relative change of currents [rtol] from which a secant is taken

wp.set_module_options({"enable_backward": False})


@wp.struct
class CircuitArrays:
    """Coils with voltages: c circuits, ordered by the w worlds with circuits, at most m of them in a world."""

    # Model:
    source: wp.array[int]  # coil or map of each circuit, shape [c]
    shape: wp.array[int]  # its shape in the model
    world: wp.array[int]  # its world among those with circuits
    begin: wp.array[int]  # first circuit of each world, shape [w + 1]
    moments: wp.array[wp.vec2i]  # range of the moments of each world
    turns: wp.array[wp.float64]
    resistance: wp.array[wp.float64]  # of one turn, R/N² [Ω]
    inductance: wp.array2d[wp.float64]  # of single turns in air, to the circuits of the world [H], shape [c, m]
    given: wp.array2d[int]  # coils with given currents at a fixed pose relative to a circuit, −1 for none
    given_inductance: wp.array2d[wp.float64]  # mutual inductances to them [H]
    # Data in, arrays of the model, shape [shapes]:
    voltage: wp.array[float]  # [V]
    # Data in and out:
    strength: wp.array[float]  # ampere-turns [A], an array of the model, shape [shapes]
    flux: wp.array[wp.float64]  # flux of a turn [Wb], shape [c]
    response: wp.array2d[wp.float64]  # D [H], shape [c, m]
    fresh: wp.array[int]  # 1 if the flux is to be taken from the currents, shape [c]
    # Data out:
    current: wp.array[float]  # [A], shape [c]
    # Work:
    partial: wp.array2d[wp.float64]  # parts of the flux of the moments, shape [c, parts]
    start: wp.array[wp.float64]  # S at the start of the step
    target: wp.array[wp.float64]  # Φ less θ Δt r times the new S
    residual: wp.array[wp.float64]
    last: wp.array[wp.float64]  # S and flux of the moments at the solve before
    last_linked: wp.array[wp.float64]
    matrix: wp.array2d[wp.float64]  # shape [c, m]
    theta: wp.array[wp.float64]  # shape [w]
    duration: wp.array[wp.float64]  # Δt [s], shape [w]
    solves: wp.array[int]  # solves of the step so far, −1 for a finished world
    pending: wp.array[int]  # 1 while a world iterates, shape [1]


@cache
def _unit_field_kernel():
    arguments = {"width": int, "coils": coil_arrays_type(wp.float32), "circuits": CircuitArrays}
    arguments |= {"positions": wp.array[wp.vec3], "fields": wp.array2d[wp.vec3]}
    call = "unit_field(thread, width, coils, circuits, positions, fields)"
    kinds = {kind.name: kind.value for kind in SourceKind}
    return native_kernel(call, "applied/circuits.h", arguments, dtype=wp.float32, **kinds)


@wp.kernel
def _link_moments(a: CircuitArrays, fields_in: wp.array2d[wp.vec3], moments_in: wp.array[wp.vec3]):
    k, part = wp.tid()
    if k == 0 and part == 0:
        a.pending[0] = 0
    span = a.moments[a.world[k]]
    total = wp.float64(0.0)
    for j in range(part, span[1] - span[0], a.partial.shape[1]):
        total += wp.dot(wp.vec3d(moments_in[span[0] + j]), wp.vec3d(fields_in[k, j]))
    a.partial[k, part] = wp.float64(wp.static(MU0)) * total


@wp.func
def _linked(a: CircuitArrays, k: int) -> wp.float64:
    """Return the flux of moments and of given currents through a turn of circuit k [Wb]."""
    total = wp.float64(0.0)
    for part in range(a.partial.shape[1]):
        total += a.partial[k, part]
    for j in range(a.given.shape[1]):
        if a.given[k, j] >= 0:
            total += a.given_inductance[k, j] * wp.float64(a.strength[a.given[k, j]])
    return total


@wp.func
def _own_flux(a: CircuitArrays, k: int) -> wp.float64:
    """Return the flux in air of the circuits of its world through a turn of circuit k [Wb]."""
    first = a.begin[a.world[k]]
    total = wp.float64(0.0)
    for j in range(a.begin[a.world[k] + 1] - first):
        total += a.inductance[k, j] * wp.float64(a.strength[a.shape[first + j]])
    return total


@wp.func
def _find_residual(a: CircuitArrays, k: int, linked: wp.float64):
    """Write the flux of circuit k that its present current leaves."""
    w = a.world[k]
    drop = a.theta[w] * a.duration[w] * a.resistance[k] * wp.float64(a.strength[a.shape[k]])
    a.residual[k] = a.target[k] - linked - _own_flux(a, k) - drop


@wp.func
def _set_target(a: CircuitArrays, k: int):
    w = a.world[k]
    voltage = wp.float64(a.voltage[a.shape[k]]) / a.turns[k]
    drop = (wp.float64(1.0) - a.theta[w]) * a.resistance[k] * a.start[k]
    a.target[k] = a.flux[k] + a.duration[w] * (voltage - drop)


@wp.func
def _correct_currents(a: CircuitArrays, w: int, source_strengths: wp.array[wp.vec3]):
    """Add the solution of (L + D + θ Δt r) ΔS = residual to the ampere-turns of a world, by Gaussian elimination."""
    first = a.begin[w]
    count = a.begin[w + 1] - first
    for i in range(count):
        for j in range(count):
            a.matrix[first + i, j] = a.inductance[first + i, j] + a.response[first + i, j]
        a.matrix[first + i, i] = a.matrix[first + i, i] + a.theta[w] * a.duration[w] * a.resistance[first + i]
    for i in range(count):
        for row in range(i + 1, count):
            factor = a.matrix[first + row, i] / a.matrix[first + i, i]
            for j in range(i, count):
                a.matrix[first + row, j] = a.matrix[first + row, j] - factor * a.matrix[first + i, j]
            a.residual[first + row] = a.residual[first + row] - factor * a.residual[first + i]
    for back in range(count):
        i = count - 1 - back
        change = a.residual[first + i]
        for j in range(i + 1, count):
            change -= a.matrix[first + i, j] * a.residual[first + j]
        a.residual[first + i] = change / a.matrix[first + i, i]
    for i in range(count):
        shape = a.shape[first + i]
        a.strength[shape] = float(wp.float64(a.strength[shape]) + a.residual[first + i])
        source_strengths[a.source[first + i]] = wp.vec3(a.strength[shape], 0.0, 0.0)


@wp.func
def _implicitness(z: wp.float64) -> wp.float64:
    """Return θ for which a step of z = Δt r/L decays by e^(−z)."""
    if z < wp.float64(1e-3):
        return wp.float64(0.5) + z / wp.float64(12.0)
    return wp.float64(1.0) / (wp.float64(1.0) - wp.exp(-z)) - wp.float64(1.0) / z


@wp.func
def _set_theta(a: CircuitArrays, w: int):
    z = wp.float64(0.0)
    for k in range(a.begin[w], a.begin[w + 1]):
        j = k - a.begin[w]
        z = wp.max(z, a.duration[w] * a.resistance[k] / (a.inductance[k, j] + a.response[k, j]))
    a.theta[w] = _implicitness(z)


@wp.kernel
def _begin_step(
    a: CircuitArrays, dt: wp.float64, sharing_in: wp.array[wp.int32], source_strengths_out: wp.array[wp.vec3]
):
    w = wp.tid()
    duration = dt
    if sharing_in:
        duration = dt * wp.float64(wp.max(sharing_in[0], 2))
    a.duration[w] = duration
    _set_theta(a, w)
    for k in range(a.begin[w], a.begin[w + 1]):
        a.start[k] = wp.float64(a.strength[a.shape[k]])
    a.solves[w] = 0
    a.pending[0] = 1
    if a.fresh[a.begin[w]] != 0:
        return
    for k in range(a.begin[w], a.begin[w + 1]):
        _set_target(a, k)
        _find_residual(a, k, _linked(a, k))
    _correct_currents(a, w, source_strengths_out)


@wp.func
def _take_secant(a: CircuitArrays, w: int, rtol: wp.float64):
    """Correct D by the change of the moments' flux since the last solve of the step (Broyden 1965)."""
    first = a.begin[w]
    change2 = wp.float64(0.0)
    size2 = wp.float64(0.0)
    for k in range(first, a.begin[w + 1]):
        strength = wp.float64(a.strength[a.shape[k]])
        change2 += (strength - a.last[k]) * (strength - a.last[k])
        size2 += strength * strength
    least = wp.float64(wp.static(_SECANT_CHANGE)) * rtol
    if change2 <= least * least * size2:
        return
    for k in range(first, a.begin[w + 1]):
        error = _linked(a, k) - a.last_linked[k]
        for j in range(a.begin[w + 1] - first):
            error -= a.response[k, j] * (wp.float64(a.strength[a.shape[first + j]]) - a.last[first + j])
        for j in range(a.begin[w + 1] - first):
            change = wp.float64(a.strength[a.shape[first + j]]) - a.last[first + j]
            a.response[k, j] = a.response[k, j] + error * change / change2
        a.response[k, k - first] = wp.max(a.response[k, k - first], wp.float64(0.0))


@wp.func
def _is_solved(a: CircuitArrays, k: int, linked: wp.float64, rtol: wp.float64) -> bool:
    j = k - a.begin[a.world[k]]
    own = (a.inductance[k, j] + a.response[k, j]) * wp.abs(wp.float64(a.strength[a.shape[k]]))
    return wp.abs(a.residual[k]) <= rtol * (own + wp.float64(wp.static(_LINKED_SHARE)) * wp.abs(linked))


@wp.kernel
def _end_solve(a: CircuitArrays, rtol: wp.float64, source_strengths_out: wp.array[wp.vec3]):
    w = wp.tid()
    if a.solves[w] < 0:
        return
    a.solves[w] = a.solves[w] + 1
    if a.solves[w] > 1:
        _take_secant(a, w, rtol)
        _set_theta(a, w)
    solved = bool(True)
    for k in range(a.begin[w], a.begin[w + 1]):
        linked = _linked(a, k)
        if a.fresh[k] != 0:
            a.flux[k] = _own_flux(a, k) + linked
            a.fresh[k] = 0
        _set_target(a, k)
        a.last[k] = wp.float64(a.strength[a.shape[k]])
        a.last_linked[k] = linked
        _find_residual(a, k, linked)
        solved = solved and _is_solved(a, k, linked, rtol)
    if solved or a.solves[w] >= wp.static(MOST_SOLVES):
        a.solves[w] = -1
        for k in range(a.begin[w], a.begin[w + 1]):
            a.flux[k] = a.target[k] - a.theta[w] * a.duration[w] * a.resistance[k] * a.last[k]
            a.current[k] = float(a.last[k] / a.turns[k])
    else:
        _correct_currents(a, w, source_strengths_out)
        wp.atomic_max(a.pending, 0, 1)


class CircuitSteps:
    """Launches of a time step of circuits, in buffers that are allocated once.

    Args:
        arrays: The circuits, with the arrays of their model and state.
        sources: Coils and field maps (``sources.FieldSources``).
        moments: Range of the moments of each world with circuits, NumPy, shape [w, 2].
    """

    def __init__(self, arrays: CircuitArrays, sources: FieldSources, moments):
        """Allocate the work arrays."""
        self._arrays, self._sources, device = arrays, sources, sources.device
        self._count, self._worlds = len(arrays.source), len(moments)
        self._width = int((moments[:, 1] - moments[:, 0]).max())
        arrays.moments = wp.array(moments, dtype=wp.vec2i, device=device)
        self._fields = wp.zeros((self._count, self._width), dtype=wp.vec3, device=device)
        most = arrays.inductance.shape[1]
        parts = _PARTS_CUDA if device.is_cuda else 1

        def zeros(shape, dtype=wp.float64):
            return wp.zeros(shape, dtype=dtype, device=device)

        for name in ("start", "target", "residual", "last", "last_linked"):
            setattr(arrays, name, zeros(self._count))
        arrays.partial, arrays.matrix = zeros((self._count, parts)), zeros((self._count, most))
        arrays.theta, arrays.duration = zeros(self._worlds), zeros(self._worlds)
        arrays.solves, arrays.pending = zeros(self._worlds, wp.int32), zeros(1, wp.int32)

    def step(self, system, dt: float, sharing=None) -> None:
        """Launch a step of ``dt`` [s] that ends with the induction of a system (``MomentSystem``) at the new currents.

        ``sharing``, int32, shape [1], makes the step as many times longer, at least twice.
        """
        arrays, sources, device = self._arrays, self._sources, self._sources.device
        inputs = [self._width, sources.coil_arrays, arrays, system.positions]
        wp.launch(_unit_field_kernel(), self._count * self._width, inputs=inputs, outputs=[self._fields], device=device)
        self._link(system)
        inputs = [arrays, wp.float64(dt), sharing]
        wp.launch(_begin_step, self._worlds, inputs=inputs, outputs=[sources.strengths], device=device)
        self._solve(system)
        wp.capture_while(arrays.pending, self._solve, system=system)

    def _link(self, system) -> None:
        inputs = [self._arrays, self._fields, system.moments]
        wp.launch(_link_moments, self._arrays.partial.shape, inputs=inputs, device=system.device)

    def _solve(self, system) -> None:
        """Solve the induction at the present currents, and correct them where flux is left."""
        system.solve()
        self._link(system)
        inputs = [self._arrays, wp.float64(system.rtol)]
        wp.launch(_end_solve, self._worlds, inputs=inputs, outputs=[self._sources.strengths], device=system.device)
