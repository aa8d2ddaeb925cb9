"""Masses of bodies of named materials on a Newton builder."""

import math
from collections import defaultdict

import newton

_SAME = 1e-5
"""Relative difference of masses that counts as rounding of float32."""


def give_density(builder: newton.ModelBuilder, shapes: list[int], density: float) -> None:
    """Give bodies the density [kg/m³] of the material of their magnetic shapes, where the user gave none.

    That is where the body's mass is the one of these shapes at Newton's default density. Mass and inertia are scaled,
    and the center of mass stays. The builder does not keep densities, so Newton's default counts as none.
    """
    default = newton.ModelBuilder.ShapeConfig().density
    masses, known = defaultdict(float), {}
    for shape in shapes:
        source = builder.shape_source[shape]
        key = builder.shape_type[shape], tuple(builder.shape_scale[shape]), id(source)
        key += builder.shape_is_solid[shape], builder.shape_margin[shape]
        if key not in known:
            kind, scale, _, solid, margin = key
            known[key], _, _ = newton.geometry.compute_inertia_shape(kind, scale, source, default, solid, margin)
        masses[builder.shape_body[shape]] += known[key]
    for body, mass in masses.items():
        is_default = body >= 0 and math.isclose(builder.body_mass[body], mass, rel_tol=_SAME)
        if is_default and mass > 0.0 and not builder.body_lock_inertia[body]:
            _scale_mass(builder, body, density / default)


def _scale_mass(builder: newton.ModelBuilder, body: int, factor: float) -> None:
    """Multiply the mass and the inertia of a body."""
    multiples = {"mass": factor, "inv_mass": 1.0 / factor, "inertia": factor, "inv_inertia": 1.0 / factor}
    for name, multiple in multiples.items():
        values = getattr(builder, f"body_{name}")
        values[body] = values[body] * multiple
