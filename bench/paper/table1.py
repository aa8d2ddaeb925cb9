"""Table 1: times per step of induction Ti, magnetic forces Tf and rigid bodies Tr.

The paper measures 1,000 "frames" of one 1 ms step each. A step here may have several substeps, each with its own
induction and forces; times are those of the whole step. Slow pairs cost seconds a step, so every case has the same wall
time, and its row states the number of steps.
"""

import itertools

from bench.paper.output import Output, table
from bench.paper.trials import SCENES, Trial, outcome_cells, run_trials
from warpmag.declarations.magnets import PRESETS
from warpmag.moments.dynamics import STEP

SECONDS, SMALL_SECONDS = 1.0, 0.05
RTOL = 1e-2
"""Magnetization error at which induction ends: below it ``theta-euler`` converges slowly in a pile of balls."""
TIME_LIMIT = {"cpu": 55.0, "gpu": 4.0}
"""Wall time after which a run is ended [s]: the twelve runs take 15 minutes on two cores, two minutes on a GPU."""
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
    """Run the experiment on the bundled scenes."""
    seconds = SMALL_SECONDS if output.small else SECONDS
    kind = "cpu" if output.device == "cpu" else "gpu"
    cases = itertools.product(SCENES, PRESETS)
    trials = [Trial(scene, method, seconds, output.device, TIME_LIMIT[kind], rtol=RTOL) for scene, method in cases]
    rows = []
    for trial, values in run_trials(trials):
        output.record(**values)
        row = {"scene": trial.scene, "method": trial.method, "steps": values["steps"]}
        row |= {f"T{part} [ms]": f"{values[f't{part}_ms']:.3g}" for part in "ifr"}
        papers = PAPERS_TIMES.get((trial.scene, trial.method), ())
        row["paper's Ti / Tf / Tr [ms]"] = " / ".join(f"{number:.3g}" for number in papers)
        rows.append(row | outcome_cells(values))
    output.report(_text(table(list(rows[0]), [list(row.values()) for row in rows]), kind), part=kind)


def _text(results: str, kind: str) -> str:
    cores = " Each run has two cores." if kind == "cpu" else ""
    return f"""## Table 1 on a {kind.upper()}: time per step

**Paper:** milliseconds per 1 ms step on an Intel i7-8700, 1,000 steps; its rigid bodies are Bullet's.

**Here:** Newton's XPBD solves the rigid bodies. The methods differ only in dynamics, curve and force law (table at the
top); κ of pairs is {STEP:g}.{cores} Ti, Tf and Tr are mean times of induction, magnetic forces and rigid bodies per
step of 1 ms, with all its substeps. A case ends after {round(1000 * SECONDS):,} steps or {TIME_LIMIT[kind]:g} s of wall
time; the last columns describe the scene at that time. Where "steps" is below {round(1000 * SECONDS):,}, the means
cover the start of the scene only, and are not comparable with other rows.

Induction ends at e_M ≤ {RTOL:g} or after 1,000 evaluations. The paper does not state the error at which a magnetization
is converged. "Until every M converges" may mean until M hardly changes. Slow pairs meet this criterion while their
error is still large. In weak fields, before a magnet comes near, pairs do not reach e_M ≤ {RTOL:g} in 1,000
evaluations.

{results}"""
