"""Newton's rigid-body solvers by name, with their settings for piles of small bodies.

Newton is imported when a solver is made, so that the command can list the names without it.
"""

from collections.abc import Callable
from dataclasses import dataclass

from warpmag.declarations.checks import check_token


@dataclass(frozen=True)
class SolverKind:
    """One kind of rigid-body solver."""

    make: Callable  # function of a model and the capacity of its contact buffer that returns the solver
    maximal: bool = False  # moves poses of bodies, so that joints need no articulation
    resumable: bool = True  # has no hidden state between steps, so that a checkpoint is complete
    contacts_at_end: bool = False  # evaluates contacts at the end of a step, and needs kinematic bodies posed there
    warning: str = ""  # known weakness, one line for the user


def _xpbd(model, contact_max: int):
    from warpmag.engine.pile_xpbd.xpbd import PileXPBD  # noqa: PLC0415 - imports Newton

    # All contacts are relaxed in parallel. With more than a third of each correction the many contacts of a ball
    # overshoot together, and a pile never settles: on Balls Up the RMS speed after 1.5 s is 0.15 cm/s at 0.35, 1.6 at
    # 0.5 and 10 at Newton's 0.8. Averaging over the contacts of a body would need far more iterations.
    # ``kernels.contacts.solve`` accelerates its iterations: on Balls Up after 5 s, 30 of them leave the same speeds as
    # 60, and an overlap of 0.5 % of the radius instead of 0.2 %.
    settings = {"iterations": 60, "contact_iterations": 30}
    settings |= {"rigid_contact_relaxation": 0.35, "rigid_contact_con_weighting": False}
    # Linear and angular joint relaxation are equal. With Newton's 0.7 and 0.4 hinged bodies swing as if they were
    # heavier: a quarter swing ends at 84.9 instead of 90 degrees. Two joints at the same place are stable up to 0.5.
    settings |= {"joint_linear_relaxation": 0.4, "joint_angular_relaxation": 0.4}
    return PileXPBD(model, contact_max, **settings)


def _newton(name: str, model, **settings):
    import newton  # noqa: PLC0415

    return getattr(newton.solvers, name)(model, **settings)


def _steel(model, contact_max: int):
    settings = {"iterations": 60, "free_body_constraint_max": 3 * contact_max, "warn_constraint_overflow": False}
    return _newton("SolverSteel", model, **settings)


def _mujoco(model, contact_max: int):
    return _newton("SolverMuJoCo", model, use_mujoco_contacts=False, nconmax=contact_max, njmax=3 * contact_max)


SOLVERS = {
    "xpbd": SolverKind(_xpbd, maximal=True, contacts_at_end=True),
    "steel": SolverKind(_steel),
    "mujoco": SolverKind(_mujoco, resumable=False),
    "semi-implicit": SolverKind(lambda model, contact_max: _newton("SolverSemiImplicit", model), maximal=True),
    "featherstone": SolverKind(lambda model, contact_max: _newton("SolverFeatherstone", model)),
    "kamino": SolverKind(
        lambda model, contact_max: _newton("SolverKamino", model),
        maximal=True,
        resumable=False,
        warning="solver kamino: a step takes seconds where hundreds of bodies touch, and drives of joints are far "
        "stiffer than their gains; xpbd does not have these faults",
    ),
    "vbd": SolverKind(
        lambda model, contact_max: _newton("SolverVBD", model, iterations=20),
        maximal=True,
        resumable=False,
        warning="solver vbd: bodies that magnets press together sink into each other and may fly apart, and hinged "
        "bodies lose several percent of a swing; xpbd does not have these faults",
    ),
}
"""Rigid-body solvers by name. The first is the default, which is tested with piles."""
MAXIMAL = tuple(name for name, kind in SOLVERS.items() if kind.maximal)
"""Names of the solvers in maximal coordinates."""


def check_solver(solver: str) -> None:
    """Raise :class:`InputError` unless ``solver`` is the name of a solver."""
    check_token("solver", solver, tuple(SOLVERS))
