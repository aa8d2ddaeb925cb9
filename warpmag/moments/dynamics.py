"""Magnetization dynamics: iterations that bring inducible moments to equilibrium, one field evaluation each.

:func:`make_dynamics` chooses a dynamics by name. All have the same methods, which only launch kernels:

* ``start_from`` sets the magnetizations that the next solve starts from,
* ``start`` starts a solve in the applied field,
* ``refine`` improves the moments in the field of their neighbors, before the whole field is summed,
* ``iterate`` checks convergence in the summed field and takes one step.

``persistent_arrays`` returns the arrays that one solve passes to the next. All dynamics work on the state of a solve
(``kernels.induction.solve_state``), which holds the moments.
"""

from functools import cached_property

import numpy as np

from warpmag.declarations.checks import check_positive
from warpmag.errors import InputError
from warpmag.kernels.induction import submagnetization, theta_flow

STEP = 0.3
"""Default step κ = βΔtMs [dimensionless] of the explicit dynamics: the largest tested step that converges in weak and
in strong fields (``bench.paper``, Fig. 8)."""
DAMPING = 0.2
"""Default damping α [dimensionless] of LLG; Kim and Han 2022 use 0.2 to 0.25."""


class ThetaFlow:
    """Exact flow of the θ dynamics (Kim and Han 2022, Eqs. 8, 9), accelerated, with an automatic step."""

    def __init__(self, state):
        """Act on the moments of ``state``."""
        self._state = state

    def persistent_arrays(self) -> dict:
        """Return by name the arrays of the dynamics that a solve leaves for the next one."""
        return {}

    @cached_property
    def _launches(self) -> theta_flow.Launches:
        return theta_flow.Launches(self._state)

    def start_from(self, magnetizations):
        """Start the next solve from magnetizations [A/m], a Warp array of vectors, shape [n]."""
        theta_flow.launch_set_state(self._state, magnetizations)

    def start(self):
        """Start a solve."""
        for launch in self._launches.begin:
            launch.launch()

    def refine(self):
        """Improve each moment in the field of its neighbors."""
        for launch in self._launches.sweeps:
            launch.launch()

    def iterate(self):
        """Check convergence in the summed field and take one step."""
        for launch in self._launches.iteration:
            launch.launch()


class SubmagnetizationPairs:
    """Explicit dynamics of pairs of submagnetizations (Kim and Han 2022, Eqs. 6, 8, 9).

    ``first`` and ``second`` are the directions M1/Ms and M2/Ms, shape [n].
    """

    def __init__(self, state, law: str, step: float, damping: float):
        """Prepare the law ``theta-euler``, ``llg`` or ``llg-damping`` (no precession) for the moments of ``state``."""
        self._state = state
        self._pairs = submagnetization.make_pairs(state, law, step, 1.0 / damping if law == "llg" else 0.0)
        self.first, self.second = self._pairs.first, self._pairs.second

    def persistent_arrays(self) -> dict:
        """Return by name the arrays of the dynamics that a solve leaves for the next one."""
        return {"first": self.first, "second": self.second}

    def set_pairs(self, first, second):
        """Start the next solve from directions of M1 and M2, unit vectors of shape [n, 3]."""
        self.first.assign(np.asarray(first))
        self.second.assign(np.asarray(second))
        self._state.warm.fill_(1)

    def start_from(self, magnetizations):
        """Start the next solve from magnetizations [A/m], a Warp array of vectors, shape [n]."""
        submagnetization.launch_split(self._state, self._pairs, magnetizations)

    def start(self):
        """Start a solve."""
        submagnetization.launch_begin(self._state, self._pairs)

    def refine(self):
        """Do nothing: explicit dynamics have no sweeps."""

    def iterate(self):
        """Check convergence in the summed field and take one step of the pairs."""
        submagnetization.launch_iteration(self._state, self._pairs)


def make_dynamics(name: str, state, *, step: float | None = None, damping: float | None = None):
    """Return the dynamics ``theta``, ``theta-euler``, ``llg`` or ``llg-damping`` of the moments of ``state``.

    A ``step`` or a ``damping`` of None means :data:`STEP` or :data:`DAMPING`; one that the dynamics does not have
    raises ``InputError``.
    """
    if step is not None and name == "theta":
        raise InputError("step: the dynamics 'theta' has an automatic step")
    if damping is not None and name != "llg":
        raise InputError(f"damping: the dynamics {name!r} has no damping")
    if name == "theta":
        return ThetaFlow(state)
    step, damping = STEP if step is None else step, DAMPING if damping is None else damping
    check_positive("step", step)
    check_positive("damping", damping)
    return SubmagnetizationPairs(state, name, float(step), float(damping))
