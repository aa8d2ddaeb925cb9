"""Magnetic shapes of a model and their moments: total moments, and permanent shapes of bodies."""

from typing import Any

import newton
import numpy as np
import warp as wp

from warpmag.declarations.checks import check_whole, short_repr, vector
from warpmag.declarations.coils import STRONGEST_FIELD
from warpmag.engine.magnets.equal_worlds import EqualWorlds
from warpmag.engine.magnets.grouping import BodyMagnet
from warpmag.errors import InputError
from warpmag.kernels.rigid.bodies import sum_moments
from warpmag.kernels.shared.copies import repeat_rows


def _on_device(values: np.ndarray, model: newton.Model) -> wp.array:
    return wp.array(np.ascontiguousarray(values), dtype=wp.int32, device=model.device)


class ShapeMoments:
    """The moments of each magnetic shape, which follow each other in the order of the shapes.

    Attributes:
        shapes: Indices of the shapes in the model, NumPy, shape [n].
        volumes: Magnetic volume of each shape [m³], NumPy, shape [n].
    """

    def __init__(self, model: newton.Model, worlds: EqualWorlds):
        """Find the moments of the shapes of all magnets."""
        magnets, copies = worlds.magnets, worlds.copies
        self.shapes = repeat_rows(np.concatenate([magnet.shapes for magnet in magnets]), copies, worlds.shape_step)
        counts = np.concatenate([magnet.lattice.counts for magnet in magnets])
        volumes = np.concatenate([magnet.lattice.volumes for magnet in magnets])
        self._first = np.cumsum([0, *repeat_rows(counts, copies)])
        ends = self._first[: len(counts) + 1]
        self.volumes = repeat_rows(np.diff(np.concatenate([[0.0], np.cumsum(volumes)])[ends]), copies)
        self._first_on_device = _on_device(self._first, model)
        self.totals = wp.zeros(len(self.shapes), dtype=wp.vec3, device=model.device)

    def sum(self, moments: wp.array) -> wp.array:
        """Launch the sums of ``moments`` [A·m²], shape [moments]; return an array that the next call overwrites."""
        sum_moments(self._first_on_device, moments, self.totals)
        return self.totals

    def spread(self, magnetizations: dict[int, np.ndarray], inducible: np.ndarray) -> np.ndarray:
        """Return the magnetization of each moment [A/m], shape [moments, 3], from those of shapes.

        Shapes with moments that are not ``inducible``, shape [moments], and shapes without a magnetization get zeros.

        Raises:
            InputError: A shape has no magnet, or a magnetization is not three numbers of at most 1e30.
        """
        if not isinstance(magnetizations, dict):
            raise InputError(f"magnetizations: must be a dictionary by shape, got {short_repr(magnetizations)}")
        own_shapes = self.shapes.tolist()
        for shape, magnetization in magnetizations.items():
            if shape not in own_shapes:
                raise InputError(f"magnetizations: shape {short_repr(shape)} has no magnet")
            check_start(f"magnetizations: shape {shape}", magnetization)
        spread = np.zeros((len(inducible), 3))
        for part, shape in enumerate(own_shapes):
            rows = slice(self._first[part], self._first[part + 1])
            if shape in magnetizations and inducible[rows].all():
                spread[rows] = magnetizations[shape]
        return spread


def check_start(name: str, magnetization) -> None:
    """Raise :class:`InputError` unless a solve can start from a magnetization [A/m]: three numbers of at most 1e30."""
    if max(map(abs, vector(name, magnetization))) > STRONGEST_FIELD:
        raise InputError(f"{name}: must be at most {STRONGEST_FIELD:g} A/m, got {short_repr(magnetization)}")


class PermanentShapes:
    """The permanent shapes of a model, ordered by body."""

    def __init__(self, model: newton.Model, magnets: list[BodyMagnet]):
        """List the permanent shapes of ``magnets``."""
        shapes = [magnet.shapes for magnet in magnets if magnet.magnet.kind == "permanent"]
        shapes, body = np.concatenate([np.zeros(0, int), *shapes]), model.shape_body.numpy()
        self._shapes = shapes[np.argsort(body[shapes], kind="stable")]
        self._bodies, self._on_device = body[self._shapes], _on_device(self._shapes, model)

    def select(self, body: int, shape: int | None) -> wp.array:
        """Return the shapes of a body, or a shape alone, on the device.

        Raises:
            InputError: The body or shape has no permanent magnet.
        """
        check_whole("body", body)
        if shape is not None:
            check_whole("shape", shape)
        selected = self._bodies == body if shape is None else self._shapes == shape
        rows = np.flatnonzero(selected)
        if not len(rows) or (shape is None and body < 0):
            raise InputError(f"set_magnetization: {'body' if shape is None else 'shape'} has no permanent magnet")
        chosen: Any = self._on_device[int(rows[0]) : int(rows[-1]) + 1]
        return chosen
