"""The public names of warpmag, and the module that each is loaded from on first use."""

from warpmag.declarations.curves import MagnetizationCurve as MagnetizationCurve
from warpmag.declarations.materials import material as material
from warpmag.engine.magnets.balls import Balls as Balls
from warpmag.engine.magnets.balls import add_balls as add_balls
from warpmag.engine.magnets.declared_magnets import add_inducible as add_inducible
from warpmag.engine.magnets.declared_magnets import add_permanent as add_permanent
from warpmag.engine.magnets.declared_sources import add_coil as add_coil
from warpmag.engine.magnets.declared_sources import add_field_map as add_field_map
from warpmag.engine.magnets.magnetics import Magnetics as Magnetics
from warpmag.engine.magnets.magnetometer import SensorMagnetometer as SensorMagnetometer
from warpmag.engine.magnets.usd_import import register_attributes as register_attributes
from warpmag.engine.magnets.usd_import import register_custom_attributes as register_custom_attributes
from warpmag.engine.stepping.keyed_values import KeyedCurrents as KeyedCurrents
from warpmag.engine.stepping.simulation import Simulation as Simulation
from warpmag.errors import ConvergenceWarning as ConvergenceWarning
from warpmag.errors import InputError as InputError
from warpmag.errors import SimulationError as SimulationError
from warpmag.errors import UnitWarning as UnitWarning
from warpmag.moments.fields import h_field as h_field
from warpmag.moments.fields import wrench as wrench
from warpmag.moments.induction import InductionResult as InductionResult
from warpmag.moments.induction import solve_induction as solve_induction
from warpmag.moments.ranks import sweep as sweep
from warpmag.show.export import export as export
from warpmag.show.ray_tracing import render as render
from warpmag.show.viewers import Display as Display
from warpmag.usd import check as check

__version__: str
