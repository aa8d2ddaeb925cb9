"""World, body and material of each moment of a system."""

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import warp as wp

from warpmag.declarations.checks import check_count, check_token, check_whole
from warpmag.declarations.curves import MagnetizationCurve
from warpmag.declarations.magnets import LINEAR_CURVE
from warpmag.errors import InputError
from warpmag.kernels.material.curves import CURVE_IDS, FIRST_TABLE, LINEAR, MIXED, CurveParameters, curve_tables
from warpmag.kernels.shared.copies import put_copies, repeat_rows
from warpmag.moments.arrays import check_bodies, host_positive, host_radii, host_scalars, shape_message

_LARGE_BODY = 16
"""Fewest moments of a body for which sums omit its forces on itself. Sums over smaller bodies are faster with them."""


@dataclass(frozen=True)
class MomentLayout:
    """Geometry, world and body of each moment: NumPy arrays of shape [n].

    A system may hold copies of these worlds, one after the other.
    """

    radii: np.ndarray  # radius of the moment's ball [m]
    worlds: np.ndarray
    permanent: np.ndarray
    bodies: np.ndarray
    movable: np.ndarray  # True if the force on the moment is computed
    single: np.ndarray  # True if the body has no other moment
    cells: np.ndarray  # True for a cell of a body with demagnetizing tensors
    aligned: np.ndarray  # True for an inducible single ball, parallel to the field, so that its torque is 0
    copies: int = 1  # number of copies in the system
    body_step: int = 0  # difference between the number of a body and that in the copy before

    @property
    def count(self) -> int:
        """Number of moments of all copies."""
        return self.copies * len(self.radii)

    @property
    def world_count(self) -> int:
        """Number of worlds of a copy."""
        return int(self.worlds.max(initial=-1)) + 1

    def whole(self) -> "MomentLayout":
        """Return the layout of all copies."""
        if self.copies == 1:
            return self
        steps = {"worlds": self.world_count, "bodies": self.body_step}
        arrays = {name: values for name, values in vars(self).items() if isinstance(values, np.ndarray)}
        return MomentLayout(
            **{name: repeat_rows(values, self.copies, steps.get(name, 0)) for name, values in arrays.items()}
        )

    def worlds_of(self, moments: np.ndarray) -> np.ndarray:
        """Return the worlds of moments of all copies, by their indices."""
        copy, moment = np.divmod(moments, max(len(self.radii), 1))
        return self.worlds[moment] + self.world_count * copy

    @property
    def balls(self) -> np.ndarray:
        """True for the aligned moments of positive radius, shape [n]."""
        return self.aligned & (self.radii > 0.0)

    @property
    def single_balls(self) -> np.ndarray:
        """True for moments of positive radius that are alone in their body and no cell, shape [n]."""
        return self.single & ~self.cells & (self.radii > 0.0)

    def ranges(self) -> list[tuple[int, int, int]]:
        """Return (first moment, first permanent moment, end) of each world."""
        edges = self._edges()
        permanent = np.concatenate([[0], np.cumsum(self.permanent)])[edges]
        return _rows(edges[:-1], edges[1:] - np.diff(permanent), edges[1:])

    def runs(self, selected: np.ndarray) -> list[tuple[int, int, int, int]]:
        """Return (first, end, first of its world, end of its world) of each run of selected moments within a world."""
        edges = self._edges()
        continues = np.ones(len(selected) + 1, bool)  # False where a world begins
        continues[edges] = False
        padded = np.concatenate([[False], selected, [False]])
        first = np.flatnonzero(selected & ~(padded[:-2] & continues[:-1]))
        last = np.flatnonzero(selected & ~(padded[2:] & continues[1:])) + 1
        world = self.worlds[first]
        return _rows(first, last, edges[world], edges[world + 1])

    def wrench_runs(self, selected: np.ndarray) -> list[tuple[int, int, int, int]]:
        """Return :meth:`runs` as (first, end, first source, end of sources), without pairs that exert no force.

        A large body at the start or the end of its world's moments, as lone bodies of cells are, leaves out its own
        moments.
        """
        runs, rows = self.runs(selected), []
        begins, ends = np.reshape(runs, (-1, 4)).T[2:].astype(int)
        edges = np.concatenate([[0], np.flatnonzero(np.diff(self.bodies)) + 1, [len(self.bodies)]])  # of bodies
        fronts = np.minimum(edges[np.searchsorted(edges, begins, side="right")], ends) - begins
        backs = ends - np.maximum(edges[np.searchsorted(edges, ends) - 1], begins)
        for (first, last, begin, end), front, back in zip(runs, fronts.tolist(), backs.tolist(), strict=True):
            front, back = (count if count >= _LARGE_BODY else 0 for count in (front, back))
            if front == end - begin:  # a lone body
                rows.append((first, last, end - 1, end))
                continue
            parts = (
                (begin, begin + front, begin + front, end),
                (begin + front, end - back, begin, end),
                (end - back, end, begin, end - back),
            )
            rows += [
                (max(a, first), min(b, last), *sources) for a, b, *sources in parts if max(a, first) < min(b, last)
            ]
        return rows

    def _edges(self) -> np.ndarray:
        """Return the first moment of each world, and the end of the last world."""
        return np.searchsorted(self.worlds, np.arange(self.world_count + 1))


