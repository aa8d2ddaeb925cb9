"""Stability: the dynamic scenes for 5 s by this library's method, and by it with the paper's force law.

The paper shows pictures and says "excessively strong"; it gives neither strengths nor speeds. What is measured here is
what would be lost, ejected or shaken: speeds at the end, the highest speed, the farthest body, the deepest penetration.
Table 1 has the same figures of the paper's and of kim2018's method, whose pairs take too long for 5 s.
"""

from bench.paper.output import Output, table
from bench.paper.trials import SCENES, Trial, outcome_cells, outcome_head, run_trials

SECONDS, SMALL_SECONDS = 5.0, 0.1
PATIENCE = 300.0
"""Time after which a run is ended [s]."""
SATURATED = {
    "balls_up": {"saturation": 5e4},
    "alphabets": {"saturation": 1e4, "moment": 40.0},
    "falling_magnet": {"saturation": 5e4},
    "sakura_tree": {"saturation": 5e4},
}
"""Parameters of scenes whose magnets saturate what they hold."""
VARIANTS = {
    "warpmag": ("kelvin", {}),
    "warpmag, Eq. 4": ("zeeman", {}),
    "warpmag, Eq. 4, saturated": ("zeeman", SATURATED),
}
"""The runs of each scene: force law, parameters of the scenes."""
_AT_ONCE = 6
"""Runs that share a GPU: nobody looks at their time."""


def run(output: Output):
    """Run the experiment."""
    seconds = SMALL_SECONDS if output.small else SECONDS
    names = [(scene, name) for name in VARIANTS for scene in SCENES]
    trials = [
        Trial(scene, "warpmag", seconds, output.device, PATIENCE, force=law, parameters=parameters.get(scene, {}))
        for scene, law, parameters in ((scene, *VARIANTS[name]) for scene, name in names)
    ]
    rows = []
    for (scene, name), (_, values) in zip(names, run_trials(trials, _AT_ONCE), strict=True):
        output.record(variant=name, **values)
        rows.append([scene, name, *outcome_cells(values)])
    rows.sort(key=lambda row: SCENES.index(row[0]))
    output.report(_text(rows, seconds))


def _text(rows, seconds) -> str:
    balls, letters = (SATURATED[scene] for scene in ("balls_up", "alphabets"))
    return f"""## Stability: the dynamic scenes for {seconds:g} s

**Paper:** in Balls Up the balls do not settle down with kim2018 and do with the paper's method, in Alphabets they are
blown up and stay together, in Falling Magnet they scatter and cling (Figs. 3 to 6).

**Here:** steps of 1 ms, split as motion demands; "held" are bodies that touch a magnet, or hang on one that does.
Nothing solid holds the letters, so that all of them count. A run ends after {PATIENCE:g} s of waiting.

Eq. 4 is λ times Kelvin's force on each moment, λ from 8 in weak fields to 1 in saturation. Where two magnets have
different λ, action is not reaction, and momentum comes from nothing: a free magnet and the balls on its one side drag
each other along, and a heap of letters turns about a moment that nothing turns back, by just what the law's torques
add up to. The paper gives no strengths; its "excessively strong" magnets, and its argument that f'(H) falls as M grows
(section 6.1), are about saturation. "Saturated" are the same scenes where the magnets saturate what they hold: balls at
{balls["saturation"]:g} A/m in place of 1.7e6, letters at {letters["saturation"]:g} A/m with a moment of
{letters["moment"]:g} A·m² in place of 12.

A ball that hangs on one other swings for good where there is no friction: in Balls Up a single one may carry the RMS,
and the median tells how the others are.

{table(["scene", "method", *outcome_head()], rows)}"""
