"""The model of a builder with what a rigid-body solver needs."""

import contextlib

import newton
import numpy as np
import warp as wp

from warpmag.engine.pile_xpbd.solvers import SOLVERS
from warpmag.engine.stepping.model_checks import articulate, check_stability
from warpmag.errors import InputError

_COARSEST = 0.25
"""Largest spacing of single-precision positions over the thickness of a body, as far as a substep may move it."""


def solver_model(
    builder: newton.ModelBuilder, solver: str, device: wp.Device, *, stage: str, longest_substep: float
) -> newton.Model:
    """Return the model of a builder, with the articulations and colors that the solver needs.

    Args:
        builder: The builder; it gets them, too.
        solver: Name of Newton's solver, one of ``SOLVERS``.
        device: Device of the model.
        stage: USD file that the builder was imported from, for messages of errors; empty without.
        longest_substep: Longest substep [s].

    Raises:
        InputError: The solver cannot move the model with this substep.
    """
    articulate(builder, solver)
    if not builder.body_count:  # Newton needs a body; one without shapes has no effect
        extended = newton.ModelBuilder()
        extended.add_builder(builder)
        extended.add_link(is_kinematic=True)
        builder = extended
    if solver == "vbd":
        builder.color()  # VBD moves bodies of one color at once
    errors = contextlib.nullcontext()
    if stage:
        from warpmag.usd import newton_errors  # noqa: PLC0415 - a builder can do without USD

        errors = newton_errors(stage, "use")
    with wp.ScopedDevice(device), errors:
        model = builder.finalize(device=device, skip_validation_joints=SOLVERS[solver].maximal)
    check_stability(model, solver, longest_substep)
    return model


def position_coarseness(model: newton.Model, state: newton.State, thickness: np.ndarray) -> float:
    """Return the largest spacing of single-precision positions over the thickness [m] of a body, shape [bodies].

    Raises:
        InputError: A body is so far from the origin that its position is unknown by over a quarter of its thickness.
            Cells of thin bodies would then overlap at random, and induction would iterate to its limit.
    """
    spacings = np.spacing(np.abs(state.body_q.numpy()[:, :3]).max(axis=1, initial=0.0))
    coarseness = spacings / thickness  # the thickness of fixed bodies is infinite
    worst = int(np.argmax(coarseness)) if len(coarseness) else -1
    if worst >= 0 and coarseness[worst] > _COARSEST:
        raise InputError(
            f"{model.body_label[worst]}: is too far from the origin: positions in single precision are "
            f"{spacings[worst]:.2g} m apart there, over a quarter of its thickness of {thickness[worst]:.2g} m"
        )
    return float(coarseness[worst]) if worst >= 0 else 0.0
