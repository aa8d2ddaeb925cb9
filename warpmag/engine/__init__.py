"""Magnets in Newton: the only part of warpmag that imports ``newton``."""

from warpmag.engine.attributes import add_inducible, add_permanent, register_attributes
from warpmag.engine.contacts import SOLVERS
from warpmag.engine.magnetics import Magnetics
from warpmag.engine.simulation import Simulation
from warpmag.engine.statistics import Statistics

__all__ = [
    "SOLVERS",
    "Magnetics",
    "Simulation",
    "Statistics",
    "add_inducible",
    "add_permanent",
    "register_attributes",
]
