"""Fig. 7: submagnetizations M1 and M2 of the crystal balls, before and after induction, three methods."""

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.patches import Circle, Rectangle

from bench.arrangements import trace
from bench.paper import crystal_balls
from bench.paper.output import Output, table
from warpmag.declarations.magnets import SATURATION_OF_IRON
from warpmag.moments.dynamics import STEP

METHODS = {"llg": ("clamped", "Kim et al. 2018"), "theta-euler": ("tanh", "the paper"), "theta": ("tanh", "warpmag")}
"""Curve and author of each dynamics."""
ITERATIONS = 100
_TILT = np.array([[1.0, 0.0, 0.45], [0.0, 1.0, 0.3]])
"""Oblique projection onto the page, which shows directions normal to the plane of the balls."""


def run(output: Output):
    """Run the experiment."""
    columns = len(METHODS) + 1
    figure, axes = plt.subplots(len(crystal_balls.STRENGTHS), columns, figsize=(5.0 * columns, 8.6), squeeze=False)
    rows = []
    for row, (name, strength) in zip(axes, crystal_balls.STRENGTHS.items(), strict=True):
        for axis, (dynamics, (curve, author)) in zip(row[1:], METHODS.items(), strict=True):
            pairs, error, evaluations = _settle(dynamics, curve, strength, output.device)
            _draw(axis, pairs, f"{author} ({dynamics}), {name} bar\n$e_M$ = {error:.1e} after {evaluations} iterations")
            output.record(strength=name, dynamics=dynamics, curve=curve, error=error, iterations=evaluations)
            rows.append([name, author, f"`{dynamics}`", evaluations, f"{error:.1e}"])
        start = crystal_balls.directions(crystal_balls.make_system(0.0, "llg", output.device))
        _draw(row[0], start, f"before, {name} bar")
    figure.tight_layout()
    output.report(
        f"""## Fig. 7: crystal balls

**Paper:** under the strong bar the method of Kim et al. 2018 gives "oscillating and divergent submagnetizations" (the
paper's panel b). The paper's dynamics "quickly converges" (panel c).

**Here:** the figure shows 178 balls around a bar magnet, before induction (left) and after it. Induction ends at e_M ≤
1e-3 or after {ITERATIONS} iterations; κ of pairs is {STEP:g} for both bars. M1 is red and M2 is blue. A ball is
saturated where they coincide.

{output.save(figure)}

{table(["bar", "method", "dynamics", "iterations", "e_M"], rows)}"""
    )
    plt.close(figure)


def _settle(dynamics: str, curve: str, strength: float, device: str):
    """Return the pair of each ball after induction, the error and the iterations."""
    system = crystal_balls.make_system(strength, dynamics, device, curve=curve, max_evaluations=ITERATIONS)
    errors = trace(system, to_residual=True)
    if dynamics == "theta":
        pairs = _symmetric_pair(system.magnetizations().numpy() / SATURATION_OF_IRON)
    else:
        pairs = crystal_balls.directions(system)
    return pairs, float(errors[-1]), len(errors)


def _symmetric_pair(reduced: np.ndarray):
    """Return the pair of a state of the θ flow: ‖M‖ = Ms cos θ, M1 and M2 in the plane of M and the page's normal."""
    cosine = np.minimum(np.linalg.norm(reduced, axis=1), 1.0)[:, None]
    half = np.sqrt(1.0 - cosine**2) * np.array([0.0, 0.0, 1.0])
    return reduced + half, reduced - half


def _draw(axis, pairs, title: str):
    layout = crystal_balls.layout()
    centers, radius = 1e3 * layout.balls @ _TILT.T, 1e3 * crystal_balls.BALL_RADIUS  # mm
    a, b, _ = 1e3 * np.array(layout.bar_half_extents)
    for left, pole, color in ((-a, "S", "0.35"), (0.0, "N", "0.6")):
        axis.add_patch(Rectangle((left, -b), a, 2 * b, color=color))
        axis.text(left + 0.5 * a, 0.0, pole, ha="center", va="center", color="w", fontsize=16)
    for center in centers:
        axis.add_patch(Circle(center, radius, fc="#dbe9f4", ec="0.7", lw=0.5))
    for directions, color in zip(pairs, ("#d62728", "#1f4fd8"), strict=True):
        arrow = 1.1 * radius * directions[: len(centers)] @ _TILT.T
        axis.quiver(*centers.T, *arrow.T, color=color, angles="xy", scale_units="xy", scale=1.0, width=0.0028)
    axis.set_title(title, fontsize=10)
    axis.set_aspect("equal")
    axis.set_axis_off()
    axis.autoscale_view()
