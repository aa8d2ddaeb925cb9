"""Newton's broad phase, by lists of neighbouring balls in place of a sort of all shapes."""

import newton
import numpy as np
import warp as wp

from warpmag.kernels.pairs.neighbors import carried_lists
from warpmag.kernels.rigid.broad_phase import allocate, launch_find_shape_pairs


class NeighborBroadPhase(newton.geometry.BroadPhaseSAP):
    """Finds the pairs of shapes that may touch; takes the place of the sweep of a ``CollisionPipeline``.

    See ``kernels.rigid.broad_phase`` for the method, and for the pairs of balls that it leaves out.
    """

    def __init__(self, model: newton.Model, farthest: float):
        """Plan the search; the sweep stands in where it would take too long.

        Args:
            model: The model.
            farthest: ``speculative_contact_gap_max`` of the pipeline [m].
        """
        colliding = (model.shape_flags.numpy() & newton.ShapeFlags.COLLIDE_SHAPES) != 0
        spheres = model.shape_type.numpy() == newton.GeoType.SPHERE
        sought = model.shape_scale.numpy()[:, 0] + model.shape_margin.numpy() + model.shape_gap.numpy()
        self._search = allocate(
            model.shape_world.numpy(),
            colliding,
            np.where(spheres, sought, np.nan),
            farthest=farthest,
            device=wp.get_device(model.device),
        )
        if self._search is None:
            super().__init__(model.shape_world, shape_flags=model.shape_flags, sort_type="auto", device=model.device)

    def carried(self) -> dict[str, wp.array]:
        """Return the arrays that one search hands on to the next one, by name."""
        if self._search is None:
            return {}
        lists = self._search.arrays.lists
        return carried_lists(lists) | {"packed": lists.packed}

    def launch(self, shape_lower, shape_upper, shape_gap, shape_collision_group, shape_world, shape_count,
               candidate_pair, candidate_pair_count, **options) -> None:  # fmt: skip
        """Find the pairs; arguments as those of Newton's sweep."""
        if self._search is None:
            super().launch(
                *(shape_lower, shape_upper, shape_gap, shape_collision_group, shape_world, shape_count),
                *(candidate_pair, candidate_pair_count),
                **options,
            )
            return
        a = self._search.arrays
        a.lower, a.upper, a.displacement = shape_lower, shape_upper, options.get("shape_displacement")
        a.group, a.world, a.body, a.body_flags = (
            *(shape_collision_group, shape_world),
            *(options["shape_body"], options["body_flags"]),
        )
        a.excluded, a.excluded_count = options["filter_pairs"], options["num_filter_pairs"] or 0
        a.fixed_pairs = int(options["include_static_kinematic_pairs"])
        a.pairs, a.pair_count = candidate_pair, candidate_pair_count
        launch_find_shape_pairs(self._search)
