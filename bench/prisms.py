"""Prisms as meshes of a Newton model."""

import newton
import numpy as np

from warpmag.shapes.polygons import triangulate


def prism(outline, half_length: float) -> newton.Mesh:
    """Return a prism along y from the corners (x, z) of its outline, counterclockwise in this plane, shape [n, 2]."""
    outline = np.asarray(outline, float)
    n, order = len(outline), np.arange(len(outline))
    ends = [np.insert(outline, 1, y, axis=1) for y in (-half_length, half_length)]
    sides = np.stack([np.roll(order, -1), order, order + n, np.roll(order, -1) + n], axis=1)
    corners = np.concatenate([order, order[::-1] + n, sides.ravel()])
    points = np.concatenate(ends)
    triangles = corners[triangulate(points, np.array([n, n, *[4] * n]), corners)]
    return newton.Mesh(points, triangles.flatten())
