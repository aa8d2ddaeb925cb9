"""Section 6.3: all methods that converge agree in the magnetization."""

import numpy as np

from bench.paper import crystal_balls
from bench.paper.output import Output, table
from bench.reference import oracle
from warpmag.declarations.magnets import DYNAMICS, SATURATION_OF_IRON

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

**Paper:** the mean of ‖M_K − M_O‖/‖M_K‖ between Kim et al. 2018 and the paper's method is {PAPERS_DEVIATION:g} under
the weak bar. The two methods have different curves, so part of the difference is due to the curves.

**Here:** both methods on the same curve, in float64, to a residual of {RTOL:g}. "From Newton" is ‖M − M_N‖/‖M_N‖ for a
float64 Newton solution that shares no code with the kernels, "from `theta`" the same for the library's method. At most
{MOST["llg"]} iterations.

{table(["bar", "curve", "dynamics", "iterations", "residual", "from Newton", "from `theta`"], rows)}

The paper's comparison, `llg` on the clamped curve against `theta` on tanh, mean over the balls. It falls with the
square of the bar's strength, as (s − tanh s)/s does, so it is due to the curves alone:

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
