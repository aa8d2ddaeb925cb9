"""Compares forces with slopes of the energy, F = −dE/dx: ``python -m bench.slopes [NAME ...]``.

Setups are those of ``bench.reference.iron_bodies``; arguments are beginnings of their names. The last body moves along
the axis of the largest component of its force. Each setup is one JSON line; its error is relative to the force.
"""

import argparse

import numpy as np
import warp as wp

import warpmag
from bench.iron import model_of
from bench.machine import line_writer
from bench.reference.iron_bodies import SETUPS

_SETTLED = 3e-6  # tolerance of the solve; the error of the energy is of second order in it
_STEP, _LARGEST_STEP = 8e-6, 0.4  # step of a body [m], at most this part of the gap: positions have single precision
_STEP_FROM_AFAR = 0.05  # part of a large gap


def main() -> None:
    """Compare the setups named on the command line, or all."""
    parser = argparse.ArgumentParser(prog="python -m bench.slopes", description=__doc__.partition(":")[0])
    parser.add_argument("names", nargs="*", default=[""], help="beginnings of names of setups; all without")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--cells", type=int, default=0, help="moments of each body; 0: automatic")
    options = parser.parse_args()
    wp.config.log_level = wp.LOG_WARNING
    write = line_writer(options.device)
    for name, setup in SETUPS.items():
        if len(setup.bodies) > 1 and name.startswith(tuple(options.names)):
            write({"setup": name, "cells": options.cells, **slope_error(name, options.cells, options.device)})


def slope_error(name: str, cells: int = 0, device="cpu") -> dict:
    """Largest component of the force on the last body [N], minus the slope of the energy along it, relative error.

    The slope is that of a cubic polynomial through the energies at four places.
    """
    setup, gap = SETUPS[name], 1e-3 * float(name.rpartition("gap ")[2])
    model = model_of(setup, cells, device)
    magnetics = warpmag.Magnetics(model, external_field=setup.field, rtol=_SETTLED, max_evaluations=3000)
    state, last = model.state(), len(setup.bodies) - 1
    poses = state.body_q.numpy().copy()

    def solved(shift) -> np.ndarray:
        """Solve with the last body shifted [m]; return its actual shift."""
        moved = poses.copy()
        moved[last, :3] += np.asarray(shift, np.float32)
        state.body_q.assign(moved)
        state.clear_forces()
        magnetics.apply(state)
        return moved[last, :3].astype(float) - poses[last, :3]

    solved(np.zeros(3))
    force = state.body_f.numpy()[last, :3].astype(float)
    direction = np.eye(3)[np.abs(force).argmax()]
    step = max(_STEP_FROM_AFAR * gap, min(_LARGEST_STEP * gap, _STEP))
    energies, places = [], []
    for k in (-2, -1, 1, 2):
        places.append(solved(k * step * direction) @ direction)
        energies.append(float(magnetics.energy().sum()))
    slope = np.polyfit(np.array(places) / step, energies, 3)[2] / step
    along = force @ direction
    return {"force": along, "slope": -slope, "error": -slope / along - 1.0}


if __name__ == "__main__":
    main()
