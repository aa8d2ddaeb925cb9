"""Public functions that are called, by name, with what has to be made before a call."""

import inspect
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from importlib import import_module
from types import ModuleType
from typing import Any

import warpmag
from warpmag import usd
from warpmag.engine.stepping.statistics import Statistics
from warpmag.moments.probe import FieldProbe
from warpmag.show.blender import render_final

from .stages import FOLDER, RECORDS, STAGE, STAGE_FUNCTIONS, authoring
from .worlds import POINTS, new_builder


def _importable(*names: str) -> dict[str, ModuleType]:
    """Return the modules of warpmag whose libraries are installed, by the last part of their names."""
    modules = {}
    for name in names:
        with suppress(ImportError):
            modules[name] = import_module(f"warpmag.{name}")
    return modules


@cache
def _result(name: str) -> Any:
    """Return a result of a public function that has methods itself."""
    if name == "MagnetizationCurve":
        return warpmag.MagnetizationCurve.from_bh([0.0, 1e3, 1e5], [0.0, 1.0, 1.5])
    if name == "InductionResult":
        return warpmag.solve_induction(POINTS, 0.005, saturation=1e6, external_field=(0.0, 0.0, 1e5), device="cpu")
    if name == "StageReport":
        return warpmag.check(STAGE)
    simulation = warpmag.Simulation(new_builder({}), device="cpu")
    simulation.step()
    return simulation.finish()


# functions of a world, by what has to be made before the call; the arguments are those of the signature
OWNERS: dict[str, Callable[[dict], Any]] = {
    "Magnetics": lambda world: world["magnetics"],
    "SensorMagnetometer": lambda world: world["sensor"],
    "FieldProbe": lambda world: world["probe"],
    "KeyedCurrents": lambda world: warpmag.KeyedCurrents(world["model"]),
    "Display": lambda world: warpmag.Display(world["viewer"], world["model"], world["magnetics"]),
    "Simulation": lambda world: warpmag.Simulation(new_builder(world), device="cpu"),
}
RESULTS: dict[str, type] = {
    "InductionResult": warpmag.InductionResult,
    "MagnetizationCurve": warpmag.MagnetizationCurve,
    "StageReport": usd.StageReport,
    "Statistics": Statistics,
}
"""Classes that public functions return, and whose constructors are not public."""
CLASSES = {name: getattr(warpmag, name, FieldProbe) for name in OWNERS} | RESULTS
OWNERS |= {name: lambda world, name=name: _result(name) for name in RESULTS}
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
    "render_final": {"stage": STAGE, "output": "calls.png", "size": (16, 9), "frame": 0},
    "export": {"stage": STAGE, "output": "calls.usdc"},
    "check": {"path": STAGE},
    "usd.open_stage": {"path": STAGE},
    "InductionResult.wrench": {"force": "zeeman"},
    "StageReport.magnets": {"kind": "permanent"},
    "FieldMap": {"spacing": (0.01, 0.01, 0.01)},
    "Statistics.milliseconds_since": {"step": 0},
}
"""Right arguments of one function alone."""
USUAL = ("body", "magnetization", "saturation", "radius", "device", "dtype", "dt", "worlds", "gradients", "size")
"""Optional arguments that are given in most calls, as users do."""
PASSIVE = {"persistent_arrays", "stepped_arrays", "warnings", "frame", "allow_restart", "stay"}
"""Methods without arguments that return no numbers, or only when a viewer is closed."""
UNDOCUMENTED = {"add_step", "save", "load", "discard_attempt"}
"""Methods that runs call, and that the pages leave out."""


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
    for name in STAGE_FUNCTIONS:
        functions[f"usd.{name}"] = lambda owned, name=name: getattr(usd, name)
    for record in RECORDS:
        functions[record.__name__] = lambda owned, record=record: authoring(record, owned("world")["prim"])
    functions["render_final"] = lambda owned: render_final
    for owner in OWNERS:
        if owner not in RESULTS:
            functions[owner] = lambda owned, owner=owner: CLASSES[owner]
        functions |= _methods(owner)
    return functions


def _methods(owner: str) -> dict[str, Callable[[Callable[[str], Any]], Callable]]:
    """Return the methods and settable properties of an owner, as :func:`targets` does."""
    functions: dict[str, Callable[[Callable[[str], Any]], Callable]] = {}
    for name, member in vars(CLASSES[owner]).items():
        if name.startswith("_") or name in PASSIVE | UNDOCUMENTED:
            continue
        if inspect.isfunction(member):
            functions[f"{owner}.{name}"] = lambda owned, name=name: getattr(owned(owner), name)
        elif isinstance(member, property) and member.fset:
            functions[f"{owner}.{name}"] = lambda owned, name=name: _setter(owned(owner), name)
    return functions


def _setter(owner: Any, name: str) -> Callable:
    def assign(control):
        setattr(owner, name, control)

    return assign
