"""Keeps the meshes of a stage that Newton replaces by simpler colliders (``physics:approximation``)."""

from dataclasses import dataclass
from typing import Any

import newton
import numpy as np

from warpmag.engine.magnets.sampling import solid_of
from warpmag.engine.magnets.selection import MESH_SUFFIX
from warpmag.errors import InputError

_REPLACING = ("coacd", "vhacd", "convex_hull", "bounding_box", "bounding_sphere")
"""Newton's names of approximations that change the volume of a mesh; the others simplify its surface."""
_SAME_VOLUME = 1e-4
"""Relative difference up to which a collider and the mesh have equal volumes, in single precision."""


@dataclass
class ReplacedMesh:
    """A mesh that other shapes replace."""

    mesh: newton.Mesh
    scale: tuple[float, float, float]
    frame: Any  # pose of the mesh in the frame of its body
    colliders: list[int]  # shapes that collide in place of the mesh


class StageBuilder(newton.ModelBuilder):
    """A builder that keeps the meshes that an import replaces, in ``replaced`` by shape."""

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
            label, body = f"{self.shape_label[shape]}_convex_", self.shape_body[shape]
            parts = [part for part in range(before, self.shape_count) if self.shape_label[part].startswith(label)]
            self.replaced[shape].colliders += [part for part in parts if self.shape_body[part] == body]
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
            volume = solid_of(newton.GeoType.MESH, original.scale, original.mesh).volume
        except InputError:  # an open mesh; ``warpmag.usd`` warns about it
            return False
        if len(original.colliders) > 1:
            return True
        (shape,) = original.colliders
        scale = np.asarray(self.shape_scale[shape], float)
        collider = solid_of(self.shape_type[shape], scale, self.shape_source[shape])
        return abs(volume - collider.volume) > _SAME_VOLUME * collider.volume

    def _add(self, shape: int, original: ReplacedMesh) -> int:
        """Add a replaced mesh without mass and collision; return its shape."""
        config = newton.ModelBuilder.ShapeConfig(
            density=0.0, has_shape_collision=False, has_particle_collision=False, is_visible=False
        )
        pose, label = {"xform": original.frame, "scale": original.scale}, f"{self.shape_label[shape]}{MESH_SUFFIX}"
        return self.add_shape_mesh(self.shape_body[shape], mesh=original.mesh, cfg=config, label=label, **pose)
