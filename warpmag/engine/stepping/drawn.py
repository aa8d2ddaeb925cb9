"""Meshes as they are drawn, where Newton lets them collide as simpler shapes (``physics:approximation``)."""

from dataclasses import dataclass, field
from typing import Any

import newton
import numpy as np

from warpmag.errors import InputError
from warpmag.shapes import lattice

_REPLACING = ("coacd", "vhacd", "convex_hull", "bounding_box", "bounding_sphere")
"""Newton's names of the approximations that fill a mesh up; the others simplify its surface."""

_SAME = 1e-4
"""Relative difference of volumes up to which a shape around a mesh is the mesh, in single precision."""


@dataclass
class DrawnMesh:
    """A mesh that other shapes stand for.

    Attributes:
        mesh: The mesh.
        scale: Its scale.
        frame: Its frame in that of its body.
        stand_ins: The shapes that collide for it.
    """

    mesh: newton.Mesh
    scale: tuple[float, float, float]
    frame: Any
    stand_ins: list[int] = field(default_factory=list)


class StageBuilder(newton.ModelBuilder):
    """A builder that keeps the meshes that an import replaces.

    Attributes:
        drawn: The meshes by the shapes that they were.
    """

    def __init__(self):
        """Begin an empty builder."""
        super().__init__()
        self.drawn: dict[int, DrawnMesh] = {}

    def approximate_meshes(self, method: Any = "convex_hull", shape_indices=None, *args, **options) -> set[int]:
        """Replace meshes as Newton does, and keep those that are lost."""
        meshes = {}
        if method in _REPLACING and shape_indices is not None:
            for shape in shape_indices:
                frame = self.shape_transform[shape]
                meshes[shape] = DrawnMesh(self.shape_source[shape], tuple(self.shape_scale[shape]), frame, [shape])
        before = self.shape_count
        replaced = super().approximate_meshes(method, shape_indices, *args, **options)
        for shape in replaced & meshes.keys():
            self.drawn[shape] = meshes[shape]
            label = f"{self.shape_label[shape]}_convex_"
            extra = [one for one in range(before, self.shape_count) if self.shape_label[one].startswith(label)]
            self.drawn[shape].stand_ins += [one for one in extra if self.shape_body[one] == self.shape_body[shape]]
        return replaced

    def as_drawn(self, shapes: list[int]) -> list[int]:
        """Return ``shapes`` with meshes, which do not collide, for those that stand for closed ones of other volume."""
        result = list(shapes)
        for shape in shapes:
            drawn = self.drawn.get(shape)
            if drawn is None or not self._fills_less(drawn):
                continue
            stands = [one for one in result if one not in drawn.stand_ins]
            result = [*stands, self._add(shape, drawn)]
        return result

    def _fills_less(self, drawn: DrawnMesh) -> bool:
        try:
            volume = _solid(drawn.mesh, drawn.scale).volume
        except InputError:  # ``warpmag.usd`` has warned of it
            return False
        if len(drawn.stand_ins) > 1:
            return True
        (shape,) = drawn.stand_ins
        kind, scale = self.shape_type[shape], np.asarray(self.shape_scale[shape], float)
        if kind == newton.GeoType.SPHERE:
            around = lattice.sphere(scale[0])
        elif kind == newton.GeoType.BOX:
            around = lattice.box(scale)
        else:
            around = _solid(self.shape_source[shape], scale)
        return abs(volume - around.volume) > _SAME * around.volume

    def _add(self, shape: int, drawn: DrawnMesh) -> int:
        unseen = newton.ModelBuilder.ShapeConfig(
            density=0.0, has_shape_collision=False, has_particle_collision=False, is_visible=False
        )
        return self.add_shape_mesh(
            self.shape_body[shape],
            xform=drawn.frame,
            mesh=drawn.mesh,
            scale=drawn.scale,
            cfg=unseen,
            label=f"{self.shape_label[shape]}_drawn",
        )


def _solid(mesh: newton.Mesh, scale) -> lattice.Solid:
    return lattice.mesh(np.asarray(mesh.vertices, float) * scale, np.asarray(mesh.indices).reshape(-1, 3))
