"""Errors of results and their cost: ``python -m bench.accuracy [ERROR ...] [--device cuda:0] [-o DIR]``.

Each error has its own reference:

| error | quantity | reference |
|---|---|---|
| rounding | fields and forces in float32 and float64 | the float64 oracle |
| iteration | magnetizations at a tolerance | a float64 Newton solution |
| model | forces of two permeable balls as dipoles, or with the near-contact model | exact multipole solution |
| clusters | forces and moments of three balls in a row and of thirteen balls | ``bench.reference.clusters`` |
| time step | energy of two balls that fall towards each other | conservation |
| boxes | forces of two box magnets | ``bench.reference.magnet_pairs`` |
| price | time of the near-contact model in a touching pile | time with dipoles alone |
| arrangements | magnetizations of many arrangements, and the estimate of the solve | a float64 Newton solution |

Prints a table of each error, or of the named ones, and writes ``accuracy.jsonl``, and ``accuracy.png`` for all errors.
"""

import argparse
import functools
import json
from collections.abc import Iterator
from pathlib import Path

import newton
import numpy as np
import warp as wp

import warpmag
from bench.arrangements import ARRANGEMENTS, arranged, trace
from bench.cases import RADIUS, SATURATION, touching_pile
from bench.machine import describe
from bench.reference import clusters, magnet_pairs, oracle, spheres
from bench.reference.fall import DURATION, fall
from bench.reference.oracle import relative
from bench.run import RUNNERS, make_system
from bench.systems import moment_system, solve_cold
from bench.timing import measure
from warpmag.declarations.magnets import CONTACT_MODELS
from warpmag.moments.system import MomentSystem

SIZES = (243, 1032, 2560, 10000)
TOLERANCES = (1e-1, 1e-2, 1e-3, 1e-4, 1e-5)
BLOCK = 1000
"""Number of balls of the pile for the iteration error: the most that the dense Newton solution can handle."""
PERMEABILITIES = (2.0, 4.0, 10.0, 1000.0, np.inf)
GAPS = (0.01, 0.03, 0.1, 0.3, 0.5, 0.9, 1.2, 3.0)
"""Gaps between two balls over their radius."""
SIDE, BOX_GAPS, MAGNETIZATION = 0.02, (0.0, 0.01, 0.05, 0.2, 0.5, 1.0, 2.0), 1e6
"""Longest edge of box magnets [m], gaps between two of them over it, and their magnetization along z [A/m]."""
PILES = (2500, 10000)  # balls of the piles on which the near-contact model is timed
STEPS = (4e-4, 2e-4, 1e-4, 5e-5)  # time steps [s]


def rounding(device) -> Iterator[dict]:
    """Fields and forces of a touching pile: relative error and time of an evaluation."""
    for quantity in ("field", "force"):
        for dtype in ("float32", "float64"):
            for count in SIZES:
                system = make_system(count, dtype, device)
                system.solve()
                system.apply_forces()
                result = RUNNERS[quantity](system, device)
                milliseconds = 1e3 * result["seconds"]
                yield {"of": quantity, "dtype": dtype, "balls": count, "ms": milliseconds, "error": result["error"]}


def iteration(device) -> Iterator[dict]:
    """Magnetizations of a pile in a field of half its saturation: error, evaluations and time of a cold solve."""
    x = touching_pile(BLOCK).astype(float)
    field = [0.0, 0.0, 0.5 * SATURATION]
    exact = oracle.equilibrium(x, float(np.float32(RADIUS)), field, saturation=SATURATION).magnetizations
    for dtype in ("float32", "float64"):
        for rtol in TOLERANCES:
            system = moment_system(
                radii=np.full(BLOCK, RADIUS), saturation=SATURATION, external_field=field, rtol=rtol, dtype=dtype,
                device=device,
            )  # fmt: skip
            system.positions.assign(x)
            milliseconds = 1e3 * measure(functools.partial(solve_cold, system), device)
            error = relative(system.magnetizations().numpy(), exact)
            evaluations = int(system.evaluations.numpy()[0])
            yield {"dtype": dtype, "rtol": rtol, "evaluations": evaluations, "ms": milliseconds, "error": error}


