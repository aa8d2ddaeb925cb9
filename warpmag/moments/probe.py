"""Field of a system's moments at points, in buffers allocated once."""

from itertools import pairwise

import numpy as np
import numpy.typing as npt
import warp as wp

from warpmag.declarations.checks import check_flag, check_whole, short_repr
from warpmag.errors import InputError
from warpmag.kernels.applied.fields import AppliedField
from warpmag.kernels.pairs.evaluate import PairEvaluation
from warpmag.kernels.pairs.packing import PackedMoments
from warpmag.kernels.pairs.pair_law import Quantity
from warpmag.kernels.pairs.point_fields import launch_field_of_worlds, launch_flux_density, launch_store_gradients
from warpmag.kernels.pairs.wrench import MU0
from warpmag.moments.arrays import check_warp_array, host_array, shape_message, vec3_type
from warpmag.moments.system import MomentSystem

_NO_BODY = -2
"""Body label of points, different from the labels of moments and of the padding of packed rows."""


class FieldProbe:
    """Field and flux density of a system's moments at points, inside and outside of bodies.

    :meth:`measure` only launches kernels, so that a graph can capture it.

    Args:
        system: The moments.
        count: Number of points p.
        worlds: World of each point, shape [p]; None means the first world. Points of one world should be adjacent,
            because each run of adjacent points is summed separately.
        gradients: True to compute gradients, which takes three more sums over pairs.

    Raises:
        InputError: ``worlds`` has a wrong shape, or holds a world that the system lacks. Or an argument has a
            wrong type.

    Attributes:
        points: The points [m], shape [p]; written by the caller before :meth:`measure`.
        h: Field H [A/m], shape [p]: the sum of the external field, the fields of coils, field maps and nearby
            permanent bodies (``kernels.applied``), and the field of all moments (Kim and Han 2022, Eq. 1). A moment is
            a uniformly magnetized ball inside its radius.
        b: Flux density B = μ0 (H + M) [T], shape [p].
        gradient: Gradient of :attr:`h` [A/m²], matrices with rows ∇H_x, ∇H_y, ∇H_z, shape [p]. The uniform external
            field has no part in it. None without ``gradients``.
    """

    def __init__(
        self,
        system: MomentSystem,
        count: int,
        *,
        worlds: npt.ArrayLike | None = None,
        gradients: bool = False,
    ):
        """Allocate all buffers."""
        self._system = system
        if not isinstance(system, MomentSystem):
            raise InputError(f"system: must be a MomentSystem, got {short_repr(system)}")
        check_flag("gradients", gradients)
        ranges = system.world_ranges
        check_whole("count", count)
        if not 0 <= count < 2**31:
            raise InputError(f"count: must be at least 0 and below 2³¹, got {short_repr(count)}")
        count = int(count)  # Warp takes no whole numbers of NumPy
        numbers = host_array("worlds", np.zeros(count) if worlds is None else worlds)
        if numbers.shape != (count,):
            raise InputError(shape_message("worlds", f"[{count}]", numbers))
        worlds = numbers.astype(int)
        if (worlds != numbers).any():
            raise InputError("worlds: must be whole numbers")
        if (worlds < 0).any() or (worlds >= len(ranges)).any():
            raise InputError(f"worlds: must be 0 to {len(ranges) - 1}")
        device, dtype = system.device, system.dtype
        vec3 = vec3_type(dtype)
        self.points, self.h, self.b, self._base = (wp.zeros(count, dtype=vec3, device=device) for _ in range(4))
        self._first = wp.array([ranges[world][0] for world in worlds], dtype=wp.int32, device=device)
        radii = wp.zeros(count, dtype=dtype, device=device)
        self._targets = PackedMoments(radii, largest_radius=0.0, labels=np.full(count, _NO_BODY), groups=worlds)
        runs = np.flatnonzero(np.diff(worlds, prepend=-1, append=-1))
        segments = [(begin, end, *ranges[worlds[begin]][::2]) for begin, end in pairwise(runs)]
        # packed separately, because a search from the points would overwrite the system's neighbor lists
        self._moments = moments = PackedMoments(
            system.radii, largest_radius=float(system.radii.numpy().max(initial=0.0)), groups=system.worlds
        )
        base, self._source_field = self._base, None
        if system.sources is not None:
            self._source_field = AppliedField(system.sources, self._targets, worlds, self._base, points=True)
            base = self._source_field.field
        self._field = PairEvaluation(Quantity.FIELD, segments, self._targets, moments, base, self.h)
        self._zeros = wp.zeros(count, dtype=vec3, device=device)
        self.gradient = None
        self._gradients: list[PairEvaluation] = []
        if gradients:
            self.gradient = wp.zeros(count, dtype=wp.types.matrix((3, 3), dtype), device=device)
            self._rows = [wp.zeros(count, dtype=vec3, device=device) for _ in range(3)]
            self._gradients = [self._derivative(axis, segments) for axis in range(3)]

    def _derivative(self, axis: int, segments) -> PairEvaluation:
        """Return the derivative of H along an axis: the force μ0 (e·∇)H on a moment e of 1/μ0 along the axis."""
        count, device = self._targets.count, self._system.device
        unit = np.zeros((3, count))
        unit[axis] = 1.0 / MU0
        return PairEvaluation(
            Quantity.FORCE, segments, self._targets, self._moments, self._base, self._rows[axis],
            effective=wp.array(unit, dtype=self._system.dtype, device=device),
            with_torque=wp.zeros(count, dtype=wp.int32, device=device), torques=self._zeros,
        )  # fmt: skip

    def measure(self) -> None:
        """Launch the computation of the fields of the last solve's moments at :attr:`points`."""
        system, targets = self._system, self._targets
        check_warp_array("points", self.points, vec3_type(system.dtype), system.device, (targets.count,))
        if targets.count == 0:
            return
        if system.refresh is not None:
            system.refresh()
        targets.pack(self.points, self._zeros)
        self._moments.pack(system.positions, system.moments)
        targets.find_overlaps(self._moments)
        launch_field_of_worlds(system.external_field, self._first, self._base)
        if self._source_field is not None:
            system.sources.packed.pack(system.positions, system.moments, resting=True)
            self._source_field.launch()
        self._field.launch()
        launch_flux_density(self.points, targets, self._moments, self.h, self.b)
        for evaluation in self._gradients:
            evaluation.launch()
        if self._gradients:
            launch_store_gradients(self._rows, self.gradient)
        if self._source_field is not None:
            self._source_field.add_to_probe(self.b, self.gradient)
