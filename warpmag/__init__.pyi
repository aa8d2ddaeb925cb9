"""The public names of warpmag, each with the module that it is loaded from when first used."""

from warpmag.curves import MagnetizationCurve as MagnetizationCurve
from warpmag.engine.applied import add_coil as add_coil
from warpmag.engine.applied import add_field_map as add_field_map
from warpmag.engine.attributes import add_inducible as add_inducible
from warpmag.engine.attributes import add_permanent as add_permanent
from warpmag.engine.attributes import register_attributes as register_attributes
from warpmag.engine.attributes import register_custom_attributes as register_custom_attributes
from warpmag.engine.balls import Balls as Balls
from warpmag.engine.balls import add_balls as add_balls
from warpmag.engine.display import Display as Display
from warpmag.engine.drive import KeyedCurrents as KeyedCurrents
from warpmag.engine.magnetics import Magnetics as Magnetics
from warpmag.engine.magnetometer import SensorMagnetometer as SensorMagnetometer
from warpmag.engine.simulation import Simulation as Simulation
from warpmag.errors import ConvergenceWarning as ConvergenceWarning
from warpmag.errors import InputError as InputError
from warpmag.errors import SimulationError as SimulationError
from warpmag.fields import h_field as h_field
from warpmag.fields import wrench as wrench
from warpmag.induction import InductionResult as InductionResult
from warpmag.induction import solve_induction as solve_induction
from warpmag.materials import material as material
from warpmag.ranks import sweep as sweep

__version__: str