def arrangements(device) -> Iterator[dict]:
    """Cold solves of ``bench.arrangements``: their error and its estimate, both over rtol.

    "to residual" is the number of evaluations after which the residual alone would have ended the solve.
    """
    for name, make in ARRANGEMENTS.items():
        balls = make()
        exact = oracle.equilibrium(balls.positions, balls.radii, balls.applied, **balls.material).magnetizations
        for rtol in TOLERANCES[1:]:
            system = arranged(balls, rtol=rtol, device=device)
            residuals = trace(system)
            enough = 1 + int(np.argmax(residuals <= rtol))
            row = {"arrangement": name, "balls": len(exact), "rtol": rtol, "evaluations": len(residuals)}
            error, estimate = relative(system.magnetizations().numpy(), exact), float(system.error.numpy()[0])
            yield {**row, "to residual": enough, "error": error / rtol, "estimate": estimate / rtol}


def model(device) -> Iterator[dict]:
    """Forces of two permeable balls, in line with a weak field and across it, over the exact ones."""
    field = 1e3  # A/m, so weak that nothing saturates
    for m, (name, direction) in enumerate((("in line", (0.0, 0.0, 1.0)), ("across", (1.0, 0.0, 0.0)))):
        for permeability in PERMEABILITIES:
            for gap in GAPS:
                x = RADIUS * np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 2.0 + gap]])
                h0 = field * np.array(direction)
                exact = _exact_pair_force(RADIUS * (2.0 + gap), permeability, m, field)
                systems = {kind: _solve(x, h0, permeability, kind, device) for kind in CONTACT_MODELS}
                ratios = {kind: float(system.forces.numpy()[1, 2]) / exact for kind, system in systems.items()}
                yield {"field": name, "permeability": permeability, "gap": gap, **ratios}


def _exact_pair_force(distance, permeability, m, field) -> float:
    """Force [N] on the second ball along the axis; the field is along the axis (``m`` = 0) or across it (1)."""
    pair = spheres.pair(distance, (RADIUS, RADIUS), (permeability, permeability))
    moments = np.linalg.solve(pair.resistance[m], [field, field])
    return float(-0.5 * oracle.MU0 * moments @ pair.slope[m] @ moments)


def _solve(positions, field, permeability, contact_model, device) -> MomentSystem:
    """Solved system of balls of ``RADIUS``, with forces."""
    system = moment_system(
        radii=np.full(len(positions), RADIUS), saturation=SATURATION, susceptibility=permeability - 1.0,
        external_field=field, rtol=1e-10, dtype="float64", contact_model=contact_model, device=device,
    )  # fmt: skip
    system.positions.assign(positions)
    system.solve()
    system.apply_forces()
    return system


def cluster_errors(device) -> Iterator[dict]:
    """Relative L2 errors of moments and forces of clusters in a weak field; forces with either model."""
    field = 1e3
    for row in clusters.load():
        exact = field**2 * RADIUS**2 * np.array(row["forces"])
        line = {name: row[name] for name in ("cluster", "gap", "permeability", "field")}
        x = RADIUS * clusters.positions(row["cluster"], row["gap"])
        h0 = field * np.array(clusters.FIELDS[row["cluster"]][row["field"]])
        for kind in CONTACT_MODELS:
            system = _solve(x, h0, row["permeability"], kind, device)
            line[kind] = relative(system.forces.numpy(), exact)
        exact = field * RADIUS**3 * np.array(row["moments"])
        yield {**line, "moments": relative(system.moments.numpy(), exact)}


def time_step(device) -> Iterator[dict]:
    """Energy and momentum of two balls that fall towards each other."""
    for dt in STEPS:
        result = fall(2, dt, device)
        yield {"dt": dt, "steps": round(DURATION / dt), "error": result.drift, "momentum": result.momentum}


