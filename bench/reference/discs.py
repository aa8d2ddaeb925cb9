"""Force between two coaxial cylinder magnets, exactly: D. Vokoun et al., J. Magn. Magn. Mater. 321 (2009) 3758.

Both are magnetized along their axis, so that only their ends are charged. A charged disc has the spectrum
2πR J1(kR)/k, and pairs of ends add up to

    F = −π μ0 M1 M2 R² ∫ J1(q)²/q · (1 − exp(−q h1/R)) (1 − exp(−q h2/R)) exp(−q g/R) dq

Run as ``python -m bench.reference.discs``: the integral, beside it magpylib's force with 4,000 and 32,000 cells.
"""

import math

import numpy as np
from scipy.integrate import quad
from scipy.special import j1

MU0 = 4e-7 * math.pi
"""Magnetic constant [T·m/A]."""


def force(radius: float, height1: float, height2: float, gap: float, magnetization1: float, magnetization2: float):
    """Force [N] along the axis on the upper of two cylinders of one ``radius`` [m], ``gap`` [m] apart.

    Args:
        radius: Of both [m].
        height1, height2: Of the lower and of the upper one [m].
        gap: Between them [m], zero in contact.
        magnetization1, magnetization2: Along the axis [A/m].
    """

    def spectrum(q):
        ends = math.expm1(-q * height1 / radius) * math.expm1(-q * height2 / radius)
        return j1(q) ** 2 / q * ends * math.exp(-q * gap / radius)

    last = 2000.0  # beyond it J1² is 1/(πq) in the mean, and only contact leaves anything
    pieces = [quad(spectrum, a, b, limit=400)[0] for a, b in zip((0.0, 20.0, 200.0), (20.0, 200.0, last), strict=True)]
    tail = math.exp(-last * gap / radius) / (math.pi * last) if gap == 0.0 else 0.0
    return -math.pi * MU0 * magnetization1 * magnetization2 * radius**2 * (sum(pieces) + tail)


def main() -> None:
    """Print the force of two discs of 10 mm by 5 mm, and magpylib's."""
    import magpylib  # noqa: PLC0415 - only the comparison needs it

    radius, height, strength = 0.005, 0.005, 1.05e6
    for gap in (0.0, 1e-4, 5e-4, 2e-3):
        discs = [
            magpylib.magnet.Cylinder(
                dimension=(2.0 * radius, height), magnetization=(0.0, 0.0, strength), position=(0.0, 0.0, z)
            )
            for z in (0.0, height + gap)
        ]
        meshed = [magpylib.getFT(*discs, meshing=cells, eps=1e-7)[0][2] for cells in (4000, 32000)] if gap else []
        print(f"gap {1e3 * gap} mm", force(radius, height, height, gap, strength, strength), np.round(meshed, 4))


if __name__ == "__main__":
    main()
