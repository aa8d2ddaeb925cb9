"""Broad phase with neighbor lists of balls, in place of Newton's sort of all shapes; also writes their contacts."""

import newton
import numpy as np
import warp as wp

from warpmag.kernels.contacts.broad_phase import PARTNERS, allocate, launch_find_shape_pairs
from warpmag.kernels.pairs.neighbors import persistent_lists
from warpmag.kernels.rigid.newton_views import view_contacts

_TYPES = (newton.GeoType.PLANE, newton.GeoType.SPHERE, newton.GeoType.CAPSULE, newton.GeoType.BOX)
"""Newton's types of shapes, in the order of ``PARTNERS``."""


def are_colliding(model: newton.Model) -> np.ndarray:
    """Return True for each shape that collides with other shapes, shape [shape_count]."""
    return (model.shape_flags.numpy() & newton.ShapeFlags.COLLIDE_SHAPES) != 0


class NeighborBroadPhase(newton.geometry.BroadPhaseSAP):
    """Broad phase of a ``CollisionPipeline``: lists the pairs of shapes that may touch.

    After :meth:`write_contacts` it also writes the contacts of balls, and lists no pairs for them. See
    ``kernels.contacts.broad_phase`` for the method and for the pairs of balls that are never listed. Unless
    ``leaves_pairs``, the narrow phase of the pipeline has no pairs to process.
    """

    def __init__(self, model: newton.Model, farthest: float):
        """Allocate the search, or set up Newton's sweep where the sweep is faster.

        ``farthest`` is ``speculative_contact_gap_max`` of the pipeline [m].
        """
        spheres = model.shape_type.numpy() == newton.GeoType.SPHERE
        reach = model.shape_scale.numpy()[:, 0] + model.shape_margin.numpy() + model.shape_gap.numpy()
        radii, device = np.where(spheres, reach, np.nan), wp.get_device(model.device)
        worlds, bodies = model.shape_world.numpy(), model.shape_body.numpy()
        self._search = allocate(worlds, bodies, are_colliding(model), radii, farthest=farthest, device=device)
        self._model = model
        self.leaves_pairs = True
        if self._search is None:
            super().__init__(model.shape_world, shape_flags=model.shape_flags, sort_type="auto", device=model.device)
            return
        arrays = self._search.arrays
        arrays.kind = wp.full(model.shape_count, len(PARTNERS), dtype=int, device=model.device)
        arrays.scale, arrays.margin, arrays.gap = model.shape_scale, model.shape_margin, model.shape_gap

    def write_contacts(self, pipeline: newton.CollisionPipeline, contacts: newton.Contacts) -> None:
        """Also write the contacts of balls to the buffer of the pipeline in every later :meth:`launch`."""
        if self._search is None:
            return
        types = self._model.shape_type.numpy()
        kinds = np.select([types == kind for kind in _TYPES], np.arange(len(PARTNERS)), len(PARTNERS))
        arrays = self._search.arrays
        arrays.kind.assign(kinds.astype(np.int32))
        self.leaves_pairs = self._may_leave_pairs(kinds)
        arrays.placement, arrays.frame = self._model.shape_transform, pipeline.geom_transform
        arrays.contacts = view_contacts(self._model, contacts)

    def _may_leave_pairs(self, kinds: np.ndarray) -> bool:
        """Return True if a moving shape is not a ball, or if Newton has to find contacts of balls with some shape."""
        model, kinematic = self._model, newton.BodyFlags.KINEMATIC
        flags = np.append(model.body_flags.numpy(), kinematic)  # the last entry is for shapes without a body, -1
        body: np.ndarray = model.shape_body.numpy()
        moving = (flags[body] & kinematic) == 0
        others = are_colliding(model) & (kinds != PARTNERS.index("ball"))
        return bool((others & (moving | (kinds == len(PARTNERS)))).any())

    def set_motion(self, state: newton.State, dt: float) -> None:
        """Set the velocities, from ``state``, and the time ``dt`` [s] that the search looks ahead."""
        if self._search is not None:
            self._search.arrays.body_qd, self._search.arrays.dt = state.body_qd, dt

    def persistent_arrays(self) -> dict[str, wp.array]:
        """Return the arrays that the next search depends on, by name."""
        if self._search is None:
            return {}
        lists = self._search.arrays.lists
        return persistent_lists(lists) | {"packed": lists.packed}

    def request_search(self) -> None:
        """Rebuild the neighbor lists in the next search."""
        if self._search is not None:
            self._search.arrays.lists.moved.fill_(1)

    def launch(self, shape_lower, shape_upper, shape_gap, shape_collision_group, shape_world, shape_count,
               candidate_pair, candidate_pair_count, **options) -> None:  # fmt: skip
        """List the pairs; takes the arguments of Newton's sweep."""
        if self._search is None:
            super().launch(
                *(shape_lower, shape_upper, shape_gap, shape_collision_group, shape_world, shape_count),
                *(candidate_pair, candidate_pair_count),
                **options,
            )
            return
        arrays = self._search.arrays
        arrays.lower, arrays.upper, arrays.displacement = shape_lower, shape_upper, options.get("shape_displacement")
        arrays.group, arrays.world = shape_collision_group, shape_world
        arrays.body, arrays.body_flags = options["shape_body"], options["body_flags"]
        arrays.excluded, arrays.excluded_count = options["filter_pairs"], options["num_filter_pairs"] or 0
        arrays.fixed_pairs = int(options["include_static_kinematic_pairs"])
        arrays.pairs, arrays.pair_count = candidate_pair, candidate_pair_count
        launch_find_shape_pairs(self._search)
