"""Checks and times warpmag: ``python -m bench.run CASE [--device cuda:0] [--sizes 243 2560]``.

Each size is compared with the float64 oracle at some targets, then timed. Induction and scenes report the error of the
solve itself. ``writing`` compares runs with and without output. ``swarm`` times the start and the writing of very many
balls. Each measurement is one JSON line with machine, commit, error and the time of the first call, which compiles.
"""

import argparse
import functools
import time

import numpy as np
import warp as wp

from bench.cases import CASES, RADIUS, SATURATION, Case, touching_pile
from bench.machine import line_writer
from bench.reference import oracle
from bench.scene import run_bundled, run_scene
from bench.systems import moment_system, solve_cold
from bench.timing import measure
from bench.writing import run_swarm, run_writing
from warpmag.moments.system import MomentSystem
from warpmag.scenes_usd import bundled

_WORLDS = {"cpu": 32, "cuda": 1024}
_CHECKED = 64  # number of targets compared with the oracle


def make_system(count: int, dtype: str, device, contact_model: str = "dipole") -> MomentSystem:
    """System of a touching pile of iron balls in a field of half their saturation."""
    system = moment_system(
        radii=np.full(count, RADIUS), saturation=SATURATION, external_field=[0.0, 0.0, 0.5 * SATURATION],
        contact_model=contact_model, dtype=dtype, device=device,
    )  # fmt: skip
    system.positions.assign(touching_pile(count))
    return system


def oracle_at(x, m, radius, rows) -> tuple[np.ndarray, np.ndarray]:
    """The oracle's field [A/m] and force [N] of all other moments ``m`` at ``x`` on the moments ``rows``."""
    x, m = x.astype(float), m.astype(float)
    h, force = np.empty((len(rows), 3)), np.empty((len(rows), 3))
    for k, i in enumerate(rows):
        pairs = (np.delete(x, i, 0), np.delete(m, i, 0), x[i : i + 1])
        h[k] = oracle.h_field(*pairs, radii=radius, target_radii=radius)
        gradient = oracle.field_gradient(*pairs, radii=radius, target_radii=radius)
        force[k] = oracle.kelvin_force(m[i : i + 1], gradient)
    return h, force


def run_sums(system, device, *, forces: bool) -> dict:
    """Time one evaluation of the field, or of the forces, and compare it with the oracle."""
    rows = np.linspace(0, system.count - 1, min(_CHECKED, system.count)).astype(int)
    field, force = oracle_at(system.positions.numpy(), system.moments.numpy(), system.radii.numpy()[0], rows)
    system.h.zero_()
    seconds = measure(system.apply_forces if forces else system.evaluate, device)
    if forces:
        error = oracle.relative(system.forces.numpy()[rows], force)
    else:
        error = oracle.relative(system.h.numpy()[rows] - system.external_field.numpy()[rows], field)
    return {"seconds": seconds, "pairs_per_second": system.count**2 / seconds, "error": error}


def run_induction(system, device) -> dict:
    """Time a cold and a warm solve; the error is the estimate of the solve."""
    seconds = measure(lambda: solve_cold(system), device)
    evaluations = int(system.evaluations.numpy()[0])
    warm = measure(system.solve, device)
    return {
        "seconds": seconds,
        "evaluations": evaluations,
        "warm_seconds": warm,
        "warm_evaluations": int(system.evaluations.numpy()[0]),
        "error": float(system.error.numpy()[0]),
        "converged": bool(system.converged.numpy()[0]),
    }


def make_worlds(worlds: int, count: int, device) -> tuple[MomentSystem, list[wp.array]]:
    """System of one pile of ``make_system`` in each world, and its positions before and after a small motion [m]."""
    system = moment_system(
        radii=np.full(worlds * count, RADIUS), worlds=np.repeat(np.arange(worlds), count), saturation=SATURATION,
        external_field=[0.0, 0.0, 0.5 * SATURATION], device=device,
    )  # fmt: skip
    start = np.concatenate([touching_pile(count, seed) for seed in range(worlds)])
    motion = 1e-3 * RADIUS * np.random.default_rng(1).normal(size=start.shape)
    dtype = system.positions.dtype
    return system, [wp.array(positions, dtype=dtype, device=device) for positions in (start, start + motion)]


