"""Magnets for the Newton physics engine.

Fields of magnetic moments, induction to magnetic equilibrium and magnetic forces, in NVIDIA Warp kernels for CPU and
CUDA. The method is that of Kim and Han 2022, "Fast Stabilization of Inducible Magnet Simulation". All units are SI.

Importing this package imports neither Warp nor Newton nor USD. A public name loads its module on first use.
"""

import ast
import sys
import warnings
from importlib import import_module
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType

from warpmag.terminal import collection_paused

__version__ = "0.1.0"

_FOLDER = Path(__file__).resolve().parent
if not (_FOLDER / "kernels").exists():  # in a checkout kernels and scenes_usd are beside this folder
    __path__.append(str(_FOLDER.parent))


def _public_modules() -> dict[str, str]:
    """Return the module of each public name, from the stub beside this file."""
    stub = ast.parse((_FOLDER / "__init__.pyi").read_text(encoding="utf-8"))
    imports = [node for node in stub.body if isinstance(node, ast.ImportFrom)]
    return {alias.name: node.module or "" for node in imports for alias in node.names}


_MODULES = _public_modules()
__all__ = sorted(_MODULES)


def __getattr__(name):
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    with collection_paused():  # importing Newton and Warp creates very many objects
        return getattr(import_module(_MODULES[name]), name)


def __dir__():
    return [*__all__, "__version__"]


_MOVED = {
    **{f"warpmag.{name}": f"warpmag.declarations.{name}" for name in ("magnets", "coils", "materials", "curves")},
    "warpmag.probe": "warpmag.moments.probe",
    "warpmag.export": "warpmag.show.export",
    "warpmag.final": "warpmag.show.blender",
    "warpmag.engine.render": "warpmag.show.ray_tracing",
    "warpmag.engine.statistics": "warpmag.engine.stepping.statistics",
}
"""Earlier and present names of documented modules."""


class _MovedModule(ModuleType):
    """A module under its earlier name. A call is one of the public function of the same name, which it hides."""

    def __call__(self, *arguments, **named):
        return getattr(self, self.__name__.rpartition(".")[2])(*arguments, **named)


class _MovedModules:
    """Finder that imports a module by its earlier name, with a DeprecationWarning that names the present module."""

    @classmethod
    def find_spec(cls, name, path=None, target=None):
        return ModuleSpec(name, cls) if name in _MOVED else None

    @staticmethod
    def create_module(spec):
        return _MovedModule(spec.name)

    @staticmethod
    def exec_module(module):
        present = _MOVED[module.__name__]
        warnings.warn(f"{module.__name__} is now {present}", DeprecationWarning, stacklevel=2)
        contents = vars(import_module(present)).items()
        vars(module).update({name: value for name, value in contents if not name.startswith("__")})


sys.meta_path.append(_MovedModules)  # last, so that it applies only to modules without a file
