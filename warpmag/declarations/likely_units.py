"""Warnings of values that were likely meant in another unit."""

from warpmag.errors import UnitWarning, warn_caller

_STRENGTHS = 1e3, 2e6
"""Magnetization of permanent magnets [A/m]: flexible ferrite has 1e5, NdFeB 1.2e6."""
_STRONGEST_REMANENCE = 3.0
"""Largest number that is more likely a remanence [T] than a magnetization [A/m]; NdFeB has up to 1.5 T."""
_LARGEST_BALL = 0.5
"""Smallest radius [m] of a magnetic ball that is likely in another unit."""


def warn_of_magnetization(magnetization: float) -> None:
    """Warn of a magnetization [A/m] that no permanent magnet has. Zero, a magnet that is off, causes no warning."""
    least, most = _STRENGTHS
    if magnetization == 0.0 or least <= magnetization <= most:
        return
    remanence = f"; for {magnetization:g} T give remanence={magnetization:g} and a direction"
    meant = remanence if magnetization <= _STRONGEST_REMANENCE else ""
    text = f"magnetization: {magnetization:g} A/m is not that of a permanent magnet ({least:g} to {most:g} A/m){meant}"
    warn_caller(text, UnitWarning)


def warn_of_radius(name: str, radius: float) -> None:
    """Warn of a magnetic ball of a very large radius [m]."""
    if radius >= _LARGEST_BALL:
        text = f"{name}: a magnetic ball of radius {radius:g} m; lengths are in meters, 5 mm are 0.005"
        warn_caller(text, UnitWarning)
