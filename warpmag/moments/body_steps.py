"""Bodies of cells that take steps of the induction solve as a whole."""

import numpy as np

from warpmag.kernels.induction.body_steps import BodySteps
from warpmag.kernels.shared.copies import put_copies
from warpmag.moments.layout import MomentLayout
from warpmag.shapes.body_response import MOST_CELLS, residual_response


def make_body_steps(couplings, layout: MomentLayout, rotations, state, dynamics: str) -> BodySteps | None:
    """Prepare the steps of small bodies as a whole; None without them, and for other ``dynamics`` than theta.

    ``couplings`` are the first moment and the coupling of each body of all copies among the others of its world. The
    moments of small bodies, and few moments in place of a body, act on each other by tensors alone from now on.
    """
    within, responses, bodies = np.ones(len(layout.radii)), {}, []
    for number, (first, coupling) in enumerate(couplings):
        is_small = coupling.near and len(coupling.radii) <= MOST_CELLS
        if is_small:
            if id(coupling) not in responses:
                responses[id(coupling)] = residual_response(coupling)
            bodies.append((first, number, *responses[id(coupling)]))
        if is_small or not coupling.near:
            within[first : first + len(coupling.radii)] = 0.0  # empty beyond the first copy
    state.within_body = put_copies(within, state.within_body.dtype, state.within_body.device, layout.copies)
    if not bodies or dynamics != "theta":
        return None
    worlds = layout.worlds_of(np.array([first for first, *_ in bodies]))
    return BodySteps(bodies, worlds.tolist(), rotations, state)