def _rows(*columns: np.ndarray) -> list[tuple]:
    """Return the rows of columns as tuples of whole numbers."""
    return list(zip(*(column.tolist() for column in columns), strict=True))


def make_layout(radii, worlds, permanent, bodies, movable, dtype, copies: int = 1, body_step: int = 0) -> MomentLayout:
    """Return the layout of moments; the arguments after the radii may be None, see :class:`MomentSystem`."""
    check_count("copies", copies)
    check_whole("body_step", body_step)
    if body_step < 0:
        raise InputError(f"body_step: must not be negative, got {body_step}")
    radii = host_radii("radii", radii, dtype)
    if radii.ndim != 1:
        raise InputError(shape_message("radii", "[n]", radii))
    n = len(radii)

    def labels(name, values, default, kinds):
        array = np.asarray(default if values is None else values)
        if array.shape != (n,):
            raise InputError(shape_message(name, f"[{n}]", array))
        if array.size and array.dtype.kind not in kinds:
            raise InputError(f"{name}: must be {'flags' if 'b' in kinds else 'whole numbers'}, got {array.dtype}")
        return array.astype(default.dtype)

    worlds, bodies = labels("worlds", worlds, np.zeros(n, int), "iu"), labels("bodies", bodies, np.arange(n), "iu")
    permanent = labels("permanent", permanent, np.zeros(n, bool), "biu")
    movable = labels("movable", movable, np.ones(n, bool), "biu")
    if (worlds < 0).any() or (np.diff(2 * worlds + permanent) < 0).any():
        raise InputError(
            "worlds, permanent: moments must be ordered by world, from 0 on, the inducible ones of each first"
        )
    largest = int(bodies.max(initial=-1)) + body_step * (copies - 1)
    check_bodies("bodies: numbers too large", largest + 1, dtype)
    _, body, size = np.unique(bodies, return_inverse=True, return_counts=True)
    single = size[body] == 1
    aligned = ~permanent & single
    return MomentLayout(
        radii, worlds, permanent, bodies, movable, single, np.zeros(n, bool), aligned, copies, body_step
    )


def with_cells(layout: MomentLayout, couplings) -> MomentLayout:
    """Return the layout with the moments of ``couplings`` as cells: not aligned, even if a body has a single one."""
    cells = np.zeros(len(layout.radii), bool)
    for first, coupling in couplings:
        cells[first : first + len(coupling.start) - 1] = True
    return replace(layout, cells=cells, aligned=layout.aligned & ~cells)


