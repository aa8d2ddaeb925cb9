"""Public functions that are called, by name, with what has to be made before a call."""

import inspect
from collections.abc import Callable
from contextlib import suppress
from importlib import import_module
from types import ModuleType
from typing import Any

import warpmag
from warpmag.moments.probe import FieldProbe

from .worlds import FOLDER, STAGE, new_builder


def _importable(*names: str) -> dict[str, ModuleType]:
    """Return the modules of warpmag whose libraries are installed, by the last part of their names."""
    modules = {}
    for name in names:
        with suppress(ImportError):
            modules[name] = import_module(f"warpmag.{name}")
    return modules


# functions of a world, by what has to be made before the call; the arguments are those of the signature
OWNERS: dict[str, Callable[[dict], Any]] = {
    "Magnetics": lambda world: world["magnetics"],
    "SensorMagnetometer": lambda world: world["sensor"],
    "FieldProbe": lambda world: world["probe"],
    "KeyedCurrents": lambda world: warpmag.KeyedCurrents(world["model"]),
    "Display": lambda world: warpmag.Display(world["viewer"], world["model"], world["magnetics"]),
    "Simulation": lambda world: warpmag.Simulation(new_builder(world), device="cpu"),
}
CLASSES = {"FieldProbe": FieldProbe, **{name: getattr(warpmag, name) for name in OWNERS if name != "FieldProbe"}}
ARRAYS = ("solve_induction", "h_field", "wrench")
FUNCTIONS = (
    *("register_attributes", "register_custom_attributes", "add_inducible", "add_permanent", "add_balls", "add_coil"),
    *("add_field_map", "material", "check", "sweep", "render", "export", *ARRAYS),
)
CURVES = ("from_bh", "from_mh", "from_csv")
LIBRARIES = _importable("torch", "jax")
SINGLE = {
    "MagnetizationCurve.from_mh": {"magnetizations": [0.0, 5e5, 1e6]},
    "MagnetizationCurve.from_csv": {"path": str(FOLDER / "curve.csv")},
    "Magnetics.set_voltage": {"coil": "driven"},
    "sweep": {"simulate": list, "world_count": 4, "together": 2},
    "render": {"stage": STAGE, "output": "calls.png", "size": (16, 9), "frame": 0, "on_camera": str},
    "export": {"stage": STAGE, "output": "calls.usdc"},
}
"""Right arguments of one function alone."""
USUAL = ("body", "magnetization", "saturation", "radius", "device", "dtype", "dt", "worlds", "gradients", "size")
"""Optional arguments that are given in most calls, as users do."""
PASSIVE = {"persistent_arrays", "stepped_arrays", "warnings", "frame", "allow_restart", "stay"}
"""Methods without arguments that return no numbers, or only when a viewer is closed."""


def targets() -> dict[str, Callable[[Callable[[str], Any]], Callable]]:
    """Return every public function by name: functions, constructors, methods and settable properties.

    Each is got from a function that returns an owner of :data:`OWNERS` by its name.
    """
    functions: dict[str, Callable[[Callable[[str], Any]], Callable]] = {}
    for name in FUNCTIONS:
        functions[name] = lambda owned, name=name: getattr(warpmag, name)
    for name in CURVES:
        functions[f"MagnetizationCurve.{name}"] = lambda owned, name=name: getattr(warpmag.MagnetizationCurve, name)
    for library, module in LIBRARIES.items():
        for name in ARRAYS:
            functions[f"{library}.{name}"] = lambda owned, module=module, name=name: getattr(module, name)
    for owner in OWNERS:
        functions[owner] = lambda owned, owner=owner: CLASSES[owner]
        for name, member in vars(CLASSES[owner]).items():
            if name.startswith("_") or name in PASSIVE:
                continue
            if inspect.isfunction(member):
                functions[f"{owner}.{name}"] = lambda owned, owner=owner, name=name: getattr(owned(owner), name)
            elif isinstance(member, property) and member.fset:
                functions[f"{owner}.{name}"] = lambda owned, owner=owner, name=name: _setter(owned(owner), name)
    return functions


def _setter(owner: Any, name: str) -> Callable:
    def assign(control):
        setattr(owner, name, control)

    return assign
