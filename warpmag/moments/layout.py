"""What each moment of a system is: its world and its body, and what it is made of."""

from dataclasses import dataclass, replace

import numpy as np
import warp as wp

from warpmag.declarations.checks import check_token
from warpmag.declarations.curves import MagnetizationCurve
from warpmag.declarations.magnets import LINEAR_CURVE
from warpmag.errors import InputError
from warpmag.kernels.material.curves import CURVE_IDS, FIRST_TABLE, LINEAR, MIXED, CurveParameters, curve_tables
from warpmag.moments.arrays import check_bodies, host_positive, host_radii, host_scalars, shape_message


@dataclass(frozen=True)
class MomentLayout:
    """What each moment is, NumPy arrays of shape [n].

    Attributes:
        radii: Radius of its ball [m].
        worlds: Its world.
        permanent: Whether it is permanent.
        bodies: Its body.
        movable: Whether the force on it is wanted.
        lone: Whether it is an inducible ball, its body's only moment, which is parallel to the field that turns it.
        alone: Whether it is its body's only moment.
    """

    radii: np.ndarray
    worlds: np.ndarray
    permanent: np.ndarray
    bodies: np.ndarray
    movable: np.ndarray
    lone: np.ndarray
    alone: np.ndarray

    @property
    def balls(self) -> np.ndarray:
        """Whether it is an inducible ball of some size, its body's only moment."""
        return self.lone & (self.radii > 0.0)

    def ranges(self) -> list[tuple[int, int, int]]:
        """For each world its first moment, its first permanent one, and the end."""
        edges = self._edges()
        permanent = np.concatenate([[0], np.cumsum(self.permanent)])[edges]
        return list(
            zip(edges[:-1].tolist(), (edges[1:] - np.diff(permanent)).tolist(), edges[1:].tolist(), strict=True)
        )

    def runs(self, wanted: np.ndarray) -> list[tuple[int, int, int, int]]:
        """For each run of ``wanted`` moments in one world its first moment and its end, and those of the world."""
        edges = self._edges()
        inside = np.ones(len(wanted) + 1, bool)  # whether a moment and the one before are of one world
        inside[edges] = False
        padded = np.concatenate([[False], wanted, [False]])
        first = np.flatnonzero(wanted & ~(padded[:-2] & inside[:-1]))
        last = np.flatnonzero(wanted & ~(padded[2:] & inside[1:])) + 1
        world = self.worlds[first]
        columns = (first, last, edges[world], edges[world + 1])
        return list(zip(*(column.tolist() for column in columns), strict=True))

    def _edges(self) -> np.ndarray:
        """First moment of each world, and the end of the last."""
        return np.searchsorted(self.worlds, np.arange(self.worlds.max(initial=-1) + 2))


def make_layout(radii, worlds, permanent, bodies, movable, dtype) -> MomentLayout:
    """Layout of moments, of which all but the radii may be None; see :class:`MomentSystem`."""
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
    check_bodies("bodies: numbers too large", int(bodies.max(initial=-1)) + 1, dtype)
    _, body, size = np.unique(bodies, return_inverse=True, return_counts=True)
    alone = size[body] == 1
    return MomentLayout(radii, worlds, permanent, bodies, movable, ~permanent & alone, alone)


def _curve_ids(curve, n: int) -> tuple[np.ndarray, list[MagnetizationCurve]]:
    """Number of each moment's curve for the kernels, shape [n], and the measured ones among them."""
    each = isinstance(curve, (tuple, list)) and len(curve) == n
    measured: dict[MagnetizationCurve, int] = {}
    known: dict[int, int] = {}  # by identity, since moments of a body share a curve

    def number(one) -> int:
        if isinstance(one, MagnetizationCurve):
            return measured.setdefault(one, FIRST_TABLE + len(measured))
        if one == LINEAR_CURVE:
            return LINEAR
        check_token("curve", one, tuple(CURVE_IDS))
        return CURVE_IDS[one]

    for one in curve if each else (curve,):
        if id(one) not in known:
            known[id(one)] = number(one)
    ids = [known[id(one)] for one in curve] if each else known[id(curve)]
    return np.array(np.broadcast_to(ids, n), np.int32), list(measured)


def change_material(material: CurveParameters, which, saturation, susceptibility, dtype):
    """Change saturation [A/m] and susceptibility of some moments in place; see :meth:`MomentSystem.set_material`."""
    host_positive("saturation", saturation, len(which), dtype)
    host_positive("susceptibility", susceptibility, len(which), dtype, infinite=True)
    slope = 3.0 / (1.0 + 3.0 / susceptibility)
    for array, values in ((material.saturation, saturation), (material.slope, slope)):
        whole = array.numpy().copy()
        whole[which] = values
        array.assign(whole)


def with_cells(layout: MomentLayout, couplings) -> MomentLayout:
    """The same layout, in which a body that has cells is no ball, even if it has only one."""
    cells = np.zeros(len(layout.radii), bool)
    for first, coupling in couplings:
        cells[first : first + len(coupling.start) - 1] = True
    return replace(layout, lone=layout.lone & ~cells)


def make_material(permanent, saturation, susceptibility, curve, dtype, device) -> tuple[CurveParameters, np.ndarray]:
    """Make the material of all moments.

    Args:
        permanent: Whether a moment is permanent, shape [n].
        saturation: Saturation magnetization [A/m], scalar or [n].
        susceptibility: Susceptibility [dimensionless], scalar or [n].
        curve: Curve of all, or a list of n; a measured one has its own saturation and susceptibility.
        dtype: Warp's float32 or float64.
        device: Warp device.

    Returns:
        What kernels want, and the susceptibility of each moment, 1 where it is permanent, shape [n].

    Raises:
        InputError: A value is out of range, or a curve unknown.
    """
    n = len(permanent)
    ids, measured = _curve_ids(curve, n)
    saturation = np.where(permanent, 1.0, host_scalars("saturation", saturation, n))
    susceptibility = np.where(permanent, 1.0, host_scalars("susceptibility", susceptibility, n, infinite=True))
    for number, one in enumerate(measured):
        of_table = (ids == FIRST_TABLE + number) & ~permanent
        saturation[of_table], susceptibility[of_table] = one.saturation, one.susceptibility
    host_positive("saturation", saturation, n, dtype)
    host_positive("susceptibility", susceptibility, n, dtype, infinite=True)

    def put(values, kind):
        return wp.array(np.ascontiguousarray(np.broadcast_to(values, n)), dtype=kind, device=device)

    found = np.unique(ids[~permanent])
    material = CurveParameters(
        inducible=put((~permanent).astype(np.int32), wp.int32),
        saturation=put(saturation, dtype),
        slope=put(3.0 / (1.0 + 3.0 / susceptibility), dtype),
        curve=put(ids, wp.int32),
        common_curve=int(found[0]) if len(found) == 1 else MIXED,
        tables=curve_tables(measured, dtype, device),
    )
    return material, susceptibility
