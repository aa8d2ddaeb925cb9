"""Times of gradients beside the calls that they belong to: ``python -m bench.gradients [--device cuda:0]``.

``calls`` are the field, forces and torques, and the equilibrium of a touching pile of balls, at increasing numbers of
balls. ``worlds`` is one gradient in each of many worlds: a solve, forces, and the gradient of a function of the forces
by all positions, in one sequence of launches (a graph on a GPU). Each measurement is one JSON line. Gradients are
checked against a central difference along a random direction before they are timed. ``multipoles`` are the public
``h_field`` by the fast multipole method and its tape, with checks and allocations. ``peer`` is the same gradient by
magpylib-jax, on the CPU; it needs magpylib-jax.
"""

import argparse
import time

import numpy as np
import warp as wp

from bench.cases import RADIUS, SATURATION, touching_pile
from bench.machine import line_writer
from bench.run import make_system
from bench.systems import moment_system, solve_cold
from bench.timing import measure
from warpmag import h_field
from warpmag.kernels.pairs.evaluate import PairEvaluation
from warpmag.kernels.pairs.packing import PackedMoments
from warpmag.kernels.pairs.pair_law import Quantity
from warpmag.moments.system import MomentSystem

_SIZES = {"cpu": (243, 1000, 4096), "cuda": (243, 1000, 4096, 16384)}
_WORLDS, _BALLS = {"cpu": 32, "cuda": 4096}, 64
_MOMENTS = {"cpu": (10_000, 40_000), "cuda": (250_000, 1_000_000)}
_PEER_SIZES = 100, 1000


def _cotangents(system: MomentSystem, count: int) -> list[wp.array]:
    """Return random arrays of unit vectors' size, one vector for each moment."""
    rng = np.random.default_rng(5)
    shape = system.count, 3
    return [wp.array(rng.normal(size=shape), dtype=system.h.dtype, device=system.device) for _ in range(count)]


def _load(system: MomentSystem) -> None:
    system.gradients.load(system.positions, system.moments, system.h, system.external_field)


def _differentiate_forces(system: MomentSystem, forces, torques) -> None:
    """Compute the gradient of a function of forces and torques by positions, through the equilibrium."""
    _load(system)
    sums = system.gradients.wrench(forces, torques)
    system.gradients.solve(sums.by_moments)


def _check(system: MomentSystem, forces, torques) -> float:
    """Return the relative error of the gradient along a random direction against a central difference, in float64."""
    solve_cold(system)
    system.apply_forces()
    _differentiate_forces(system, forces, torques)
    gradient = system.gradients.by_positions.numpy() + system.gradients.wrench(forces, torques).by_positions.numpy()
    start, step = system.positions.numpy().copy(), 1e-7 * RADIUS * np.random.default_rng(6).normal(size=gradient.shape)
    values = []
    for sign in (1.0, -1.0):
        system.positions.assign(start + sign * step)
        solve_cold(system)
        system.apply_forces()
        values.append(
            sum(np.sum(a.numpy() * b.numpy()) for a, b in ((forces, system.forces), (torques, system.torques)))
        )
    system.positions.assign(start)
    difference = 0.5 * (values[0] - values[1])
    return float(abs(np.sum(gradient * step) - difference) / (np.linalg.norm(gradient) * np.linalg.norm(step)))


