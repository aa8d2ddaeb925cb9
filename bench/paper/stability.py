"""Stability: the dynamic scenes for 5 s by warpmag's method, the same with the paper's force law, and kim2018.

The paper shows pictures and says "excessively strong"; it states neither strengths nor speeds. Measured here are final
speeds, the highest speed, the farthest body and the deepest penetration. Converged pairs of submagnetizations take too
long for 5 s, and the paper does not say how many iterations a step of 1 ms has. So kim2018 runs for less time, with few
iterations.
"""

from bench.paper.output import Output, table
from bench.paper.trials import SCENES, Trial, outcome_cells, run_trials
from warpmag.moments.dynamics import STEP

SECONDS, SMALL_SECONDS = 5.0, 0.1
TIME_LIMIT = 300.0  # wall time after which a run is ended [s]
SATURATED = {
    "balls_up": {"saturation": 5e4},
    "alphabets": {"saturation": 1e4, "moment": 40.0},
    "falling_magnet": {"saturation": 5e4},
    "sakura_tree": {"saturation": 5e4},
}
"""Parameters of scenes whose magnets saturate the bodies that they hold."""
SHORT = 0.2  # part of the time that kim2018 runs
VARIANTS = {
    "warpmag": {},
    "warpmag, Eq. 4": {"force": "zeeman"},
    "warpmag, Eq. 4, saturated": {"force": "zeeman", "parameters": SATURATED},
} | {
    f"kim2018{suffix}, κ = {step:g}, {most}": {
        "method": "kim2018", "max_evaluations": most, "pair_step": step, "parameters": SATURATED if suffix else {},
    }
    for suffix in ("", ", saturated")
    for step, most in ((STEP, 10), (STEP, 30), (STEP, 100), (1.0, 10), (1.0, 100))
}  # fmt: skip
"""Runs of each scene: arguments of :class:`Trial`, parameters by scene."""
_AT_ONCE = 6  # number of runs that share a GPU; their times are not reported


def run(output: Output):
    """Run the experiment."""
    seconds = SMALL_SECONDS if output.small else SECONDS
    runs = [(scene, name) for name in VARIANTS for scene in SCENES]
    trials = [_trial(scene, seconds, output.device, **VARIANTS[name]) for scene, name in runs]
    rows = []
    for (scene, name), (_, values) in zip(runs, run_trials(trials, _AT_ONCE), strict=True):
        output.record(variant=name, **values)
        rows.append({"scene": scene, "method": name, **outcome_cells(values)})
    rows.sort(key=lambda row: SCENES.index(row["scene"]))
    output.report(_text(table(list(rows[0]), [list(row.values()) for row in rows]), seconds))


def _trial(scene: str, seconds: float, device: str, method="warpmag", parameters=None, **settings) -> Trial:
    seconds *= SHORT if method == "kim2018" else 1.0
    return Trial(scene, method, seconds, device, TIME_LIMIT, parameters=(parameters or {}).get(scene, {}), **settings)


def _text(results: str, seconds: float) -> str:
    balls, letters = (SATURATED[scene] for scene in ("balls_up", "alphabets"))
    return f"""## Stability: the dynamic scenes for {seconds:g} s

**Paper:** with kim2018 the balls of Balls Up do not settle, the letters of Alphabets are blown up, and the balls of
Falling Magnet scatter. With the paper's method the balls settle, the letters stay together, and the balls cling (Figs.
3 to 6).

**Here:** steps of 1 ms, split into substeps according to the speeds. Bodies are "held" if they touch a magnet, directly
or through others. No body holds the letters, so all of them count. A run ends after {TIME_LIMIT:g} s of wall time.

The force of Eq. 4 on a moment is λ times Kelvin's force, where λ falls from 8 in weak fields to 1 in saturation.
Between two magnets of different λ, action and reaction differ, so momentum is not conserved. A free magnet and the
balls on one side of it accelerate each other, and a heap of letters turns about a moment.

The paper states no strengths. Its "excessively strong" magnets, and its argument that f'(H) falls as M grows (section
6.1), concern saturation. "Saturated" denotes the same scenes with magnets that saturate the bodies they hold: balls at
{balls["saturation"]:g} A/m in place of 1.7e6, letters at {letters["saturation"]:g} A/m with a moment of
{letters["moment"]:g} A·m² in place of 12.

"kim2018" denotes pairs of submagnetizations with Eq. 7 and Kelvin's force, for {SHORT * seconds:g} s.
The step κ of the pairs and the largest number of field evaluations of an induction follow. The paper states neither.

Without friction a ball that hangs on another ball swings forever. So a single ball may dominate the RMS speed in Balls
Up. The median describes the others.

{results}"""
