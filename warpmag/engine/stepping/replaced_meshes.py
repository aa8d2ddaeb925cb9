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
"""Relative difference up to which a collider and the mesh have equal volumes, in single precision."""


@dataclass
class ReplacedMesh:
    """A mesh that other shapes replace.

    Attributes:
        mesh: The mesh.
        scale: Scale of the mesh.
        frame: Pose of the mesh in the frame of its body.
        colliders: Shapes that collide in place of the mesh.
    """

    mesh: newton.Mesh
    scale: tuple[float, float, float]
    frame: Any
    colliders: list[int] = field(default_factory=list)


class StageBuilder(newton.ModelBuilder):
    """A builder that keeps the meshes that an import replaces.

    Attributes:
        replaced: The replaced meshes by shape.
    """

    def __init__(self):
        """Make an empty builder."""
        super().__init__()
        self.replaced: dict[int, ReplacedMesh] = {}

    def approximate_meshes(self, method: Any = "convex_hull", shape_indices=None, *args, **options) -> set[int]:
        """Replace meshes as Newton does, and keep the originals."""
        meshes = {}
        if method in _REPLACING and shape_indices is not None:
            for shape in shape_indices:
                frame = self.shape_transform[shape]
                meshes[shape] = ReplacedMesh(self.shape_source[shape], tuple(self.shape_scale[shape]), frame, [shape])
        before = self.shape_count
        new_colliders = super().approximate_meshes(method, shape_indices, *args, **options)
        for shape in new_colliders & meshes.keys():
            self.replaced[shape] = meshes[shape]
            label = f"{self.shape_label[shape]}_convex_"
            parts = [part for part in range(before, self.shape_count) if self.shape_label[part].startswith(label)]
            self.replaced[shape].colliders += [
                part for part in parts if self.shape_body[part] == self.shape_body[shape]
            ]
        return new_colliders

    def with_original_meshes(self, shapes: list[int]) -> list[int]:
        """Return ``shapes`` with the original meshes in place of colliders of another volume.

        Only closed meshes count. They are added to the builder without collision.
        """
        result = list(shapes)
        for shape in shapes:
            original = self.replaced.get(shape)
            if original is None or not self._changes_volume(original):
                continue
            kept = [other for other in result if other not in original.colliders]
            result = [*kept, self._add(shape, original)]
        return result

    def _changes_volume(self, original: ReplacedMesh) -> bool:
        try:
            volume = _solid(original.mesh, original.scale).volume
        except InputError:  # an open mesh; ``warpmag.usd`` warns about it
            return False
        if len(original.colliders) > 1:
            return True
        (shape,) = original.colliders
        kind, scale = self.shape_type[shape], np.asarray(self.shape_scale[shape], float)
        if kind == newton.GeoType.SPHERE:
            collider = lattice.sphere(scale[0])
        elif kind == newton.GeoType.BOX:
            collider = lattice.box(scale)
        else:
            collider = _solid(self.shape_source[shape], scale)
        return abs(volume - collider.volume) > _SAME_VOLUME * collider.volume

    def _add(self, shape: int, original: ReplacedMesh) -> int:
        invisible = newton.ModelBuilder.ShapeConfig(
            density=0.0, has_shape_collision=False, has_particle_collision=False, is_visible=False
        )
        return self.add_shape_mesh(
            self.shape_body[shape],
            xform=original.frame,
            mesh=original.mesh,
            scale=original.scale,
            cfg=invisible,
            label=f"{self.shape_label[shape]}_drawn",
        )


def _solid(mesh: newton.Mesh, scale) -> lattice.Solid:
    return lattice.mesh(np.asarray(mesh.vertices, float) * scale, np.asarray(mesh.indices).reshape(-1, 3))
