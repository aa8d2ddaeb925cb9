"""Program of the ranks of ``test_ranks.py``: ``calls PATH DEVICE``, or ``run`` and arguments of the command.

Several of these follow each other, with ``then`` between them, in one process.
"""

import sys
from itertools import groupby

import newton
import numpy as np
import warp as wp

import warpmag
from warpmag import cli
from warpmag.kernels.pairs import evaluate
from warpmag.moments.layout import MomentMaterial
from warpmag.moments.ranks import current_ranks, on_first_rank
from warpmag.moments.system import MomentSystem

SIZES = {"cpu": (1, 7, 1001), "cuda": (1, 7, 6001)}
"""Numbers of moments; the last is shared out by all forms of the sums, which a GPU takes for thousands of them."""
MANY = {"cpu": 1001, "cuda": 400_000}
"""Those of the fast multipole method: a GPU has to have thousands of cells."""


def main(*arguments: str) -> int:
    """Do the parts with all sums shared out; print the numbers of merged sums on stderr, and return the exit code."""
    wp.config.enable_backward = False  # as the tests do, so that both find the same compiled kernels
    wp.config.log_level = wp.LOG_ERROR  # as the command does
    evaluate._FEWEST_PAIRS_OF_RANKS = dict.fromkeys(evaluate._FEWEST_PAIRS_OF_RANKS, 1)
    all_ranks, merged = current_ranks(), []
    if all_ranks is not None:
        merge = all_ranks.merge
        all_ranks.merge = lambda array: (merged.append(1), merge(array))
    for is_end, words in groupby(arguments, "then".__eq__):
        if is_end:
            continue
        part = [*words]
        if code := cli.main(part) if part[0] == "run" else calls(*part[1:]):
            return code
        print(f"merged {part[0]} {len(merged)}", file=sys.stderr)
        merged.clear()
    return 0


def calls(path: str, device: str) -> int:
    """Write results by name to ``path``, ``_``, the rank and ``.npz``; of several ranks print what errors they get."""
    place = None if device == "cuda" else device  # each rank has a GPU of its own
    results = sums(place) | {"worlds": several_worlds([3, 700, 641, 800], place)} | sweeps(place)
    np.savez(f"{path}_{0 if current_ranks() is None else current_ranks().rank}.npz", **results)
    if current_ranks() is not None:
        differ()
    return 0


def sums(place: str | None) -> dict[str, np.ndarray]:
    """Return what calls on arrays do, by name."""
    results, kind = {}, "cuda" if place is None else "cpu"
    for n in SIZES[kind]:
        x, m = moments(n)
        results[f"h {n}"] = warpmag.h_field(x, m, device=place)
        results[f"h double {n}"] = warpmag.h_field(x, m, dtype="float64", device=place)
        results[f"h elsewhere {n}"] = warpmag.h_field(x, m, x + 0.1, device=place)
        results[f"force {n}"], results[f"torque {n}"] = warpmag.wrench(x, m, radii=0.4, device=place)
        solved = warpmag.solve_induction(
            x, 0.4, saturation=1e6, external_field=(0, 0, 1e5), contact_model="multipole", device=place
        )
        results[f"magnetization {n}"], results[f"field {n}"] = solved.magnetizations, solved.h_field
        results[f"pull {n}"] = solved.wrench()[0]
    x, m = moments(MANY[kind])
    results["multipoles"] = warpmag.h_field(x, m, x[::2] + 0.1, method="fmm", device=place)
    results["multipole force"] = warpmag.wrench(x, m, method="fmm", device=place)[0]
    return results


def moments(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Positions and moments, shape [n, 3] both."""
    random = np.random.default_rng(n)
    return random.normal(size=(n, 3)) * n ** (1 / 3), random.normal(size=(n, 3))


def several_worlds(sizes: list[int], device: str | None) -> np.ndarray:
    """Magnetizations of worlds of some sizes."""
    worlds, random = np.repeat(range(len(sizes)), sizes), np.random.default_rng(0)
    radii, field = np.full(len(worlds), 0.4), (0, 0, 1e5)
    system = MomentSystem(radii=radii, worlds=worlds, material=MomentMaterial(1e6), external_field=field, device=device)
    system.positions.assign(10.0 * random.random((len(worlds), 3)))
    system.solve()
    return system.magnetizations().numpy()


def differ() -> None:
    """Print the errors that this rank gets if arguments differ between ranks, one line each."""
    rank, x = current_ranks().rank, np.eye(3)
    model = small_scene(1e6 + rank).finalize(device="cpu")
    tries = {
        "h_field": lambda: warpmag.h_field(x * (1 + rank), x, device="cpu"),
        "not finite": lambda: warpmag.h_field(x, x * (1.0 if rank == 0 else np.nan), device="cpu"),
        "wrench": lambda: warpmag.wrench(x, x, radii=[0.1 + rank, 0.1, 0.1], device="cpu"),
        "solve_induction": lambda: warpmag.solve_induction(x, 0.1, saturation=1e6 + rank, device="cpu"),
        "permanent": lambda: warpmag.solve_induction(x, 0.1, saturation=1e6, permanent=(x + 2, x + rank), device="cpu"),
        "Magnetics": lambda: warpmag.Magnetics(model),
        "rtol": lambda: warpmag.Magnetics(small_scene().finalize(device="cpu"), rtol=1e-3 * (1 + rank)),
        "Simulation": lambda: warpmag.Simulation(small_scene(), dt=1e-3 * (1 + rank), device="cpu"),
        "one only": lambda: warpmag.Simulation("no.usda" if rank else small_scene(), device="cpu"),
        "on_first_rank": lambda: on_first_rank(lambda: 1 // 0, current_ranks()),
        "sweep": lambda: warpmag.sweep(lambda worlds: 1 // (1 - worlds[0]), 4, together=1),
    }
    for name, given in tries.items():
        try:
            given()
        except (warpmag.InputError, RuntimeError) as error:
            print(f"{rank} {name}: {error}", flush=True)


def sweeps(place: str | None) -> dict[str, np.ndarray]:
    """Return what sweeps find, of 5 worlds that move, two of them together, and of worlds of arrays."""
    fields = np.linspace(1e5, 3e5, 5)

    def poses(worlds: range) -> np.ndarray:
        simulation = warpmag.Simulation(small_scene(worlds=len(worlds)), device=place)
        simulation.magnetics.set_external_field(np.outer(fields[worlds], (0.0, 0.0, 1.0)))
        for _ in range(5):
            simulation.step()
        return simulation.state.body_q.numpy().reshape(len(worlds), -1, 7)

    result = warpmag.sweep(poses, len(fields), together=2)
    assert [len(entry) for entry in result] == [2, 2, 1]
    sizes = warpmag.sweep(lambda worlds: several_worlds([40 + world for world in worlds], place), 3, together=1)
    return {"sweep": np.concatenate(result), "sweep of arrays": np.concatenate(sizes)}


def small_scene(saturation: float = 1e6, worlds: int = 1) -> newton.ModelBuilder:
    """Two iron balls, one above the other, in each of several worlds."""
    world = newton.ModelBuilder()
    warpmag.register_custom_attributes(world)
    for k in range(2):
        ball = world.add_body(xform=wp.transform((0.0, 0.0, 0.0102 * k), wp.quat_identity()))
        world.add_shape_sphere(ball, radius=0.005)
        warpmag.add_inducible(world, body=ball, saturation=saturation)
    builder = newton.ModelBuilder()
    builder.replicate(world, worlds)
    return builder


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
