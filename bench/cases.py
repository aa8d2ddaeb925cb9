"""Benchmark cases as data: arrangements of balls, and the sizes to run them at."""

from dataclasses import dataclass

import numpy as np

RADIUS = 0.005  # ball radius of every case [m]
SATURATION = 1.7e6  # saturation magnetization of every case [A/m]


@dataclass(frozen=True)
class Case:
    """One benchmark."""

    name: str  # its name on the command line
    summary: str  # quantity that is timed
    sizes: dict[str, tuple[int, ...]]  # numbers of balls on a CPU and on a GPU
    dtypes: tuple[str, ...] = ("float32",)


def _sizes(cpu: tuple[int, ...], *more: int) -> dict[str, tuple[int, ...]]:
    return {"cpu": cpu, "cuda": (*cpu, *more)}


_USUAL, _BOTH = (243, 1032, 2560, 10000), ("float32", "float64")
CASES = {
    case.name: case
    for case in (
        Case("field", "one all-pairs field evaluation, overlaps included", _sizes(_USUAL, 32768, 131072), _BOTH),
        Case("force", "field gradient, forces and torques of all balls", _sizes(_USUAL, 32768, 131072)),
        Case("induction", "a cold and a warm induction solve to 1e-3, neighbor search included", _sizes(_USUAL, 32768)),
        Case(
            "worlds",
            "a warm solve and forces in 1,024 worlds (32 on a CPU) of moving balls",
            {"cpu": (64,), "cuda": (8, 27, 64, 125, 216)},
        ),
        Case("scene", "steps of Balls Up: induction, forces, rigid bodies, host", _sizes((243, 2500), 10000)),
        Case("writing", "runs of Balls Up with and without output, in turns", {"cpu": (243,), "cuda": (2500,)}),
        Case("swarm", "Sakura Tree of very many balls: start, and writing without physics", _sizes((100_000,))),
    )
}

PILES = {
    243: {"columns": 9, "rows": 9, "layers": 3, "height": 0.051},
    2500: {"columns": 25, "rows": 25, "layers": 4, "height": 0.0611},
    10000: {"columns": 50, "rows": 50, "layers": 4, "height": 0.0611},
}
"""Parameters of Balls Up by number of balls: the bundled scene, and wider piles with the same gap to the magnet."""


def touching_pile(count: int, seed: int = 0) -> np.ndarray:
    """Positions [m] of balls of ``RADIUS`` on a cubic grid that fills a cube, touching to 0.1 %, shape [count, 3]."""
    side = round(np.ceil(count ** (1.0 / 3.0)))
    grid = np.stack(np.meshgrid(*[np.arange(float(side))] * 3, indexing="ij"), -1).reshape(-1, 3)[:count]
    jitter = np.random.default_rng(seed).normal(size=(count, 3))
    return (2.0 * RADIUS * (grid + 1e-3 * jitter)).astype(np.float32)
