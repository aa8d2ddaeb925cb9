"""Exact solutions of clusters of permeable balls: ``python -m bench.reference.clusters`` writes ``clusters.json``.

Narrow gaps need expansions of up to order 39, minutes for thirteen balls. So ``bench.accuracy`` reads the solutions
from the file, and a test recomputes some of them.
"""

import json
import math
from pathlib import Path

import numpy as np

from bench.reference.spheres import Solution, spheres_in_fields

FILE = Path(__file__).with_name("clusters.json")
GAPS = (0.01, 0.02, 0.05, 0.1, 0.2, 0.3)
"""Gaps between neighbors over their radius."""
PERMEABILITIES = (4.0, 10.0, math.inf)
FIELDS = {
    "chain": {"along": (0.0, 0.0, 1.0), "across": (1.0, 0.0, 0.0)},
    "fcc": {"001": (0.0, 0.0, 1.0), "111": (3.0**-0.5, 3.0**-0.5, 3.0**-0.5)},
}
"""Directions of the unit field, by cluster."""
TOLERANCE = 1e-3
"""Target truncation error of the expansions. The stored truncation, the change from two thirds of the order, is an
upper bound: the error falls by exp(−2ξ) per degree (see ``spheres``), at the narrowest gap to a tenth of the bound."""


def positions(cluster: str, gap: float) -> np.ndarray:
    """Centers of balls of unit radius: three in a row, or a ball and its twelve neighbors in an FCC lattice."""
    if cluster == "chain":
        return (2.0 + gap) * np.outer(np.arange(3.0), [0.0, 0.0, 1.0])
    corners = np.array([[a, b, 0.0] for a in (1.0, -1.0) for b in (1.0, -1.0)])
    centers = [np.zeros((1, 3)), corners, corners[:, [0, 2, 1]], corners[:, [2, 0, 1]]]
    return (2.0 + gap) / np.sqrt(2.0) * np.concatenate(centers)


def solve(cluster: str, gap: float, permeabilities=PERMEABILITIES) -> dict[tuple[float, str], Solution]:
    """Solutions by permeability and direction of the field."""
    keys = [(permeability, name) for permeability in permeabilities for name in FIELDS[cluster]]
    cases = [(permeability, FIELDS[cluster][name]) for permeability, name in keys]
    return dict(zip(keys, spheres_in_fields(positions(cluster, gap), 1.0, cases, tolerance=TOLERANCE), strict=True))


def load() -> list[dict]:
    """Rows of the file: cluster, gap, permeability, field; moments and forces [n, 3], order, truncation."""
    return json.loads(FILE.read_text(encoding="utf-8"))


def main() -> None:
    """Solve every cluster and write the file."""
    rows = []
    for cluster in FIELDS:
        for gap in GAPS:
            for (permeability, field), solution in solve(cluster, gap).items():
                rows.append({
                    "cluster": cluster, "gap": gap, "permeability": permeability, "field": field,
                    "order": solution.order, "truncation": float(f"{solution.truncation:.2g}"),
                    "moments": _rounded(solution.moments), "forces": _rounded(solution.forces),
                })  # fmt: skip
            print(f"{cluster}, gap {gap}: order {rows[-1]['order']}", flush=True)
    FILE.write_text("[\n" + ",\n".join(json.dumps(row) for row in rows) + "\n]\n", encoding="utf-8")


def _rounded(vectors) -> list[list[float]]:
    """Vectors rounded to six digits of the largest component."""
    digits = 6 - math.ceil(math.log10(np.abs(vectors).max()))
    return (np.round(vectors, digits) + 0.0).tolist()


if __name__ == "__main__":
    main()
