"""Energy of moments in equilibrium.

The energy of the magnetization curves and of the interactions is

    E = μ0 Σ_i [V Φ(M) − ½ m·(H − H0) − m·H0]  −  μ0 Σ_p [½ m·H_p + m·H_e],

over inducible moments i in the applied field H0, and permanent moments p in each other's field H_p and the external
field H_e. Φ' = f⁻¹, so E is minimal in equilibrium. In equilibrium V Φ = m·H − V Ψ(H), with the co-energy Ψ' = f, and

    E = μ0 Σ_i [½ m·(H − H0) − V Ψ(H)]  −  μ0 Σ_p [½ m·H_p + m·H_e].

Since E is minimal, its gradient with respect to positions is minus Kelvin's force (Kim and Han 2022, Eqs. 13, 14).
"""

from functools import cache

import warp as wp

from warpmag.kernels.material.curves import curve_area
from warpmag.kernels.pairs.packing import ball_volume
from warpmag.kernels.pairs.wrench import MU0
from warpmag.kernels.shared.native import native_options


@cache
def _energy_kernel(dtype):
    vec3 = wp.types.vector(3, dtype)

    @wp.func
    def product(a: vec3, b: vec3):
        return wp.dot(wp.vec3d(a), wp.vec3d(b))

    @wp.kernel(module="unique", enable_backward=False, module_options=native_options("material/curves.h", dtype=dtype))
    def energy(
        inducible: wp.array[int],
        radii: wp.array[dtype],
        moments: wp.array[vec3],
        saturation: wp.array[dtype],
        slope: wp.array[dtype],
        curve: wp.array[int],
        tables: wp.array2d[dtype],
        h: wp.array[vec3],
        h0: wp.array[vec3],
        h_permanent: wp.array[vec3],
        external_field: wp.array[vec3],
        energy_out: wp.array[wp.float64],
    ):
        i = wp.tid()
        half = wp.float64(0.5)
        if inducible[i] != 0:
            area = curve_area(slope[i] * wp.length(h[i]) / saturation[i], slope[i], curve[i], tables)
            unit = wp.float64(saturation[i]) * wp.float64(saturation[i]) / wp.float64(slope[i])
            volume = wp.float64(ball_volume(radii[i]))
            e = half * product(moments[i], h[i] - h0[i]) - volume * unit * area
        else:
            e = -half * product(moments[i], h_permanent[i]) - product(moments[i], external_field[i])
        energy_out[i] = wp.float64(wp.static(MU0)) * e

    return energy


def launch_energy(radii, moments, material, h, h0, h_permanent, external_field, energies):
    """Write each moment's share of the energy [J], float64, shape [n].

    ``h`` and ``h0`` are the total and the applied field at inducible moments [A/m]. ``h_permanent`` is the field of
    other permanent moments at permanent moments.
    """
    inputs = [material.inducible, radii, moments, material.saturation, material.slope, material.curve, material.tables]
    inputs += [h, h0, h_permanent, external_field]
    wp.launch(_energy_kernel(radii.dtype), len(radii), inputs=inputs, outputs=[energies], device=radii.device)
