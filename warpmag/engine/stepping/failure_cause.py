"""Probable causes of states that are not finite."""

import numpy as np

from warpmag.engine.magnets.attributes import NAMESPACE
from warpmag.engine.magnets.magnetics import Magnetics
from warpmag.engine.stepping.statistics import Statistics

_STRONGEST_FIELD = 1e8
"""Strength [A/m], [A] or [V] above which an error names it as the cause: ten times practical maxima."""


def failure_cause(magnetics: Magnetics, statistics: Statistics, joint_gaps: dict[str, float]) -> str:
    """Return the probable cause of a state that is not finite; empty if unknown.

    ``joint_gaps`` are the distances between the ends of joints at the start [m], by label.
    """
    if statistics.overlapping:
        return "bodies overlapped at the start, and pushing them apart may make them spin ever faster"
    if joint_gaps:
        return f"the ends of the joint {next(iter(joint_gaps))} were apart at the start, and it pulls"
    if statistics.capped:
        return "bodies had been too fast for the shortest substep"
    attributes = getattr(magnetics.model, NAMESPACE)
    strengths = {
        "an applied field of {:.3g} A/m": magnetics.external_field.numpy(),
        "a magnetization of {:.3g} A/m": attributes.magnetization.numpy(),
        "a coil's current [A] or a field map's factor of {:.3g}": attributes.strength.numpy(),
        "a coil's voltage of {:.3g} V": attributes.voltage.numpy(),
    }
    for name, values in strengths.items():
        strongest = float(np.abs(values).max(initial=0.0))
        if strongest > _STRONGEST_FIELD:
            return f"{name.format(strongest)} moves magnets too fast for the shortest substep"
    return ""