@dataclass(frozen=True)
class MomentMaterial:
    """Magnetic material of n moments. The values of permanent moments are ignored.

    A curve is one of ``magnets.CURVES``, or a measured ``MagnetizationCurve``, which also determines saturation and
    susceptibility. A tuple or list holds one curve for each moment, or for each run of ``curve_counts`` moments.
    ``magnets.LINEAR_CURVE`` is the response of a permanent magnet of recoil permeability 1 + χ. A formula is a function
    of the field inside for cells, of the field of all others for balls.
    """

    saturation: Any = 1.0  # saturation magnetization Ms [A/m], scalar or [n]
    susceptibility: Any = math.inf  # [dimensionless], scalar or [n]
    curve: Any = "tanh"
    curve_counts: Any = None  # moments of each curve of a list; None for one each

    def parameters(self, layout: MomentLayout, dtype, device) -> tuple[CurveParameters, np.ndarray]:
        """Return the material of all copies for kernels, and the susceptibility of each moment, 1 for a permanent one.

        The susceptibility has the shape [n].
        """
        permanent, n = layout.permanent, len(layout.permanent)
        ids, measured = _curve_ids(self.curve, self.curve_counts, layout.cells)
        saturation = np.where(permanent, 1.0, host_scalars("saturation", self.saturation, n))
        susceptibility = host_scalars("susceptibility", self.susceptibility, n, infinite=True)
        susceptibility = np.where(permanent, 1.0, susceptibility)
        for number, curve in enumerate(measured):
            rows = (ids == FIRST_TABLE + number) & ~permanent
            saturation[rows], susceptibility[rows] = curve.saturation, curve.susceptibility
        host_positive("saturation", saturation, n, dtype)
        host_positive("susceptibility", susceptibility, n, dtype, infinite=True)

        def upload(values, warp_type):
            return put_copies(np.broadcast_to(values, n), warp_type, device, layout.copies)

        used = np.unique(ids[~permanent])
        parameters = CurveParameters(
            inducible=upload((~permanent).astype(np.int32), wp.int32),
            saturation=upload(saturation, dtype),
            slope=upload(_slope(susceptibility), dtype),
            curve=upload(ids, wp.int32),
            common_curve=int(used[0]) if len(used) == 1 else MIXED,
            tables=curve_tables(measured, dtype, device),
        )
        return parameters, susceptibility


def change_material(parameters: CurveParameters, moments, saturation, susceptibility, dtype):
    """Change saturation [A/m] and susceptibility of some moments in place; see :meth:`MomentSystem.set_material`."""
    host_positive("saturation", saturation, len(moments), dtype)
    host_positive("susceptibility", susceptibility, len(moments), dtype, infinite=True)
    for array, values in ((parameters.saturation, saturation), (parameters.slope, _slope(susceptibility))):
        changed = array.numpy().copy()
        changed[moments] = values
        array.assign(changed)


def _slope(susceptibility):
    """Return the initial slope M/H of a ball in its applied field, 3χ/(3 + χ)."""
    return 3.0 / (1.0 + 3.0 / susceptibility)


def _curve_ids(curve, counts, cells: np.ndarray) -> tuple[np.ndarray, list[MagnetizationCurve]]:
    """Return the number by which kernels select each moment's curve, shape [n], and the list of measured curves."""
    n = len(cells)
    is_list = isinstance(curve, (tuple, list)) and (counts is not None or len(curve) == n)
    measured: dict[MagnetizationCurve, int] = {}
    numbers: dict[int, tuple[int, int]] = {}  # of a ball and a cell; by identity, because many magnets share it

    def number(curve) -> tuple[int, int]:
        if isinstance(curve, MagnetizationCurve):
            table = measured.setdefault(curve, FIRST_TABLE + len(measured))
            return table, table
        if curve == LINEAR_CURVE:
            return LINEAR, LINEAR
        check_token("curve", curve, tuple(CURVE_IDS))
        return CURVE_IDS[curve]

    for item in curve if is_list else (curve,):
        if id(item) not in numbers:
            numbers[id(item)] = number(item)
    ids = np.array([numbers[id(item)] for item in (curve if is_list else (curve,))], np.int32).reshape(-1, 2)
    of_ball, of_cell = np.broadcast_to(ids if counts is None else np.repeat(ids, counts, axis=0), (n, 2)).T
    return np.where(cells, of_cell, of_ball), list(measured)
