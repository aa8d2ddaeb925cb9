"""Magnets for the Newton physics engine.

Fields of magnetic moments, induction to magnetic equilibrium and magnetic forces, in NVIDIA Warp kernels for CPU and
CUDA. The method is that of Kim and Han 2022, "Fast Stabilization of Inducible Magnet Simulation". All units are SI.

Importing this package imports neither Warp nor Newton nor USD. A public name loads its module on first use.
"""

import ast
from importlib import import_module
from pathlib import Path

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
