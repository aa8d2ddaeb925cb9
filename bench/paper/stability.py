"""Stability: the dynamic scenes for 5 s by this library's method, by it with the paper's force law, and by kim2018's.

The paper shows pictures and says "excessively strong"; it gives neither strengths nor speeds. What is measured here is
what would be lost, ejected or shaken: speeds at the end, the highest speed, the farthest body, the deepest penetration.
Pairs of submagnetizations that are to converge take too long for 5 s, and the paper does not say how many iterations a
step of 1 ms affords them: kim2018's method runs for less time, with few.
"""

from dataclasses import dataclass

from bench.paper.output import Output, table
from bench.paper.trials import SCENES, Trial, outcome_cells, outcome_head, run_trials
from warpmag.moments.dynamics import STEP

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


@dataclass(frozen=True)
class Variant:
    """How the scenes are run.

    Attributes:
        name: As the table has it.
        method: Name of a published method, of :data:`warpmag.declarations.magnets.PRESETS`.
        force: Force law in place of the method's own.
        saturated: Whether magnets saturate what they hold.
        max_evaluations: Field evaluations after which induction ends.
        pair_step: Step κ of the pairs of submagnetizations.
        part: Part of the time that is simulated.
    """

    name: str
    method: str = "warpmag"
    force: str | None = None
    saturated: bool = False
    max_evaluations: int = 1000
    pair_step: float = STEP
    part: float = 1.0

    def trial(self, scene: str, seconds: float, device: str) -> Trial:
        """Return the run of a scene."""
        return Trial(
            scene,
            self.method,
            self.part * seconds,
            device,
            PATIENCE,
            max_evaluations=self.max_evaluations,
            pair_step=self.pair_step,
            force=self.force,
            parameters=SATURATED[scene] if self.saturated else {},
        )


VARIANTS = (
    Variant("warpmag"),
    Variant("warpmag, Eq. 4", force="zeeman"),
    Variant("warpmag, Eq. 4, saturated", force="zeeman", saturated=True),
    *(
        Variant(f"kim2018{suffix}, κ = {step:g}, {most}", "kim2018", None, bool(suffix), most, step, part=0.2)
        for suffix in ("", ", saturated")
        for step, most in ((STEP, 10), (STEP, 30), (STEP, 100), (1.0, 10), (1.0, 100))
    ),
)
"""The runs of each scene."""
_AT_ONCE = 6
"""Runs that share a GPU: nobody looks at their time."""


def run(output: Output):
    """Run the experiment."""
    seconds = SMALL_SECONDS if output.small else SECONDS
    runs = [(scene, variant) for variant in VARIANTS for scene in SCENES]
    trials = [variant.trial(scene, seconds, output.device) for scene, variant in runs]
    rows = []
    for (scene, variant), (_, values) in zip(runs, run_trials(trials, _AT_ONCE), strict=True):
        output.record(variant=variant.name, **values)
        rows.append([scene, variant.name, *outcome_cells(values)])
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

"kim2018" are pairs of submagnetizations, Eq. 7 and Kelvin's force, for {VARIANTS[-1].part * seconds:g} s; then the step
κ of the pairs, and how many field evaluations an induction may take. The paper gives neither.

A ball that hangs on one other swings for good where there is no friction: in Balls Up a single one may carry the RMS,
and the median tells how the others are.

{table(["scene", "method", *outcome_head()], rows)}"""
