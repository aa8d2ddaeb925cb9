"""Bundled scenes of warpmag: USD stages, and the scripts that author them."""

import importlib
import inspect
from pathlib import Path

from warpmag.errors import InputError

_SUFFIXES = (".usd", ".usda", ".usdc")
GENERATED_SCENES = ("million",)
"""Scenes too large to be bundled: they are authored on demand."""


def bundled() -> dict[str, Path]:
    """Return the file of each bundled scene by its name."""
    return {path.stem: path for path in sorted(Path(__file__).parent.iterdir()) if path.suffix in _SUFFIXES}


def summary(name: str) -> str:
    """Return a description of a scene of :data:`GENERATED_SCENES` in one line."""
    return (inspect.getdoc(_module(name)) or "").partition("\n")[0].rstrip(".")


def make(name: str, folder: Path, balls: int | None = None) -> Path:
    """Author a scene with a chosen number of balls.

    Args:
        name: A bundled scene, or one of :data:`GENERATED_SCENES`.
        folder: Folder of the file.
        balls: The number of balls; None means the scene's own.

    Returns:
        The file; its name contains the number.

    Raises:
        InputError: The scene has a fixed number of balls, the number is out of range, or the file cannot be written.
    """
    module = _module(name)
    parameter = inspect.signature(module.author).parameters.get("balls")
    if parameter is None:
        raise InputError(f"balls: the scene {name} has a fixed number of balls")
    count = parameter.default if balls is None else balls
    path = folder / f"{name}_{count}.usdc"
    try:
        module.author(path, balls=count)
    except MemoryError:
        raise InputError(f"balls: not enough memory for {count}") from None
    return path


def _module(name: str):
    return importlib.import_module(f"warpmag.scenes_usd.{name}")