def run_calls(count: int, device) -> dict:
    """Time the field, the wrench and the equilibrium of a pile, and their gradients."""
    system = make_system(count, "float32", device)
    solve_cold(system)
    system.apply_forces()
    forces, torques = _cotangents(system, 2)
    packed = PackedMoments(system.radii, largest_radius=RADIUS, moving=False)
    packed.pack(system.positions, system.moments)
    _load(system)

    def sum_cotangents():
        packed.find_overlaps()
        system.gradients.evaluate()

    gradients, rotatable = system.gradients, wp.ones(count, dtype=int, device=device)
    wrench = PairEvaluation(
        Quantity.WRENCH, [(0, count, 0, count)], packed, packed, system.external_field, system.forces,
        with_torque=rotatable, torques=system.torques,
    )  # fmt: skip
    times = {
        "field": lambda: (packed.find_overlaps(), system.evaluate()),
        "field_by_moments": sum_cotangents,
        "field_by_moments_and_positions": lambda: (packed.find_overlaps(), gradients.fields.launch()),
        "wrench": lambda: (packed.find_overlaps(), wrench.launch()),
        "wrench_gradient": lambda: gradients.wrench(forces, torques),
        "cold_solve": lambda: solve_cold(system),
        "solve_gradient": lambda: (_load(system), gradients.solve(forces)),
    }
    result = {f"{name}_seconds": measure(work, device) for name, work in times.items()}
    result |= {
        "evaluations": int(system.evaluations.numpy()[0]),
        "gradient_evaluations": int(gradients.evaluations()[0]),
    }
    nearby = wp.array(forces.numpy() + 0.01 * torques.numpy(), dtype=forces.dtype, device=device)
    gradients.solve(nearby, warm=True)
    result["warm_gradient_evaluations"] = int(gradients.evaluations()[0])
    return result


def make_worlds(worlds: int, count: int, device, dtype: str = "float32", rtol: float = 1e-3) -> MomentSystem:
    """Return a system of one touching pile of balls in each world."""
    system = moment_system(
        radii=np.full(worlds * count, RADIUS), worlds=np.repeat(np.arange(worlds), count), saturation=SATURATION,
        external_field=[0.0, 0.0, 0.5 * SATURATION], dtype=dtype, device=device, rtol=rtol,
    )  # fmt: skip
    system.positions.assign(np.concatenate([1.01 * touching_pile(count, seed) for seed in range(worlds)]))
    return system


def run_worlds(worlds: int, device) -> dict:
    """Time a cold solve, forces and their gradient in each of many worlds."""
    exact = make_worlds(3, _BALLS, device, "float64", 1e-12)
    error = _check(exact, *_cotangents(exact, 2))
    system = make_worlds(worlds, _BALLS, device)
    forces, torques = _cotangents(system, 2)

    def solve_and_apply():
        solve_cold(system)
        system.apply_forces()

    solve_and_apply()
    seconds = {
        "solve_seconds": measure(solve_and_apply, device),
        "gradient_seconds": measure(lambda: _differentiate_forces(system, forces, torques), device),
    }
    return {
        "worlds": worlds,
        **seconds,
        "world_gradients_per_second": worlds / seconds["gradient_seconds"],
        "solves_and_gradients_per_second": worlds / sum(seconds.values()),
        "gradient_evaluations": float(system.gradients.evaluations().mean()),
        "error": error,
    }


def _wall_time(work, device, repeats: int = 7) -> float:
    """Median time [s] of a function that may wait for the device."""
    laps = []
    for _ in range(repeats + 1):
        wp.synchronize_device(device)
        began = time.perf_counter()
        work()
        wp.synchronize_device(device)
        laps.append(time.perf_counter() - began)
    return float(np.median(laps[1:]))


def field_gradients(positions, moments, targets, cotangents, device) -> list[np.ndarray]:
    """Return the gradients of Σ v·H in float64 by positions, moments and targets, each of shape [n, 3]."""
    arrays = [
        wp.array(values, dtype=wp.vec3d, device=device, requires_grad=True) for values in (positions, moments, targets)
    ]
    with wp.Tape() as tape:
        field = h_field(*arrays, dtype="float64")
    tape.backward(grads={field: wp.array(cotangents, dtype=wp.vec3d, device=device)})
    return [array.grad.numpy() for array in arrays]


