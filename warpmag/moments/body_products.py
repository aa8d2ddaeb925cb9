"""Bodies of cells that take steps of the induction solve as a whole, and fields of their own moments."""

import numpy as np

from warpmag.kernels.induction.body_products import BodyFields, BodySteps
from warpmag.kernels.shared.copies import put_copies
from warpmag.moments.cached_shapes import shape_cache
from warpmag.moments.layout import MomentLayout
from warpmag.shapes.body_response import MOST_CELLS, BodyResponse, OwnField, own_field, residual_response
from warpmag.shapes.demagnetization import Coupling

_MOST_BYTES = 1 << 27
"""Size of all tables beyond which further kinds of bodies iterate without steps, and fields are sums over pairs. Tables
of steps have 1.4 MB for a plate, and 18 MB for a body of 1,000 cells without mirrors."""


def make_body_steps(couplings, layout: MomentLayout, rotations, state, dynamics: str) -> BodySteps | None:
    """Prepare the steps of bodies as a whole; None without them, and for other ``dynamics`` than theta.

    ``couplings`` are the first moment and the coupling of each body of all copies among the others of its world. The
    moments of these bodies, and few moments in place of a body, act on each other by tensors alone from now on.
    """
    if dynamics != "theta":
        return None
    responses = _responses({id(coupling): coupling for _, coupling in couplings})
    within, bodies = np.ones(len(layout.radii)), []
    for number, (first, coupling) in enumerate(couplings):
        response = responses.get(id(coupling))
        if response is not None:
            bodies.append((first, number, response))
        if response is not None or not coupling.near:
            within[first : first + len(coupling.radii)] = 0.0  # empty beyond the first copy
    state.within_body = put_copies(within, state.within_body.dtype, state.within_body.device, layout.copies)
    if not bodies:
        return None
    worlds = layout.worlds_of(np.array([first for first, *_ in bodies]))
    return BodySteps(bodies, worlds.tolist(), rotations, state)


def _responses(couplings: dict[int, Coupling]) -> dict[int, BodyResponse]:
    """Return the response of each kind of body that has one."""
    result, size = {}, 0
    for key, coupling in couplings.items():
        if coupling.near and len(coupling.radii) <= MOST_CELLS and size < _MOST_BYTES:
            result[key] = _response(coupling)
            size += result[key].tables.nbytes
    return result


def _response(coupling: Coupling) -> BodyResponse:
    """Return the response of a body, from the cache of shapes or computed."""
    key = "response by parity", *_operator_key(coupling)
    return shape_cache().get(f"response of {len(coupling.radii)} cells", key, lambda: residual_response(coupling))


def make_body_fields(couplings, layout: MomentLayout, rotations, state) -> BodyFields | None:
    """Prepare the fields of bodies; None unless the inducible moments of each world are one body with small tables.

    ``couplings`` are those of :func:`make_body_steps`.
    """
    of_copy = couplings[: len(couplings) // layout.copies]
    is_iron = [not layout.permanent[first] for first, _ in of_copy]
    iron = [coupling for coupling, chosen in zip(of_copy, is_iron, strict=True) if chosen]
    lone = sorted((first, first + len(coupling.radii)) for first, coupling in iron)
    if lone != [(first, last) for first, last, _ in layout.ranges() if first < last]:
        return None
    if any(last - first > MOST_CELLS for first, last in lone):
        return None
    fields = _fields({id(coupling): coupling for _, coupling in iron})
    if not fields:
        return None
    bodies = [
        (first, number, fields[id(coupling)])
        for number, (first, coupling) in enumerate(couplings)
        if is_iron[number % len(of_copy)]
    ]
    worlds = layout.worlds_of(np.array([first for first, *_ in bodies]))
    return BodyFields(bodies, worlds.tolist(), rotations, state)


def _fields(couplings: dict[int, Coupling]) -> dict[int, OwnField] | None:
    """Return the field of each kind of body, or None if a body has none or all together are too large."""
    result, size = {}, 0
    for key, coupling in couplings.items():
        field = _own_field(coupling)
        if field is None or (size := size + field.tables.nbytes) > _MOST_BYTES:
            return None
        result[key] = field
    return result


def _own_field(coupling: Coupling) -> OwnField | None:
    """Return the field of a body, from the cache of shapes or computed."""
    key = "field by parity", *_operator_key(coupling)
    return shape_cache().get(f"field of {len(coupling.radii)} cells", key, lambda: own_field(coupling))


def _operator_key(coupling: Coupling) -> tuple:
    """Return what the operator of a body depends on."""
    key = coupling.positions, coupling.radii, coupling.start, coupling.other
    return (*key, coupling.grid_tensor, coupling.grid_rotation, coupling.common)