def boxes(device, names=tuple(magnet_pairs.PAIRS)) -> Iterator[dict]:
    """Forces of two box magnets: relative error, and the number of moments of both."""
    for name in names:
        for gap in BOX_GAPS:
            half1, half2, offset = magnet_pairs.box_pair(name, gap, SIDE)
            exact = magnet_pairs.box_force(half1, half2, offset, MAGNETIZATION, MAGNETIZATION)
            force, moments = _box_force(half1, half2, offset, device)
            yield {"boxes": name, "gap": gap, "moments": moments, "error": relative(force, exact)}


def _box_force(half1, half2, offset, device) -> tuple[np.ndarray, int]:
    """Force [N] on the second of two boxes magnetized along z, and the number of moments of both."""
    builder = newton.ModelBuilder()
    warpmag.register_attributes(builder)
    for half, center in ((half1, np.zeros(3)), (half2, offset)):
        body = builder.add_body(xform=wp.transform(wp.vec3(*center), wp.quat_identity()))
        builder.add_shape_box(body, hx=half[0], hy=half[1], hz=half[2])
        warpmag.add_permanent(builder, body=body, magnetization=(0.0, 0.0, MAGNETIZATION))
    model = builder.finalize(device=device)
    magnetics, state = warpmag.Magnetics(model), model.state()
    state.clear_forces()
    magnetics.apply(state)
    return state.body_f.numpy()[1, :3], magnetics.system.count


def price(device) -> Iterator[dict]:
    """Median times [ms] of the parts of a step of a touching pile with either model, in turns, and their ratio."""
    for count in PILES:
        systems = [make_system(count, "float32", device, kind) for kind in CONTACT_MODELS]
        for system in systems:
            system.solve()
            system.apply_forces()
        for part in ("evaluate", "apply_forces", "begin", "solve"):
            works = [getattr(system, part) for system in systems]
            laps = np.array([[measure(work, device, seconds=0.0, repeats=1) for work in works] for _ in range(40)])
            dipole, multipole = 1e3 * np.median(laps, axis=0)
            ratio = np.median(laps[:, 1] / laps[:, 0])
            yield {"balls": count, "part": part, "dipole": dipole, "multipole": multipole, "ratio": ratio}
        for start in ("cold", "warm"):
            evaluations = []
            for system in systems:
                if start == "cold":
                    system.start_cold()
                system.solve()
                evaluations.append(int(system.evaluations.numpy()[0]))
            names = dict(zip(CONTACT_MODELS, evaluations, strict=True))
            ratio = evaluations[1] / evaluations[0]
            yield {"balls": count, "part": f"evaluations, {start}", **names, "ratio": ratio}


ERRORS = {
    "rounding": rounding, "iteration": iteration, "model": model, "clusters": cluster_errors, "time step": time_step,
    "boxes": boxes, "price": price, "arrangements": arrangements,
}  # fmt: skip


def print_table(rows: list[dict]) -> None:
    """Print rows with equal keys as a table."""
    lines = [list(rows[0])]
    lines += [[f"{value:.3g}" if isinstance(value, float) else str(value) for value in row.values()] for row in rows]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    for line in lines:
        print("  ".join(cell.rjust(width) for cell, width in zip(line, widths, strict=True)))


def _line(axis, rows, x, y, label) -> None:
    axis.loglog([row[x] for row in rows], [row[y] for row in rows], "o-", label=label, markersize=4)


def _draw_rounding(axis, rows) -> None:
    for of, dtype in sorted({(row["of"], row["dtype"]) for row in rows}):
        part = [row for row in rows if (row["of"], row["dtype"]) == (of, dtype)]
        _line(axis, part, "ms", "error", f"{of}, {dtype}, {part[0]['balls']} to {part[-1]['balls']} balls")
    axis.set(xlabel="time of an evaluation [ms]", ylabel="relative error")