def run_multipoles(count: int, device) -> dict:
    """Time the field of moments by the fast multipole method, and its gradients on a tape.

    ``error`` is that of Σ v·H(m) = Σ m·∂(Σ v·H)/∂m, relative to the product of the norms of v and H.
    """
    rng = np.random.default_rng(0)
    positions, moments, seed = (rng.uniform(-1.0, 1.0, (count, 3)).astype(np.float32) for _ in range(3))
    cotangents, result = wp.array(seed, dtype=wp.vec3, device=device), {}
    for name, of_positions, of_moments in (
        ("field", False, False),
        ("field_by_moments", False, True),
        ("field_by_moments_and_positions", True, True),
    ):
        x = wp.array(positions, dtype=wp.vec3, device=device, requires_grad=of_positions)
        m = wp.array(moments, dtype=wp.vec3, device=device, requires_grad=of_moments)

        def evaluate(x=x, m=m):
            return h_field(x, m, method="fmm", rtol=1e-3)

        if name == "field":
            result[f"{name}_seconds"] = _wall_time(evaluate, device)
            continue
        with wp.Tape() as tape:
            field = evaluate()
        result[f"{name}_seconds"] = _wall_time(
            lambda tape=tape, field=field: (tape.zero(), tape.backward(grads={field: cotangents})), device
        )
        h = field.numpy().astype(float)
        difference = np.sum(seed * h) - np.sum(m.grad.numpy().astype(float) * moments)
        result["error"] = float(abs(difference) / (np.linalg.norm(seed) * np.linalg.norm(h)))
    if device.is_cuda and wp.is_mempool_supported(device):
        result["peak_bytes"] = wp.get_mempool_used_mem_high(device)
    return result


def run_peer(count: int) -> dict:
    """Time the gradients of the field of dipoles at as many targets, by warpmag and by magpylib-jax, in float64."""
    from bench.peers import with_magpylib_jax  # noqa: PLC0415 - installed by itself

    rng, device = np.random.default_rng(0), wp.get_device("cpu")
    arrays = [rng.uniform(-1.0, 1.0, (count, 3)) for _ in range(4)]
    peer = with_magpylib_jax.field_gradients(*arrays)
    own, peer_time = (
        np.stack(field_gradients(*arrays, device=device)),
        _wall_time(lambda: (peer.run(), peer.wait()), device),
    )
    errors = np.linalg.norm(own - peer.result(), axis=(1, 2)) / np.linalg.norm(own, axis=(1, 2))
    own_time = _wall_time(lambda: field_gradients(*arrays, device=device), device)
    return {
        "error": float(errors.max()),
        "seconds": own_time,
        "magpylib_jax_seconds": peer_time,
        "speedup": peer_time / own_time,
    }


def main() -> None:
    """Run the cases named on the command line."""
    parser = argparse.ArgumentParser(prog="python -m bench.gradients", description=__doc__.partition("\n")[0])
    cases = "calls", "worlds", "multipoles", "peer"
    parser.add_argument("cases", nargs="*", default=cases[:3], help=f"{', '.join(cases)} (default: all but peer)")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--sizes", type=int, nargs="+", help="numbers of balls of calls")
    parser.add_argument("--worlds", type=int, help="number of worlds")
    parser.add_argument("--moments", type=int, nargs="+", help="numbers of moments of multipoles")
    options = parser.parse_args()
    wp.config.log_level = wp.LOG_WARNING
    device = wp.get_device(options.device)
    kind = "cuda" if device.is_cuda else "cpu"
    write = line_writer(device)
    if "calls" in options.cases:
        for count in options.sizes or _SIZES[kind]:
            write({"case": "calls", "count": count, **run_calls(count, device)})
    if "worlds" in options.cases:
        write({"case": "worlds", "count": _BALLS, **run_worlds(options.worlds or _WORLDS[kind], device)})
    if "multipoles" in options.cases:
        for count in options.moments or _MOMENTS[kind]:
            write({"case": "multipoles", "count": count, **run_multipoles(count, device)})
    if "peer" in options.cases:
        for count in _PEER_SIZES:
            write({"case": "peer", "count": count, **run_peer(count)})


if __name__ == "__main__":
    main()
