"""Fig. 9: iterations that one moment needs, over time step and field strength, for random directions of the field.

The paper multiplies its 100 ns by 1.0 to 1.5 and takes ‖H‖ as 0 to 10 times ‖M‖, here Ms. It does not say to which κ
its 100 ns corresponds. The flow takes κ0 = k = 3, the step that ends on the curve in one iteration. The explicit
dynamics take the κ0 of Fig. 8, and others as second choices.

One test follows a moment of slope k = 3 in the field H until ‖M − f(H)‖ ≤ tolerance ‖f(H)‖ (Ms replaces ‖f(H)‖ where
H = 0). It fails after ``MOST_ITERATIONS``. It starts from a pair M1, M2 open by an angle, the flow from their mean. All
of it is NumPy, by the equations of ``warpmag.kernels.induction``:

| dynamics | iteration |
|---|---|
| theta | exact θ flow with ω = κ/k, Anderson acceleration with the last iterate |
| theta-flow | the same flow without acceleration |
| theta-euler, llg, llg-damping | one step of each submagnetization |
| llg-unscaled, llg-damping-unscaled | LLG without scaling M_i back to Ms |
"""

import time
from dataclasses import dataclass

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.colors import LogNorm

from bench.paper.output import Output, table
from warpmag.moments.dynamics import STEP

MOST_ITERATIONS = 999
SLOPE = 3.0
"""Initial slope k of the curve, and step κ0 of the flow."""
ROWS_AT_ONCE = 40  # field strengths of one batch, which bounds the memory


@dataclass(frozen=True)
class Case:
    """One sweep: a dynamics with its curve and constants."""

    dynamics: str
    curve: str  # magnetization curve, ``tanh`` or ``clamped``
    kappa: float  # step κ0
    opening: float = 180.0  # angle between M1 and M2 at the start [degrees]
    tolerance: float = 1e-3  # magnetization error (Eq. 12) at which a test ends
    damping: float = 0.2  # damping α of LLG


PANELS = {
    "(a) warpmag (theta)": Case("theta", "tanh", SLOPE),
    "(a') the paper (theta-euler)": Case("theta-euler", "tanh", STEP),
    "(b) Kim et al. 2018 (llg)": Case("llg", "clamped", STEP),
    "(c) damping-only LLG": Case("llg-damping", "clamped", STEP),
}
SECOND_CHOICES = (
    ("flow not accelerated", Case("theta-flow", "tanh", SLOPE)),
    ("pair open 90°", Case("theta", "tanh", SLOPE, opening=90.0)),
    ("e_M ≤ 1e-5", Case("theta", "tanh", SLOPE, tolerance=1e-5)),
    *((f"κ0 = {kappa:g}", Case("theta-euler", "tanh", kappa)) for kappa in (0.03, 0.1, 1.0, 3.0)),
    ("pair open 90°", Case("theta-euler", "tanh", STEP, opening=90.0)),
    *((f"κ0 = {kappa:g}", Case("llg", "clamped", kappa)) for kappa in (0.003, 0.01, 0.03, 0.1, 1.0)),
    ("pair open 90°", Case("llg", "clamped", STEP, opening=90.0)),
    ("α = 0.25", Case("llg", "clamped", STEP, damping=0.25)),
    ("M_i not scaled back", Case("llg-unscaled", "clamped", STEP)),
    *((f"κ0 = {kappa:g}", Case("llg-damping", "clamped", kappa)) for kappa in (0.03, 0.1, 1.0)),
    ("M_i not scaled back", Case("llg-damping-unscaled", "clamped", STEP)),
)


@dataclass(frozen=True)
class Grid:
    """Multipliers of the time step, field strengths over Ms, and number of directions per cell."""

    multipliers: np.ndarray
    strengths: np.ndarray
    directions: int = 16


def make_grid(small: bool) -> Grid:
    """Return the paper's grid, or a coarse one; 16 directions per cell in place of its 10,000."""
    columns, rows = (6, 51) if small else (51, 1001)
    return Grid(np.linspace(1.0, 1.5, columns), np.linspace(0.0, 10.0, rows))


@dataclass(frozen=True)
class Counts:
    """Mean and largest number of iterations and share of failed tests of each cell, shape [strengths, multipliers]."""

    mean: np.ndarray
    most: np.ndarray
    failed: np.ndarray

    def summary(self) -> dict:
        """Statistics of all cells."""
        return {
            "mean_iterations": float(self.mean.mean()),
            "most_iterations": int(self.most.max()),
            "failed_tests": float(self.failed.mean()),
            "cells_with_failures": float((self.failed > 0).mean()),
            "cells_failed": float((self.failed == 1).mean()),
        }