def _draw_iteration(axis, rows) -> None:
    for dtype in ("float32", "float64"):
        _line(axis, [row for row in rows if row["dtype"] == dtype], "ms", "error", f"{dtype}, rtol 0.1 to 1e-5")
    axis.set(xlabel=f"time of a cold solve, {BLOCK} balls [ms]", ylabel="relative error")


def _draw_model(axis, rows) -> None:
    for kind in CONTACT_MODELS:
        for field, style in (("in line", "-"), ("across", "--")):
            part = [row for row in rows if row["field"] == field and row["permeability"] == np.inf]
            axis.semilogx([row["gap"] for row in part], [row[kind] for row in part], style, label=f"{kind}, {field}")
    axis.set(xlabel="gap over radius, μr = ∞", ylabel="force over the exact one")


def _draw_clusters(axis, rows) -> None:
    for kind, style in zip(CONTACT_MODELS, ("--", "-"), strict=True):
        for cluster in clusters.FIELDS:
            part = [row for row in rows if row["cluster"] == cluster]
            worst = [max(row[kind] for row in part if row["gap"] == gap) for gap in clusters.GAPS]
            axis.loglog(clusters.GAPS, worst, style, label=f"{kind}, {cluster}, the worst of μr and fields")
    axis.set(xlabel="gap over radius", ylabel="relative error of forces")


def _draw_drift(axis, rows) -> None:
    _line(axis, rows, "steps", "error", "energy drift over kinetic energy")
    axis.set(xlabel="steps", ylabel="relative error")


def draw(results: dict[str, list[dict]], path: Path) -> None:
    """Draw error against cost, one panel for each of the first five ``ERRORS``."""
    import matplotlib.pyplot as plt  # noqa: PLC0415 - slow to import, and not needed by --help

    panels = (_draw_rounding, _draw_iteration, _draw_model, _draw_clusters, _draw_drift)
    figure, axes = plt.subplots(2, 3, figsize=(14.0, 8.0), layout="constrained")
    for axis, panel, (name, rows) in zip(axes.flat, panels, results.items(), strict=False):
        axis.set_title(f"{name} error")
        axis.grid(alpha=0.3)
        panel(axis, rows)
        _label_part_of_a_decade(axis.xaxis)
        axis.legend(fontsize=7)
    for axis in axes.flat[len(panels) :]:
        axis.set_axis_off()
    figure.savefig(path, dpi=110)


def _label_part_of_a_decade(axis) -> None:
    """Label 1, 2 and 5 of each decade on a logarithmic axis of few decades, where the default labels overlap."""
    from matplotlib import ticker  # noqa: PLC0415 - as above

    low, high = axis.get_view_interval()
    axis.set_minor_formatter(ticker.NullFormatter())
    if high < 30.0 * low:
        axis.set_major_locator(ticker.LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.set_major_formatter("{x:g}")


def main() -> None:
    """Measure the errors named on the command line."""
    parser = argparse.ArgumentParser(prog="python -m bench.accuracy", description=__doc__.partition("\n")[0])
    parser.add_argument("errors", nargs="*", metavar="ERROR", help=f"of {', '.join(ERRORS)}; all if none is named")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("-o", "--output", type=Path, default=Path("bench_out"), metavar="DIR")
    options = parser.parse_args()
    if unknown := set(options.errors) - set(ERRORS):
        parser.error(f"no such error: {', '.join(unknown)}")
    wp.config.log_level = wp.LOG_WARNING
    device = wp.get_device(options.device)
    options.output.mkdir(parents=True, exist_ok=True)
    machine, results = describe(device), {}
    with open(options.output / "accuracy.jsonl", "w", encoding="utf-8") as file:
        for name in options.errors or ERRORS:
            results[name] = list(ERRORS[name](device))
            print(f"\n{name}")
            print_table(results[name])
            file.writelines(json.dumps({"error_of": name, **row, **machine}) + "\n" for row in results[name])
    if results.keys() == ERRORS.keys():
        draw(results, options.output / "accuracy.png")


if __name__ == "__main__":
    main()
