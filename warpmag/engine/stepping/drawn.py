"""Keeps the meshes of a stage that Newton replaces by simpler colliders (``physics:approximation``)."""

from dataclasses import dataclass, field
from typing import Any

import newton
import numpy as np

from warpmag.errors import InputError
from warpmag.shapes import lattice

_REPLACING = ("coacd", "vhacd", "convex_hull", "bounding_box", "bounding_sphere")
"""Newton's names of approximations that change the volume of a mesh; the others simplify its surface."""

_SAME_VOLUME = 1e-4
"""Relative difference of volumes up to which a collider is taken for the mesh, for single precision."""


@dataclass
class DrawnMesh:
    """A mesh that was replaced by other shapes.

    Attributes:
        mesh: The mesh.
        scale: Its scale.
        frame: Pose of the mesh in the frame of its body.
        stand_ins: Shapes that collide in its place.
    """

    mesh: newton.Mesh
    scale: tuple[float, float, float]
    frame: Any
    stand_ins: list[int] = field(default_factory=list)


class StageBuilder(newton.ModelBuilder):
    """A builder that keeps meshes that an import replaces.

    Attributes:
        drawn: The replaced meshes by shape.
    """

    def __init__(self):
        """Make an empty builder."""
        super().__init__()
        self.drawn: dict[int, DrawnMesh] = {}

    def approximate_meshes(self, method: Any = "convex_hull", shape_indices=None, *args, **options) -> set[int]:
        """Replace meshes as Newton does, and keep the originals."""
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
            parts = [part for part in range(before, self.shape_count) if self.shape_label[part].startswith(label)]
            self.drawn[shape].stand_ins += [part for part in parts if self.shape_body[part] == self.shape_body[shape]]
        return replaced

    def as_drawn(self, shapes: list[int]) -> list[int]:
        """Return ``shapes`` with original closed meshes, added without collision, for colliders of another volume."""
        result = list(shapes)
        for shape in shapes:
            drawn = self.drawn.get(shape)
            if drawn is None or not self._changes_volume(drawn):
                continue
            kept = [other for other in result if other not in drawn.stand_ins]
            result = [*kept, self._add(shape, drawn)]
        return result

    def _changes_volume(self, drawn: DrawnMesh) -> bool:
        try:
            volume = _solid(drawn.mesh, drawn.scale).volume
        except InputError:  # an open mesh; ``warpmag.usd`` warns about it
            return False
        if len(drawn.stand_ins) > 1:
            return True
        (shape,) = drawn.stand_ins
        kind, scale = self.shape_type[shape], np.asarray(self.shape_scale[shape], float)
        if kind == newton.GeoType.SPHERE:
            collider = lattice.sphere(scale[0])
        elif kind == newton.GeoType.BOX:
            collider = lattice.box(scale)
        else:
            collider = _solid(self.shape_source[shape], scale)
        return abs(volume - collider.volume) > _SAME_VOLUME * collider.volume

    def _add(self, shape: int, drawn: DrawnMesh) -> int:
        invisible = newton.ModelBuilder.ShapeConfig(
            density=0.0, has_shape_collision=False, has_particle_collision=False, is_visible=False
        )
        return self.add_shape_mesh(
            self.shape_body[shape],
            xform=drawn.frame,
            mesh=drawn.mesh,
            scale=drawn.scale,
            cfg=invisible,
            label=f"{self.shape_label[shape]}_drawn",
        )


def _solid(mesh: newton.Mesh, scale) -> lattice.Solid:
    return lattice.mesh(np.asarray(mesh.vertices, float) * scale, np.asarray(mesh.indices).reshape(-1, 3))