def sweep(case: Case, grid: Grid) -> Counts:
    """Run one sweep."""
    random, parts = np.random.default_rng(0), []
    for begin in range(0, len(grid.strengths), ROWS_AT_ONCE):
        strengths = grid.strengths[begin : begin + ROWS_AT_ONCE]
        shape = (len(strengths), len(grid.multipliers), grid.directions)
        direction = random.normal(size=(*shape, 3))
        direction /= _size(direction)
        h = (strengths[:, None, None, None] * direction).reshape(-1, 3)
        kappa = np.broadcast_to(case.kappa * grid.multipliers[:, None], shape).reshape(-1, 1)
        parts.append(iterations(case, h, kappa).reshape(shape))
    counts = np.concatenate(parts)
    failed, counts = counts > MOST_ITERATIONS, np.minimum(counts, MOST_ITERATIONS)
    return Counts(counts.mean(axis=2), counts.max(axis=2), failed.mean(axis=2))


@np.errstate(over="ignore", invalid="ignore")  # M_i that are not scaled back may grow without bound
def iterations(case: Case, h: np.ndarray, kappa: np.ndarray) -> np.ndarray:
    """Return the iterations of each test, ``MOST_ITERATIONS`` + 1 where it failed.

    Args:
        case: The dynamics.
        h: Fields over Ms, shape [n, 3].
        kappa: Steps κ, shape [n, 1].
    """
    half = np.radians(0.5 * case.opening)
    pair = [np.broadcast_to((side * np.sin(half), 0.0, np.cos(half)), h.shape) for side in (1.0, -1.0)]
    flow = case.dynamics in ("theta", "theta-flow")
    start = _inverse_curve(0.5 * (pair[0] + pair[1]), case.curve)
    state = [start, start, np.zeros_like(start)] if flow else pair
    solution = _curve(SLOPE * h, case.curve)
    counts, running = np.full(len(h), MOST_ITERATIONS + 1), np.arange(len(h))
    for count in range(1, MOST_ITERATIONS + 1):
        if flow:
            state = _flow_step(*state, SLOPE * h, kappa / SLOPE, case.dynamics == "theta" and count > 1)
            m = _curve(state[0], case.curve)
        else:
            state = _pair_step(*state, h, kappa, case)
            m = 0.5 * (state[0] + state[1])
        size = _size(solution)
        ended = (_size(m - solution) <= case.tolerance * np.where(size > 0.0, size, 1.0))[:, 0]
        counts[running[ended]] = count
        rest = ~ended & np.isfinite(m).all(axis=1)
        running, h, kappa, solution, *state = (array[rest] for array in (running, h, kappa, solution, *state))
        if not len(running):
            break
    return counts


def _flow_step(s, old_s, old_r, target, omega, accelerated: bool) -> list[np.ndarray]:
    """Advance the dual variable s by the exact flow; return the new s, the previous one and its residual."""
    r = target - s
    new = s + omega * r
    if accelerated:
        dr = r - old_r
        size = (dr * dr).sum(axis=1, keepdims=True)
        fraction = (r * dr).sum(axis=1, keepdims=True) / np.where(size > 0.0, size, np.inf)
        new = new - fraction * (s - old_s + omega * dr)
    return [new, s, r]


def _pair_step(u, v, h, kappa, case: Case) -> list[np.ndarray]:
    """Advance the submagnetizations M1/Ms and M2/Ms in their effective field (Eq. 11)."""
    h_eff = h - _inverse_curve(0.5 * (u + v), case.curve) / SLOPE
    if case.dynamics == "theta-euler":
        return [_theta_step(u, h_eff, kappa, 1.0), _theta_step(v, h_eff, kappa, -1.0)]
    precession = 0.0 if "damping" in case.dynamics else 1.0 / case.damping
    unit = not case.dynamics.endswith("unscaled")
    torques = [np.cross(w, h_eff) for w in (u, v)]
    new = [w - kappa * (np.cross(w, t) + precession * t) for w, t in zip((u, v), torques, strict=True)]
    return [w / _size(w) for w in new] if unit else new


def _theta_step(u, h_eff, kappa, side: float) -> np.ndarray:
    """Turn u towards h_eff in their common plane (Eqs. 8, 9); ``side`` ±1 selects the plane if they are parallel."""
    strength = _size(h_eff)
    axis = h_eff / np.where(strength > 0.0, strength, 1.0)
    cosine = (u * axis).sum(axis=1, keepdims=True)
    perpendicular = u - cosine * axis
    sine = _size(perpendicular)
    farthest = np.eye(3)[2 - np.abs(axis)[:, ::-1].argmin(axis=1)]  # coordinate axis, z before y before x
    default = farthest - (farthest * axis).sum(axis=1, keepdims=True) * axis
    normal = np.where(sine > 1e-6, perpendicular / np.where(sine > 1e-6, sine, 1.0), side * default / _size(default))
    rate = np.where(cosine > 0.0, sine, 2.0 - sine)
    theta = np.maximum(np.arctan2(sine, cosine) - kappa * strength * rate, 0.0)
    return np.where(strength > 0.0, np.cos(theta) * axis + np.sin(theta) * normal, u)


