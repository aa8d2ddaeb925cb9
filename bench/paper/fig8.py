"""Fig. 8: magnetization error e_M of the crystal balls over iterations, three methods, two strengths of the bar."""

import matplotlib.pyplot as plt
import numpy as np

from bench.arrangements import trace
from bench.paper import crystal_balls
from bench.paper.output import Output, table
from warpmag.moments.dynamics import STEP

TOLERANCE = 1e-3
ITERATIONS = 300
PANELS = (
    ("(a) Kim et al. 2018", (("llg", "clamped"),)),
    ("(b) the paper, and warpmag", (("theta-euler", "tanh"), ("theta", "tanh"))),
    ("(c) damping-only LLG", (("llg-damping", "clamped"),)),
)
COLORS = {"weak": "tab:green", "strong": "tab:red"}
STEPS = (0.01, 0.03, 0.1, STEP, 1.0, 2.0)
BARS = (1e6, 1e7, 4e7, 1e8)
"""Second choices: steps κ, and magnetizations of the bar [A/m]."""
MOST_ITERATIONS = 5000  # largest number of iterations of a second choice


def run(output: Output):
    """Run the experiment."""
    figure, axes = plt.subplots(1, len(PANELS), figsize=(15.0, 4.4), sharey=True)
    histories = {}
    for axis, (title, methods) in zip(axes, PANELS, strict=True):
        for dynamics, curve in methods:
            for name in crystal_balls.STRENGTHS:
                errors = _errors(dynamics, curve, name, output)
                histories[dynamics, name] = errors
                style = {"color": COLORS[name], "ls": "-" if dynamics != "theta-euler" else "--"}
                marker = "o" if dynamics == "theta" else None
                label = f"{dynamics}, {name} bar"
                axis.semilogy(1 + np.arange(len(errors)), errors, label=label, marker=marker, ms=3, **style)
        axis.axhline(TOLERANCE, color="0.6", lw=0.8)
        axis.set(title=title, xlabel="iterations (field evaluations)", xlim=(0, ITERATIONS))
        axis.legend(fontsize=8)
    axes[0].set_ylabel("$e_M$ (Eq. 12)")
    figure.tight_layout()
    second = "" if output.small else _second_choices(output)
    output.report(_text(output.save(figure), histories, second))
    plt.close(figure)


def _trace(dynamics, curve, bar, device, iterations, *, step=STEP, **settings) -> np.ndarray:
    """Return the error after each iteration."""
    explicit = {"step": step} if dynamics != "theta" else {}
    settings |= {"curve": curve, "rtol": TOLERANCE, "max_evaluations": iterations}
    return trace(crystal_balls.make_system(bar, dynamics, device, **explicit, **settings), to_residual=True)


def _errors(dynamics, curve, strength, output):
    """Return and record the error after each iteration."""
    errors = _trace(dynamics, curve, crystal_balls.STRENGTHS[strength], output.device, ITERATIONS)
    result = {"converged": bool(errors[-1] <= TOLERANCE), "iterations": len(errors)}
    rounded = [float(f"{e:.4g}") for e in errors]
    output.record(strength=strength, dynamics=dynamics, curve=curve, **result, errors=rounded)
    return errors


def _outcome(iterations, error) -> str:
    return f"{iterations:,}" if error <= TOLERANCE else f"– ({error:.0e})"


def _second_choices(output: Output) -> str:
    """Return the section on choices other than the figure's: steps, strengths, arrangements and starts."""
    methods = [method for _, panel in PANELS for method in panel]
    explicit = [method for method in methods if method[0] != "theta"]

    def outcome(dynamics, curve, choice):
        errors = _trace(dynamics, curve, device=output.device, iterations=MOST_ITERATIONS, **choice)
        iterations, error = len(errors), float(errors[-1])
        output.record(dynamics=dynamics, curve=curve, **choice, iterations=iterations, error=error)
        return _outcome(iterations, error)

    def rows_of(methods, name, values):
        """Return a row of outcomes over the ``values`` of a setting for each method and strength."""
        return [
            [f"`{d}`", label, *(outcome(d, c, {"bar": bar, name: value}) for value in values)]
            for d, c in methods
            for label, bar in crystal_balls.STRENGTHS.items()
        ]

    def rows_of_bars(**choice):
        return [[f"`{d}`", *(outcome(d, c, {"bar": bar, **choice}) for bar in BARS)] for d, c in methods]

    steps, starts = rows_of(explicit, "step", STEPS), rows_of(explicit, "start", crystal_balls.PAIRS)
    bars, layouts = rows_of_bars(), rows_of_bars(cells=crystal_balls.OTHER_CELLS)
    grid, (columns, rows, length, width) = crystal_balls.CELLS, crystal_balls.OTHER_CELLS
    return f"""**Does the result depend on the constants that the paper leaves open?** The tables below list the
iterations to e_M ≤ {TOLERANCE:g}. A dash means not converged; e_M after {MOST_ITERATIONS:,} iterations follows.

Other steps:

{table(["dynamics", "bar", *(f"κ = {step:g}" for step in STEPS)], steps)}

Other magnetizations of the bar, κ = {STEP:g}:

{table(["dynamics", *(f"{bar:g} A/m" for bar in BARS)], bars)}

A grid of {columns} × {rows} cells with a bar of {length} × {width} cells, κ = {STEP:g}. In the other tables the grid
has {grid[0]} × {grid[1]} cells and the bar {grid[2]} × {grid[3]}:

{table(["dynamics", *(f"{bar:g} A/m" for bar in BARS)], layouts)}

Other initial directions of M1 = −M2, κ = {STEP:g}: perpendicular to the plane of the balls ("across"), in this plane
and perpendicular to the bar, and random. Under the weak bar pairs whose axis is parallel to the field are slow. A
submagnetization moves only perpendicular to itself, so M along this axis changes only in second order of the rotation.
`theta` has no pairs and is not in the table.

{table(["dynamics", "bar", *crystal_balls.PAIRS], starts)}"""


def _text(image, histories, second) -> str:
    rows = [[f"`{dynamics}`", bar, _outcome(len(errors), errors[-1])] for (dynamics, bar), errors in histories.items()]
    return f"""## Fig. 8: magnetization error over iterations

**Paper:** (a) Kim et al. 2018 do not converge under the strong bar, and converge slowly under the weak one. (b) The
paper's dynamics "converges fast regardless of the magnetic field strengths". (c) Damping-only LLG does not converge
under the strong bar, and converges "a little faster" than (a) under the weak one.

**Here:** κ is {STEP:g} for all dynamics of pairs and both bars. Pairs start demagnetized, M1 = −M2, perpendicular to
the plane of the balls. `theta` has an automatic step.

{image}

{table(["dynamics", "bar", f"iterations to e_M ≤ {TOLERANCE:g}, or (e_M after {ITERATIONS})"], rows)}

{second}"""
