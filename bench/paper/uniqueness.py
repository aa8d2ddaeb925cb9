"""Section 6.3: all methods that converge agree in the magnetization."""

import numpy as np

from bench.paper import crystal_balls
from bench.paper.output import Output, table
from bench.reference import oracle
from warpmag.declarations.magnets import DYNAMICS, SATURATION_OF_IRON
from warpmag.moments.dynamics import STEP

RTOL = 1e-9
MOST = {"theta": 200, "theta-euler": 3000, "llg": 3000, "llg-damping": 3000}
PAPERS_DEVIATION = 8e-4
BARS = (1e5, 3e5, 1e6)
"""Magnetizations of the bar [A/m] at which the two curves are compared."""


def run(output: Output):
    """Run the experiment."""
    rows = []
    for strength in crystal_balls.STRENGTHS:
        for curve in ("tanh", "clamped"):
            rows += _agreement(strength, curve, output)
    curves = [_curves_apart(bar, output) for bar in BARS]
    output.report(
        f"""## Section 6.3: uniqueness

**Paper:** the mean of ‖M_K − M_O‖/‖M_K‖ over the balls is {PAPERS_DEVIATION:g} under the weak bar, with M_K by Kim et
al. 2018 and M_O by the paper's method.

**Here:** κ of pairs is {STEP:g} in both tables. These two methods have different curves. So the first table compares
all dynamics on the same curve, in float64, to a residual e_M ≤ {RTOL:g} or for {MOST["llg"]:,} iterations. "From
Newton" is ‖M − M_N‖/‖M_N‖, with M_N by Newton's iteration in float64 that shares no code with the kernels. "From
`theta`" is relative to the solution of `theta`. All dynamics that converge agree.

{table(["bar", "curve", "dynamics", "iterations", "residual", "from Newton", "from `theta`"], rows)}

The second table repeats the paper's comparison: M_K by `llg` on the clamped curve, M_O by `theta` on tanh, both to
e_M ≤ 1e-6. The difference is proportional to the square of the bar's magnetization. So is the difference of the curves,
(s − tanh s)/s ≈ s²/3 with s = k‖H‖/Ms. The paper does not state the
magnetization of its bar; a difference of {PAPERS_DEVIATION:g} belongs to about 2e5 A/m:

{table(["bar [A/m]", "mean ‖M_K − M_O‖/‖M_K‖"], curves)}"""
    )


def _solve(dynamics: str, strength: float, curve: str, device: str, rtol=RTOL):
    settings = {"curve": curve, "rtol": rtol, "max_evaluations": MOST[dynamics], "dtype": "float64"}
    system = crystal_balls.make_system(strength, dynamics, device, **settings)
    system.solve()
    return system, system.magnetizations().numpy()[: len(crystal_balls.layout().balls)]


def _agreement(strength: str, curve: str, output: Output) -> list[list]:
    """Compare all dynamics on one curve under one bar."""
    bar, balls = crystal_balls.STRENGTHS[strength], (crystal_balls.layout().balls, crystal_balls.BALL_RADIUS)
    material = {"saturation": SATURATION_OF_IRON, "curve": curve}
    newton = oracle.equilibrium(*balls, crystal_balls.applied_field(bar), **material).magnetizations
    rows, theta = [], None
    for dynamics in DYNAMICS:
        system, m = _solve(dynamics, bar, curve, output.device)
        theta = m if dynamics == "theta" else theta
        converged = bool(system.converged.numpy()[0])
        values = {
            "iterations": int(system.evaluations.numpy()[0]),
            "residual": float(system.residual.numpy()[0]),
            "from_newton": oracle.relative(m, newton),
            "from_theta": oracle.relative(m, theta),
        }
        output.record(strength=strength, curve=curve, dynamics=dynamics, converged=converged, **values)
        count = values.pop("iterations") if converged else f"not in {values.pop('iterations')}"
        rows.append([strength, curve, f"`{dynamics}`", count, *(f"{value:.1e}" for value in values.values())])
    return rows


def _curves_apart(bar: float, output: Output) -> list[str]:
    """Return the row of the paper's own comparison, which mixes curves."""
    _, kim = _solve("llg", bar, "clamped", output.device, rtol=1e-6)
    _, theta = _solve("theta", bar, "tanh", output.device, rtol=1e-6)
    deviation = float(np.mean(np.linalg.norm(kim - theta, axis=1) / np.linalg.norm(kim, axis=1)))
    output.record(bar=bar, mean_deviation=deviation)
    return [f"{bar:g}", f"{deviation:.1e}"]