def _curve(s, curve: str) -> np.ndarray:
    """M/Ms of reduced fields s = k H/Ms."""
    size = _size(s)
    value = np.tanh(size) if curve == "tanh" else np.minimum(size, 1.0)
    return value / np.where(size > 0.0, size, 1.0) * s


def _inverse_curve(m, curve: str) -> np.ndarray:
    """k H/Ms of magnetizations over Ms, bounded near saturation."""
    if curve == "clamped":
        return m
    size = np.minimum(_size(m), 0.999999)
    return np.where(size > 0.0, np.arctanh(size) / np.where(size > 0.0, size, 1.0), 1.0) * m


def _size(vectors) -> np.ndarray:
    return np.linalg.norm(vectors, axis=-1, keepdims=True)


def run(output: Output):
    """Run the experiment."""
    grid, coarse = make_grid(output.small), make_grid(True)
    figure, axes = plt.subplots(1, len(PANELS), figsize=(4.4 * len(PANELS), 5.0), sharey=True, layout="constrained")
    rows = []
    for axis, (title, case) in zip(axes, PANELS.items(), strict=True):
        counts = _measure(case, grid, output)
        image = axis.pcolormesh(
            grid.multipliers, grid.strengths, np.where(counts.failed == 1, MOST_ITERATIONS, counts.mean),
            cmap="rainbow", norm=LogNorm(1, MOST_ITERATIONS), shading="nearest", rasterized=True,
        )  # fmt: skip
        axis.set(title=title, xlabel="Δt multiplier")
        rows.append([f"`{case.dynamics}`", f"{case.kappa:g}", *_cells(counts)])
    axes[0].set_ylabel("‖H‖ / Ms")
    figure.colorbar(image, ax=axes, label="mean iterations (violet 1, red 999 or failed)")
    second = [
        [f"`{case.dynamics}`", name, *_cells(_measure(case, coarse, output))]
        for name, case in (() if output.small else SECOND_CHOICES)
    ]
    output.report(_text(output.save(figure), grid, rows, second))
    plt.close(figure)


def _measure(case: Case, grid: Grid, output: Output) -> Counts:
    began = time.perf_counter()
    counts = sweep(case, grid)
    size, seconds = {"cells": counts.mean.size, "directions": grid.directions}, round(time.perf_counter() - began, 2)
    output.record(**vars(case), **size, **counts.summary(), seconds=seconds)
    return counts


def _cells(counts: Counts) -> list[str]:
    mean, most, *shares = counts.summary().values()
    return [f"{mean:.2f}", f"{most}", *(f"{100 * share:.2f} %" for share in shares)]


def _text(image, grid, rows, second) -> str:
    head = ["mean iterations", "largest number", "failed tests", "cells with a failure", "cells without a success"]
    choices = f"""

**Does the result depend on the constants that the paper leaves open?** Not for `theta`. The next table varies one
constant at a time, on 6 × 51 cells with 16 directions each. The other constants are those of the figure: M1 and M2
start at an angle of 180°, κ0 as above, e_M ≤ 1e-3, damping α = 0.2 of LLG, and LLG scales M1 and M2 back to Ms after
each step. `theta` starts from the mean of the pair. Fields of this grid are 0.2 Ms apart, so the table misses failures
in weaker fields.

{table(["dynamics", "choice", *head], second)}"""
    return f"""## Fig. 9: iterations over time step and field strength

**Paper:** the paper plots iterations over time step and field strength. Its dynamics needs one iteration or a few
(violet). Kim et al. 2018 and damping-only LLG reach "more than 999 iterations or a failure" (red) as the field grows.

**Here:** a cell is a multiplier of the time step ({len(grid.multipliers)} values from 1 to 1.5) and a field strength
‖H‖ ({len(grid.strengths):,} values from 0 to 10 Ms). A test magnetizes a single moment in a field of random direction,
from M1 = −M2. Each cell has {grid.directions:,} tests. A test ends at e_M ≤ 1e-3, and fails after {MOST_ITERATIONS}
iterations. It then counts as {MOST_ITERATIONS} in the mean.

κ0 is κ at the multiplier 1. It is {STEP:g} for pairs, as in Fig. 8, and {SLOPE:g} for `theta`, which is the slope k.
`theta` needs one iteration where the multiplier is 1 or the moment saturates, and two elsewhere. At this κ0
`theta-euler` and damping-only LLG fail in weak fields (below 0.1 Ms). Damping-only LLG also fails where κ‖H‖ > 2 Ms,
the stability limit of its explicit step.

{image}

{table(["dynamics", "κ0", *head], rows)}{choices if second else ""}"""
