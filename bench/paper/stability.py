"""Stability: the dynamic scenes for 5 s by this library's method, and by it with the paper's force law.

The paper shows pictures and says "excessively strong"; it gives neither strengths nor speeds. What is measured here is
what would be lost, ejected or shaken: speeds at the end, the highest speed, the farthest body, the deepest penetration.
Table 1 has the same figures of the paper's and of kim2018's method, whose pairs take too long for 5 s.
"""

from bench.paper.output import Output, table
from bench.paper.trials import SCENES, Trial, outcome_cells, outcome_head, run_trials

SECONDS, SMALL_SECONDS = 5.0, 0.1
PATIENCE = 120.0
"""Time after which a run is ended [s]."""
VARIANTS = {
    "warpmag": {"method": "warpmag"},
    "warpmag, Eq. 4": {"method": "warpmag", "force": "zeeman"},
}
"""The runs of each scene."""
_AT_ONCE = 3
"""Runs that share a GPU: nobody looks at their time."""


def run(output: Output):
    """Run the experiment."""
    seconds = SMALL_SECONDS if output.small else SECONDS
    names = [(scene, name) for name in VARIANTS for scene in SCENES]
    trials = [
        Trial(scene, seconds=seconds, device=output.device, patience=PATIENCE, **VARIANTS[name])
        for scene, name in names
    ]
    rows = []
    for (scene, name), (_, values) in zip(names, run_trials(trials, _AT_ONCE), strict=True):
        output.record(variant=name, **values)
        rows.append([scene, name, *outcome_cells(values)])
    rows.sort(key=lambda row: SCENES.index(row[0]))
    output.report(_text(rows, seconds))


def _text(rows, seconds) -> str:
    return f"""## Stability: the dynamic scenes for {seconds:g} s

**Paper:** in Balls Up the balls do not settle down with kim2018 and do with the paper's method, in Alphabets they are
blown up and stay together, in Falling Magnet they scatter and cling (Figs. 3 to 6).

**Here:** steps of 1 ms, split as motion demands; "held" are bodies that touch a magnet, or hang on one that does.
Nothing solid holds the letters, so that all of them count. A run ends after {PATIENCE:g} s of waiting.

{table(["scene", "method", *outcome_head()], rows)}"""
