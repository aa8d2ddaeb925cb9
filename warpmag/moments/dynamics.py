"""Magnetization dynamics: how inducible moments move from a field evaluation towards equilibrium.

This is the one place where a dynamics is chosen. Each is an object with the same methods, which only launch kernels:
``start`` begins a solve in the applied field, ``refine`` improves the moments by the field of their neighbours before
the whole field is summed, ``iterate`` takes one step from it, and ``start_from`` sets the magnetizations of the next
start; ``carried`` says what they remember from one solve to the next. They work on the state of a solve
(``kernels.induction.solve_state``), bound to its moments.
"""

from functools import cached_property

import numpy as np

from warpmag.declarations.checks import check_positive
from warpmag.errors import InputError
from warpmag.kernels.induction import submagnetization, theta_flow
from warpmag.kernels.induction.body_response import BodyResponses

STEP = 0.3
"""Default step κ = βΔtMs [dimensionless] of the explicit dynamics: none of the larger ones measured converges in weak
and in strong fields alike (``bench.paper``, Fig. 8)."""
DAMPING = 0.2
"""Default damping α [dimensionless] of LLG: the paper's 0.2 to 0.25."""


class ThetaFlow:
    """The exact flow of the θ dynamics, accelerated; it chooses its own step."""

    def __init__(self, state, bodies: BodyResponses | None = None):
        """Move the moments of ``state``, of which some ``bodies`` respond as wholes."""
        self._state, self._bodies = state, bodies

    def carried(self) -> dict:
        """Return the arrays of its own that one solve hands on to the next one, by name."""
        return {} if self._bodies is None else self._bodies.carried()

    @cached_property
    def _launches(self) -> theta_flow.Launches:
        return theta_flow.Launches(self._state, self._bodies)

    def start_from(self, magnetizations):
        """Start the next solve from given magnetizations [A/m], a Warp array of vectors, shape [n]."""
        theta_flow.launch_set_state(self._state, magnetizations)

    def start(self):
        """Begin a solve."""
        for launch in self._launches.begin:
            launch.launch()

    def refine(self):
        """Sweep over neighbours."""
        for launch in self._launches.sweeps:
            launch.launch()

    def iterate(self):
        """Check convergence in the field just summed and move."""
        for launch in self._launches.iteration:
            launch.launch()


class SubmagnetizationPairs:
    """The explicit dynamics of pairs of submagnetizations: the paper's literal one, LLG, and LLG without precession.

    Attributes:
        first: Directions M1/Ms, shape [n].
        second: Directions M2/Ms, shape [n].
    """

    def __init__(self, state, law: str, step: float, damping: float):
        """Move the moments of ``state`` by the law ``theta-euler``, ``llg`` or ``llg-damping``."""
        self._state = state
        self._pairs = submagnetization.make_pairs(state, law, step, 1.0 / damping if law == "llg" else 0.0)
        self.first, self.second = self._pairs.first, self._pairs.second

    def carried(self) -> dict:
        """Return the arrays of its own that one solve hands on to the next one, by name."""
        return {"first": self.first, "second": self.second}

    def set_pairs(self, first, second):
        """Start the next solve from given directions of M1 and M2, NumPy arrays of unit vectors, shape [n, 3]."""
        self.first.assign(np.asarray(first))
        self.second.assign(np.asarray(second))
        self._state.warm.fill_(1)

    def start_from(self, magnetizations):
        """Start the next solve from given magnetizations [A/m], a Warp array of vectors, shape [n]."""
        submagnetization.launch_split(self._state, self._pairs, magnetizations)

    def start(self):
        """Begin a solve."""
        submagnetization.launch_begin(self._state, self._pairs)

    def refine(self):
        """Nothing to do."""

    def iterate(self):
        """Check convergence in the field just summed and step the pairs."""
        submagnetization.launch_iteration(self._state, self._pairs)


def make_dynamics(name: str, state, *, bodies=None, step: float | None = None, damping: float | None = None):
    """Return the dynamics of a name.

    Args:
        name: ``theta``, ``theta-euler``, ``llg`` or ``llg-damping``.
        state: State of the solve that it moves, bound to its moments.
        bodies: Bodies that respond as wholes (``BodyResponses``), or None; only ``theta`` lets them.
        step: Step κ = βΔtMs [dimensionless] of an explicit dynamics; None means :data:`STEP`.
        damping: Damping α [dimensionless] of ``llg``; None means :data:`DAMPING`.

    Raises:
        InputError: A setting is out of range, or one that this dynamics does not have.
    """
    if step is not None and name == "theta":
        raise InputError("step: the dynamics 'theta' chooses its own step")
    if damping is not None and name != "llg":
        raise InputError(f"damping: the dynamics {name!r} has none to choose")
    if name == "theta":
        return ThetaFlow(state, bodies)
    step, damping = STEP if step is None else step, DAMPING if damping is None else damping
    check_positive("step", step)
    check_positive("damping", damping)
    return SubmagnetizationPairs(state, name, step, damping)
