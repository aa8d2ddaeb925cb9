"""Light and colour of a picture: what metal mirrors, and colours on a screen.

Newton's camera gives the light that each surface scatters. A metal scatters none: it mirrors what is around it, here a
sky that brightens towards the horizon, a ground and a sun, with Schlick's approximation of Fresnel's reflectance
(Schlick 1994). Reflections of other bodies are left out.
"""

import numpy as np

SUN = (-0.4, 0.55, -0.73)
"""Direction of the sun's light."""
AMBIENT = ((0.5, 0.53, 0.58), (0.22, 0.21, 0.2))
"""Linear radiance from above and from below."""
_ZENITH, _HORIZON = np.array((0.42, 0.5, 0.62)), np.array((0.80, 0.83, 0.86))
_GROUND = np.array((0.16, 0.155, 0.15))
_HIGHLIGHT, _SHARPNESS = 4.0, 180.0
"""Radiance of the sun's reflection in a polished surface, and the exponent by which it fades (Phong 1975)."""


def shade(scattered: np.ndarray, normals: np.ndarray, rays: np.ndarray, shapes, albedo, metal, up) -> np.ndarray:
    """Return the linear radiance of each ray, shape [..., 3].

    Args:
        scattered: Radiance that surfaces would scatter if they were matt, shape [..., 3].
        normals: Normals of what the rays hit, shape [..., 3].
        rays: Directions, of length 1, shape [..., 3].
        shapes: Shape that each ray hits, -1 where it hits none, shape [...].
        albedo: Linear colour of each shape, shape [s, 3].
        metal: How metallic each shape is, shape [s].
        up: Direction from the ground to the sky, shape [3].
    """
    radiance = np.where((shapes < 0)[..., None], _around(np.maximum(rays @ up, 0.0)), scattered)
    polished = np.flatnonzero((shapes.ravel() >= 0) & (metal[shapes.ravel()] > 0.0))
    if len(polished):
        ray, normal = (values.reshape(-1, 3)[polished] for values in (rays, normals))
        shape, flat = shapes.ravel()[polished], radiance.reshape(-1, 3)
        facing = np.clip(-np.sum(ray * normal, axis=1, keepdims=True), 0.0, 1.0)
        mirrored = ray + 2.0 * facing * normal
        seen = _around(mirrored @ up)
        towards = np.clip(-mirrored @ (np.array(SUN) / np.linalg.norm(SUN)), 0.0, 1.0)[:, None]
        lit = scattered.reshape(-1, 3)[polished] / np.maximum(albedo[shape], 1e-3)  # shadows darken reflections, too
        seen = seen * np.clip(lit / np.array(AMBIENT[0]), 0.35, 1.0) + _HIGHLIGHT * towards**_SHARPNESS
        reflectance = albedo[shape] + (1.0 - albedo[shape]) * (1.0 - facing) ** 5
        part = metal[shape][:, None]
        flat[polished] = (1.0 - part) * flat[polished] + part * reflectance * seen
    return radiance


def _around(height: np.ndarray) -> np.ndarray:
    """Return what is seen in directions whose part upwards is ``height``, shape [...]."""
    height = height[..., None]
    sky = _HORIZON + (_ZENITH - _HORIZON) * np.sqrt(np.clip(height, 0.0, 1.0))
    ground = _HORIZON + (_GROUND - _HORIZON) * np.clip(-6.0 * height, 0.0, 1.0)
    return np.where(height >= 0.0, sky, ground)


def to_srgb(linear: np.ndarray) -> np.ndarray:
    """Return 8-bit sRGB of linear values (IEC 61966-2-1)."""
    value = np.clip(linear, 0.0, 1.0)
    curved = np.where(value <= 0.0031308, 12.92 * value, 1.055 * value ** (1.0 / 2.4) - 0.055)
    return np.round(255.0 * curved).astype(np.uint8)


def to_linear(srgb: np.ndarray) -> np.ndarray:
    """Return linear values of sRGB in 0 to 1 (IEC 61966-2-1)."""
    value = np.asarray(srgb, dtype=float)
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
