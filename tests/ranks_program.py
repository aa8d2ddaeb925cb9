"""What the ranks of ``test_ranks.py`` compute: results by name, and how often sums were merged, in a file each."""

import sys

import numpy as np
import warp as wp

import warpmag
from warpmag.ranks import ranks
from warpmag.system import MomentSystem


def main(path: str, device: str | None) -> None:
    """Write what this rank ends with to ``path``, ``_``, the rank and ``.npz``."""
    wp.config.enable_backward = False  # as the tests do, so that both find the same compiled kernels
    all_ranks, merged = ranks(), []
    if all_ranks is not None:
        merge = all_ranks.merge
        all_ranks.merge = lambda array: (merged.append(1), merge(array))
    results = {}
    for n in (1, 7, 1001):
        random = np.random.default_rng(n)
        x, m = random.normal(size=(n, 3)) * n ** (1 / 3), random.normal(size=(n, 3))
        results[f"h {n}"] = warpmag.h_field(x, m, device=device)
        results[f"h double {n}"] = warpmag.h_field(x, m, dtype="float64", device=device)
        results[f"h elsewhere {n}"] = warpmag.h_field(x, m, x + 0.1, device=device)
        results[f"force {n}"], results[f"torque {n}"] = warpmag.wrench(x, m, radii=0.4, device=device)
        solved = warpmag.solve_induction(
            x, 0.4, saturation=1e6, external_field=(0, 0, 1e5), contact_model="multipole", device=device
        )
        results[f"magnetization {n}"], results[f"field {n}"] = solved.magnetizations, solved.h_field
        results[f"pull {n}"] = solved.wrench()[0]
        results[f"multipoles {n}"] = warpmag.h_field(x, m, x[::2] + 0.1, method="fmm", device=device)
        results[f"multipole force {n}"] = warpmag.wrench(x, m, method="fmm", device=device)[0]
    results["worlds"] = several_worlds(device)
    np.savez(f"{path}_{0 if all_ranks is None else all_ranks.rank}.npz", merged=len(merged), **results)


def several_worlds(device: str | None) -> np.ndarray:
    """Magnetizations of worlds of different sizes."""
    worlds, random = np.repeat([0, 1, 2, 3], [3, 700, 641, 800]), np.random.default_rng(0)
    system = MomentSystem(
        radii=np.full(len(worlds), 0.4), worlds=worlds, saturation=1e6, external_field=(0, 0, 1e5), device=device
    )
    system.positions.assign(10.0 * random.random((len(worlds), 3)))
    system.solve()
    return system.magnetizations().numpy()


if __name__ == "__main__":
    main(sys.argv[1], None if sys.argv[2] == "cuda" else sys.argv[2])  # each rank has a GPU of its own
