"""Magnets for the Newton physics engine.

Fields of magnetic moments, induction to magnetic equilibrium and magnetic forces, as NVIDIA Warp kernels for CPU and
CUDA, after Kim and Han 2022, "Fast Stabilization of Inducible Magnet Simulation". SI units everywhere.

Importing this package imports neither Warp nor Newton nor USD; the names below load what they need when first used.
"""

from importlib import import_module

_HOMES = {
    "InputError": "warpmag.errors",
    "SimulationError": "warpmag.errors",
    "ConvergenceWarning": "warpmag.errors",
    "h_field": "warpmag.fields",
    "wrench": "warpmag.fields",
    "solve_induction": "warpmag.induction",
    "InductionResult": "warpmag.induction",
    "material": "warpmag.materials",
    "MagnetizationCurve": "warpmag.curves",
    "register_attributes": "warpmag.engine.attributes",
    "add_inducible": "warpmag.engine.attributes",
    "add_permanent": "warpmag.engine.attributes",
    "add_coil": "warpmag.engine.applied",
    "add_field_map": "warpmag.engine.applied",
    "Display": "warpmag.engine.display",
    "Magnetics": "warpmag.engine.magnetics",
    "SensorMagnetometer": "warpmag.engine.magnetometer",
    "Simulation": "warpmag.engine.simulation",
}

__all__ = sorted(_HOMES)


def __getattr__(name):
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_HOMES[name]), name)


def __dir__():
    return __all__
