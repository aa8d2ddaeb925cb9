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
    return f"""## Stability of the dynamic scenes

**Paper:** with Kim et al. 2018 the balls of Balls Up do not settle, the letters of Alphabets fly apart, and the balls
of Falling Magnet scatter. With the paper's method the balls of Balls Up settle, the letters stay together, and the
balls of Falling Magnet cling to the magnet (Figs. 3 to 6).

**Here:** the scenes are those of `warpmag run`. In Sakura Tree, which is Fig. 6, 2,500 balls fall on a tree with a
magnet at the end of each branch. Steps are 1 ms long, split into substeps according to the speeds. A run of warpmag
simulates {seconds:g} s, and a run of kim2018 simulates {SHORT * seconds:g} s. Speeds after different times are not
comparable. A run ends early after {TIME_LIMIT:g} s of wall time. The column "end" lists the simulated time.

* Method: "warpmag, Eq. 4" is this library's dynamics with the paper's force law. The name of a kim2018 row ends with κ
  and the largest number of field evaluations of an induction. The paper states neither.
* "Saturated" denotes scenes whose bodies have a lower Ms, so that magnets saturate the bodies near them. Ms is
  {balls["saturation"]:,.0f} A/m for balls and {letters["saturation"]:,.0f} A/m for letters, in place of 1.7e6 A/m. The
  magnet of the letters then has {letters["moment"]:g} A·m² in place of 12 A·m². The paper states no strengths. It calls
  its magnets "excessively strong", and argues in section 6.1 that f'(H) falls as M grows, as it does in bodies that
  saturate.
* Induction is converged at e_M ≤ 1e-3. Several substeps may share one solve, which the columns "per substep" count
  once.
* A body is "held" if it touches a permanent magnet, directly or through other bodies that are not on the ground. Empty
  cells mean that no body is held: nothing collides with the magnet of Alphabets, and some runs of Table 1 end before a
  body touches a magnet.
* Balls Up has no friction, so a ball that hangs on another ball swings without decay, and a single ball can dominate
  the RMS speed. The table also lists the median.
* "Farthest" is the largest distance of a moving body from the mean initial position of these bodies. "Deepest overlap"
  is relative to the radius of a ball, or half of the smallest dimension of the thinner body. These two and the highest
  speed are maxima over the run. The other speeds and "held" are those at its end.

The force of Eq. 4 on an inducible moment is λ times Kelvin's force, and λ falls from 8 in weak fields to 1 in
saturation (Fig. 10). Between two moments of different λ, action and reaction differ, so momentum is not conserved. A
free magnet and the balls on one side of it accelerate together without an external force. A heap of letters starts to
rotate.

{results}"""
