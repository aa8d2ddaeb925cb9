"""Table 1: times per step of induction Ti, magnetic forces Tf and rigid bodies Tr, and what becomes of each scene.

The paper measures "frames" of one 1 ms step each, over 1,000 of them. A step here may hold several substeps, each with
its own induction and forces; the times are those of the whole step.
"""

import time

import warpmag
from bench.paper.output import Output, table
from warpmag.errors import SimulationError
from warpmag.magnets import METHODS
from warpmag.scenes_usd import bundled

SCENES = ("balls_up", "alphabets", "falling_magnet", "sakura_tree")
STEPS, SMALL_STEPS = 1000, 20
RTOL = 1e-2
"""Magnetization error at which induction ends: below it the pairs of ``theta-euler`` crawl in a pile of balls."""
PATIENCE = 300.0
"""Time after which a run is ended [s]."""
PAPERS_TIMES = {
    ("balls_up", "kim2018"): (20, 3.5, 14),
    ("balls_up", "paper"): (1.8, 3.8, 14),
    ("alphabets", "kim2018"): (3.3, 1.3, 15),
    ("alphabets", "paper"): (1.3, 1.4, 110),
    ("falling_magnet", "kim2018"): (251, 58, 59),
    ("falling_magnet", "paper"): (36, 61, 60),
    ("sakura_tree", "kim2018"): (778, 97, 65),
    ("sakura_tree", "paper"): (61, 101, 75),
}
"""Ti, Tf, Tr [ms], Intel i7-8700."""


def run(output: Output):
    """Run the experiment on the scenes that are bundled."""
    stages = bundled()
    rows = []
    for scene in SCENES:
        for name in METHODS if scene in stages else ():
            values = _measure(stages[scene], name, SMALL_STEPS if output.small else STEPS, output.device)
            output.record(scene=scene, method=name, **values)
            rows.append(_row(scene, name, values))
    missing = [scene for scene in SCENES if scene not in stages]
    output.report(_text(rows, missing))


def _measure(stage, name: str, steps: int, device: str) -> dict:
    """Simulate ``steps`` steps of a scene, or as many as it lives through."""
    method = METHODS[name]
    simulation = warpmag.Simulation(
        stage, dynamics=method.dynamics, curve=method.curve, force=method.force, rtol=RTOL, device=device
    )
    ended, began = "", time.perf_counter()
    try:
        for _ in range(steps):
            simulation.step()
            if time.perf_counter() - began > PATIENCE:
                break
    except SimulationError as error:
        ended = str(error)
    figures = simulation.finish()
    induction, force, rigid = figures.milliseconds
    done = max(figures.steps, 1)
    return {
        "steps": figures.steps,
        "ended": ended,
        "substeps": figures.substeps / done,
        "ti_ms": induction,
        "tf_ms": force,
        "tr_ms": rigid,
        "evaluations_per_substep": sum(figures.evaluations) / max(figures.substeps, 1),
        "unconverged": figures.unconverged / max(figures.substeps, 1),
        "held": figures.held,
        "held_rms_speed": figures.held_rms_speed,
        "rms_speed": figures.rms_speed,
        "peak_speed": figures.peak_speed,
        "overlap": figures.overlap,
    }


def _row(scene: str, name: str, values: dict) -> list:
    def times(numbers):
        return [f"{number:.3g}" for number in numbers]

    papers = PAPERS_TIMES.get((scene, name))
    return [
        scene,
        name,
        *times(values[key] for key in ("ti_ms", "tf_ms", "tr_ms")),
        " / ".join(times(papers)) if papers else "",
        f"{values['substeps']:.1f}",
        f"{values['evaluations_per_substep']:.1f}",
        f"{100.0 * values['unconverged']:.0f} %",
        values["held"],
        f"{100.0 * values['held_rms_speed']:.2f}",
        f"{100.0 * values['rms_speed']:.2f}",
        f"{values['peak_speed']:.2f}",
        f"{100.0 * values['overlap']:.1f} %",
        values["ended"] or f"{values['steps']} steps",
    ]


def _text(rows, missing) -> str:
    head = ["scene", "method", "Ti [ms]", "Tf [ms]", "Tr [ms]", "paper's Ti / Tf / Tr", "substeps per step"]
    head += ["field evaluations per substep", "substeps not converged", "held"]
    head += ["RMS speed of these [cm/s]", "of all [cm/s]", "peak [m/s]", "penetration", "end"]
    note = f"\n\nNot bundled, so not run: {', '.join(missing)}." if missing else ""
    return f"""## Table 1: time per step

**Paper:** milliseconds per 1 ms step on an Intel i7-8700, 1,000 steps; its rigid bodies are Bullet's.

**Here:** rigid bodies are Newton's XPBD, and all three methods share every line of code but the dynamics, the curve and
the force law. Induction ends at an error of {RTOL:g} or after 1,000 evaluations.
The paper does not say at which error it calls a magnetization converged; "until every M converges" may well mean that
it stopped moving, which a pair that crawls does long before it is right. In weak fields, before a magnet has come near,
pairs do not reach the relative error at all.

{table(head, rows)}{note}"""
