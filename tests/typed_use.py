"""What a type checker is to make of the public names; pyright reads this, nothing runs it."""

from typing import assert_type

import newton
import numpy as np
from newton.solvers import SolverXPBD

import warpmag


def simulate(path: str) -> None:
    simulation = warpmag.Simulation(path, solver="mujoco", dt=1e-3)
    assert_type(simulation, warpmag.Simulation)
    assert_type(simulation.time, float)
    assert_type(simulation.magnetics, warpmag.Magnetics)
    assert_type(simulation.state, newton.State)
    assert_type(simulation.run(10).held, int)


def build(builder: newton.ModelBuilder, solver: SolverXPBD, state: newton.State) -> None:
    warpmag.register_custom_attributes(builder)
    warpmag.add_inducible(builder, body=0, material="iron")
    warpmag.add_permanent(builder, body=1, magnetization=(0.0, 0.0, 1e6))
    assert_type(warpmag.add_coil(builder, radius=0.05, ampere_turns=100.0), int)
    magnetics = warpmag.Magnetics(builder.finalize(), force="kelvin")
    assert_type(magnetics.apply(state), None)
    assert_type(magnetics.b_field([[0.0, 0.0, 1.0]]), np.ndarray)


def solve(positions: np.ndarray) -> None:
    try:
        result = warpmag.solve_induction(positions, 0.005, saturation=1.7e6)
    except warpmag.InputError:
        return
    assert_type(result, warpmag.InductionResult)
    assert_type(result.converged, bool)
    assert_type(warpmag.MagnetizationCurve.from_bh([0, 1e3], [0, 1.5]), warpmag.MagnetizationCurve)
    assert_type(warpmag.material("N42").density, float)
    assert_type(warpmag.__version__, str)
