"""The bundled scenes of warpmag: USD stages, and the scripts that author them."""

from pathlib import Path

_SUFFIXES = (".usd", ".usda", ".usdc")


def bundled() -> dict[str, Path]:
    """Return the file of each bundled scene by its name."""
    return {path.stem: path for path in sorted(Path(__file__).parent.iterdir()) if path.suffix in _SUFFIXES}