def run_worlds(count: int, device) -> dict:
    """Time a magnetic step of many worlds whose balls move by 1e-3 radii, and its parts; check one world."""
    worlds = _WORLDS["cpu" if device.is_cpu else "cuda"]
    began = time.perf_counter()
    system, states = make_worlds(worlds, count, device)

    def there_and_back():
        for positions in states:
            wp.copy(system.positions, positions)
            system.solve()
            system.apply_forces()

    there_and_back()
    wp.synchronize_device(device)
    first = time.perf_counter() - began
    seconds = 0.5 * measure(there_and_back, device)
    field, force = measure(system.evaluate, device), measure(system.apply_forces, device)
    last = slice((worlds - 1) * count, worlds * count)
    _, expected = oracle_at(system.positions.numpy()[last], system.moments.numpy()[last], RADIUS, range(count))
    return {
        "worlds": worlds,
        "seconds": seconds,
        "world_steps_per_second": worlds / seconds,
        "field_seconds": field,
        "force_seconds": force,
        "evaluations": float(system.evaluations.numpy().mean()),
        "error": oracle.relative(system.forces.numpy()[last], expected),
        "converged": bool(system.converged.numpy().all()),
        "first_call_seconds": first,
    }


RUNNERS = {
    "field": functools.partial(run_sums, forces=False),
    "force": functools.partial(run_sums, forces=True),
    "induction": run_induction,
}


def run_system(case: Case, count: int, dtype: str, device) -> dict:
    """Measure a case that is one part of a step."""
    began = time.perf_counter()
    system = make_system(count, dtype, device)
    system.solve()
    system.apply_forces()
    wp.synchronize_device(device)
    first = time.perf_counter() - began
    return {**RUNNERS[case.name](system, device), "first_call_seconds": first}


def run_case(case: Case, device, sizes, frames: int | None, scenes=()) -> None:
    """Print a JSON line for each size and precision of a case, or for each of the bundled scenes."""
    write = line_writer(device)
    for name in scenes:
        write({"case": case.name, "scene": name, **run_bundled(name, device)})
    if scenes:
        return
    runs = {
        "worlds": run_worlds,
        "scene": run_scene,
        "writing": functools.partial(run_writing, frames=frames),
        "swarm": functools.partial(run_swarm, frames=frames),
    }
    for dtype in case.dtypes:
        for count in sizes or case.sizes["cpu" if device.is_cpu else "cuda"]:
            run = runs.get(case.name)
            result = run(count, device) if run else run_system(case, count, dtype, device)
            write({"case": case.name, "dtype": dtype, "count": count, **result})


def main() -> None:
    """Run the case named on the command line."""
    parser = argparse.ArgumentParser(prog="python -m bench.run", description=__doc__.partition("\n")[0])
    parser.add_argument("case", choices=sorted(CASES), help="; ".join(f"{c.name}: {c.summary}" for c in CASES.values()))
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--sizes", type=int, nargs="+")
    parser.add_argument("--frames", type=int, help="frames, for writing and swarm")
    text = "bundled scenes, for the case scene, in place of Balls Up by size"
    parser.add_argument("--scenes", nargs="+", default=(), choices=sorted(bundled()), help=text)
    options = parser.parse_args()
    if options.scenes and options.case != "scene":
        parser.error("--scenes is for scene")
    wp.config.log_level = wp.LOG_WARNING
    run_case(CASES[options.case], wp.get_device(options.device), options.sizes, options.frames, options.scenes)


if __name__ == "__main__":
    main()
