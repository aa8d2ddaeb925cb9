"""Magnetization dynamics: how inducible moments move from a field evaluation towards equilibrium.

This is the one place where a dynamics is chosen. Each is an object with the same four methods, all of which only launch
kernels: ``start`` begins a solve in the field of the permanent moments just summed, ``refine`` improves the moments by
what their neighbours tell, before the field is summed, ``iterate`` takes one step from it, and ``start_from`` sets the
magnetizations that the next solve starts from.
"""

from dataclasses import dataclass

import numpy as np
import warp as wp

from warpmag.errors import InputError
from warpmag.kernels.induction import submagnetization, theta_flow, theta_flow_cpu
from warpmag.kernels.induction.solve_state import InductionBuffers
from warpmag.kernels.material.curves import CurveParameters
from warpmag.kernels.pairs.work_list import Rows
from warpmag.kernels.shared import team as cpu_team
from warpmag.magnets import DYNAMICS, check_positive, check_token
from warpmag.packed import PackedMoments

STEP = 0.3
"""Default step κ = βΔtMs [dimensionless] of the explicit dynamics: none of the larger ones measured converges in weak
and in strong fields alike (``bench.paper``, Fig. 8)."""
DAMPING = 0.2
"""Default damping α [dimensionless] of LLG: the paper's 0.2 to 0.25."""


@dataclass(frozen=True)
class Inducibles:
    """The inducible moments that a dynamics moves, and when it is to end.

    Attributes:
        rows: Work list, inducible moments on inducible moments.
        applied: Work list, permanent moments on inducible ones.
        applied_partial: Sums of the field loop over it.
        external_field: External field [A/m], shape [n].
        packed: All moments, packed.
        material: What they are made of.
        moments: Moments [A·m²], shape [n]; the inducible ones are written.
        state: Fields, convergence and history of every world.
        rtol: Relative residual at which a world ends.
        max_evaluations: Field evaluations after which a world gives up.
    """

    rows: Rows
    applied: Rows
    applied_partial: wp.array
    external_field: wp.array
    packed: PackedMoments
    material: CurveParameters
    moments: wp.array
    state: InductionBuffers
    rtol: float
    max_evaluations: int


class ThetaFlow:
    """The exact flow of the θ dynamics, accelerated; it chooses its own step."""

    def __init__(self, target: Inducibles):
        """Move ``target``."""
        self._target = t = target
        self._passes = None
        if t.packed.device.is_cpu and cpu_team.VECTORS:
            self._passes = theta_flow_cpu.allocate(
                t.applied, t.applied_partial, t.rows, t.packed, t.external_field, t.material, t.state, t.moments
            )

    def start_from(self, magnetizations):
        """Start the next solve from given magnetizations [A/m], a Warp array of vectors, shape [n]."""
        t = self._target
        theta_flow.launch_set_state(t.rows, magnetizations, t.material, t.state)

    def start(self):
        """Begin a solve."""
        t = self._target
        if self._passes:
            theta_flow_cpu.launch_begin(self._passes)
        else:
            theta_flow.launch_begin(
                t.applied, t.applied_partial, t.rows, t.packed, t.external_field, t.material, t.state, t.moments
            )

    def refine(self):
        """Sweep over neighbours."""
        t = self._target
        if self._passes:
            theta_flow_cpu.launch_sweeps(self._passes)
        else:
            theta_flow.launch_sweeps(t.rows, t.packed, t.material, t.state, t.moments)

    def iterate(self):
        """Judge the field just summed and move."""
        t = self._target
        if self._passes:
            theta_flow_cpu.launch_iteration(self._passes, t.rtol, t.max_evaluations)
        else:
            theta_flow.launch_iteration(t.rows, t.packed, t.material, t.state, t.rtol, t.max_evaluations, t.moments)


class SubmagnetizationPairs:
    """The explicit dynamics of pairs of submagnetizations: the paper's literal one, LLG, and LLG without precession.

    Attributes:
        first: Directions M1/Ms, shape [n].
        second: Directions M2/Ms, shape [n].
    """

    def __init__(self, target: Inducibles, law: str, step: float, damping: float):
        """Move ``target`` by the law ``theta-euler``, ``llg`` or ``llg-damping``."""
        self._target = target
        self._settings = {
            "law": submagnetization.LAW_IDS[law],
            "kappa": step,
            "precession": 1.0 / damping if law == "llg" else 0.0,
            "rtol": target.rtol,
            "max_evaluations": target.max_evaluations,
        }
        self.first = wp.zeros_like(target.moments)
        self.second = wp.zeros_like(target.moments)

    def set_pairs(self, first, second):
        """Start the next solve from given directions of M1 and M2, NumPy arrays of unit vectors, shape [n, 3]."""
        self.first.assign(np.asarray(first))
        self.second.assign(np.asarray(second))
        self._target.state.warm.fill_(1)

    def start_from(self, magnetizations):
        """Start the next solve from given magnetizations [A/m], a Warp array of vectors, shape [n]."""
        t = self._target
        submagnetization.launch_split_magnetizations(
            t.rows, magnetizations, t.material, t.state, self.first, self.second
        )

    def start(self):
        """Begin a solve."""
        t = self._target
        submagnetization.launch_begin(
            t.applied, t.applied_partial, t.packed, t.external_field, t.material, t.state, self.first, self.second,
            t.moments,
        )  # fmt: skip

    def refine(self):
        """Nothing to do."""

    def iterate(self):
        """Judge the field just summed and step the pairs."""
        t = self._target
        submagnetization.launch_step_pairs(
            t.packed, t.rows, t.material, t.state, self.first, self.second, t.moments, **self._settings
        )


def make_dynamics(name: str, target: Inducibles, *, step: float | None = None, damping: float | None = None):
    """Return the dynamics of a name.

    Args:
        name: ``theta``, ``theta-euler``, ``llg`` or ``llg-damping``.
        target: What it moves.
        step: Step κ = βΔtMs [dimensionless] of an explicit dynamics; None means :data:`STEP`.
        damping: Damping α [dimensionless] of ``llg``; None means :data:`DAMPING`.

    Raises:
        InputError: Unknown name, or a setting that is out of range or that this dynamics does not have.
    """
    check_token("dynamics", name, DYNAMICS)
    if step is not None and name == "theta":
        raise InputError("step: the dynamics 'theta' chooses its own step")
    if damping is not None and name != "llg":
        raise InputError(f"damping: the dynamics {name!r} has none to choose")
    if name == "theta":
        return ThetaFlow(target)
    step, damping = STEP if step is None else step, DAMPING if damping is None else damping
    check_positive("step", step)
    check_positive("damping", damping)
    return SubmagnetizationPairs(target, name, step, damping)
