"""Magnets for the Newton physics engine.

Fields of magnetic moments, induction to magnetic equilibrium and magnetic forces, as NVIDIA Warp kernels for CPU and
CUDA, after Kim and Han 2022, "Fast Stabilization of Inducible Magnet Simulation". SI units everywhere.

Importing this package imports neither Warp nor Newton nor USD; the names below load what they need when first used.
"""

import ast
from importlib import import_module
from pathlib import Path

from warpmag.garbage import collection_paused

__version__ = "0.1.0"

_FOLDER = Path(__file__).resolve().parent
if not (_FOLDER / "kernels").exists():  # a checkout, where kernels and scenes_usd are beside this folder
    __path__.append(str(_FOLDER.parent))


def _homes() -> dict[str, str]:
    """Module of each public name, by the stub beside this file, which type checkers read."""
    stub = ast.parse((_FOLDER / "__init__.pyi").read_text(encoding="utf-8"))
    found = [
        (one.module or "", alias.name) for one in stub.body if isinstance(one, ast.ImportFrom) for alias in one.names
    ]
    return {name: module for module, name in found}


_HOMES = _homes()
__all__ = sorted(_HOMES)


def __getattr__(name):
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    with collection_paused():  # Newton and Warp make very many objects
        return getattr(import_module(_HOMES[name]), name)


def __dir__():
    return [*__all__, "__version__"]
