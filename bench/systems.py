"""Moment systems from flat keyword arguments, for benchmarks and tests."""

from dataclasses import fields

from warpmag.moments.layout import MomentMaterial
from warpmag.moments.settings import SolverSettings
from warpmag.moments.system import MomentSystem


def moment_system(**arguments) -> MomentSystem:
    """Return a system from the arguments of :class:`MomentSystem` and the fields of its records."""
    for name, record in (("material", MomentMaterial), ("settings", SolverSettings)):
        names = {field.name for field in fields(record)} & arguments.keys()
        arguments[name] = record(**{field: arguments.pop(field) for field in names})
    return MomentSystem(**arguments)


def solve_cold(system: MomentSystem) -> None:
    """Solve without the last solution as the start."""
    system.start_cold()
    system.solve()
