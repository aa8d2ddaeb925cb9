"""Hard cases of induction and forces: each ends converged, or says that it did not, and nothing is ever non-finite.

A case is data: positions, radii and the arguments of a solve. What a converged solve returns is judged by the float64
oracle: its residual ‖M − f(H(M))‖/‖f(H(M))‖.
"""

import dataclasses
import warnings

import numpy as np
import pytest
from arrangements import fcc_block

import warpmag
from bench.reference import oracle
from warpmag.errors import InputError

MS = 1.7e6
R = 0.005
RTOL = 1e-3


@dataclasses.dataclass(frozen=True)
class Case:
    """Balls and what is done to them.

    Attributes:
        positions: Centres [m], shape [n, 3].
        radii: Radii [m], scalar or [n].
        applied: Applied field [A/m], shape [3] or [n, 3].
        arguments: More arguments of ``solve_induction``.
    """

    positions: np.ndarray
    radii: object = R
    applied: object = (0.0, 0.0, 1e5)
    arguments: dict = dataclasses.field(default_factory=dict)


def _random(count, extent, seed=0):
    return np.random.default_rng(seed).uniform(-0.5, 0.5, (count, 3)) * extent


def _fields(count, strength, seed=1):
    return strength * np.random.default_rng(seed).normal(size=(count, 3))


def _mixed_sizes():
    """Small balls on, in and beside big ones, radii 1:100."""
    big = 0.2 * np.arange(3)[:, None] * [1.0, 0.0, 0.0]
    on_top = big[0] + np.array([[0.0, 0.0, 0.101]])
    x = np.concatenate([big, _random(200, 0.5, seed=2), on_top])
    return Case(x, np.concatenate([np.full(3, 0.1), np.full(201, 0.001)]))


def _nearly_saturated():
    """Fields that bring tanh to within 1e-7 of its end, in single precision all of it."""
    strength = np.arctanh(1.0 - 1e-7) / 3.0 * MS
    return Case(2.0 * R * np.arange(8)[:, None] * [1.0, 0.0, 0.0], applied=(0.0, strength, 0.0))


def _antiparallel():
    block = fcc_block((3, 3, 3))
    start = np.broadcast_to([0.0, 0.0, -MS * (1.0 - 1e-6)], block.shape)
    return Case(block, arguments={"initial": start}, applied=(0.0, 0.0, 1e6))


CASES = {
    "a lone ball": lambda: Case(np.zeros((1, 3))),
    "no ball": lambda: Case(np.zeros((0, 3))),
    "touching balls": lambda: Case(fcc_block((4, 4, 4))),
    "overlapping balls": lambda: Case(_random(300, 0.04), 0.01),
    "coincident centers": lambda: Case(np.repeat(_random(40, 0.1), 4, axis=0)),
    "coincident centers under fields of their own": lambda: Case(
        np.zeros((50, 3)), applied=_fields(50, 3e6), arguments={"max_evaluations": 300}
    ),
    "radii 1:100": _mixed_sizes,
    "no field": lambda: Case(fcc_block((2, 2, 2)), applied=(0.0, 0.0, 0.0)),
    "no field, magnetized before": lambda: Case(
        fcc_block((2, 2, 2)), applied=(0.0, 0.0, 0.0), arguments={"initial": np.full((32, 3), 0.5e6)}
    ),
    "weakest field": lambda: Case(fcc_block((3, 3, 3)), applied=(0.0, 0.0, 1e-12)),
    "a denormal field": lambda: Case(fcc_block((3, 3, 3)), applied=(0.0, 0.0, 1e-41)),
    "strongest field": lambda: Case(fcc_block((3, 3, 3)), applied=(0.0, 0.0, 1e12)),
    "fields of all strengths at once": lambda: Case(
        fcc_block((3, 3, 3)), applied=np.logspace(-12, 12, 108)[:, None] * [0.6, 0.0, 0.8]
    ),
    "M within 1e-7 of Ms": _nearly_saturated,
    "antiparallel start": _antiparallel,
    "a chain of 1,000": lambda: Case(2.0 * R * np.arange(1000)[:, None] * [1.0, 0.0, 0.0], applied=(1e4, 0.0, 1e2)),
    "a zigzag chain with gaps of 1e-7 R": lambda: Case(
        2.0000001 * R * np.stack([np.arange(400) * 0.6, np.arange(400) % 2 * 0.8, np.zeros(400)], axis=1)
    ),
    "specks of a tenth of a micrometre": lambda: Case(2e-5 * fcc_block((3, 3, 3)), 2e-5 * R),
    "balls of 10 km": lambda: Case(2e6 * fcc_block((3, 3, 3)), 2e6 * R),
    "10 km from the origin": lambda: Case(1e4 + np.arange(64)[:, None] * [0.0, 0.0, 4.0 * R]),
    "weakly susceptible": lambda: Case(fcc_block((3, 3, 3)), arguments={"susceptibility": 1e-6}),
    "materials from 1e-3 to 1e9 side by side": lambda: Case(
        fcc_block((3, 3, 3)), arguments={"susceptibility": np.logspace(-3, 9, 108)}
    ),
    "saturation from 1e-6 to 1e9 side by side": lambda: Case(
        fcc_block((3, 3, 3)), arguments={"saturation": np.logspace(-6, 9, 108)}
    ),
    "a magnet 1,000 times too strong, in contact": lambda: Case(
        fcc_block((3, 3, 3)), arguments={"permanent": (np.array([[0.0, 0.0, -0.01]]), np.array([[0.0, 0.0, 3e3]]))}
    ),
    "a source inside a ball": lambda: Case(
        fcc_block((2, 2, 2)), arguments={"permanent": (np.zeros((1, 3)), np.array([[0.0, 0.0, 1.0]]))}
    ),
}


def solve(case, dtype, device, **arguments):
    """Solve and return the result, its forces, torques and warnings."""
    arguments = {"saturation": MS, "rtol": RTOL, **case.arguments, **arguments}
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        result = warpmag.solve_induction(
            case.positions, case.radii, external_field=np.asarray(case.applied), dtype=dtype, device=device, **arguments
        )
        force, torque = result.wrench()
    return result, force, torque, [str(entry.message) for entry in caught]


def true_residual(case, solution):
    """The residual in float64, of the magnetizations as found."""
    n = len(case.positions)
    radii = np.broadcast_to(np.asarray(case.radii, float), n)
    m = np.asarray(solution.magnetizations, float)
    h = np.broadcast_to(np.asarray(case.applied, float), (n, 3)).copy()
    h += oracle.h_field(case.positions, m * (4.0 / 3.0 * np.pi * radii**3)[:, None], radii=radii)
    if "permanent" in case.arguments:
        h += oracle.h_field(*case.arguments["permanent"], case.positions, target_radii=radii)
    saturation = np.broadcast_to(case.arguments.get("saturation", MS), n)
    susceptibility = np.broadcast_to(case.arguments.get("susceptibility", np.inf), n)
    wanted, _ = oracle.magnetization(h, saturation, susceptibility)
    scale = np.linalg.norm(wanted)
    # numbers below the smallest normal one may be kept or flushed to zero
    return np.linalg.norm(m - wanted) / scale if scale > np.finfo(np.float32).tiny else np.linalg.norm(m)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("name", CASES)
def test_hard_case(name, dtype, device):
    case = CASES[name]()
    if dtype == "float32":
        case = Case(
            np.asarray(case.positions, np.float32).astype(float), case.radii, case.applied, case.arguments
        )  # what the solve sees
    result, force, torque, said = solve(case, dtype, device)
    for values in (result.magnetizations, result.h_field, force, torque, result.error):
        assert np.isfinite(values).all()
    if result.converged:
        assert result.error <= RTOL and not said
        # float32: fields of neighbours and their sum are known to a few 1e-6 of the largest, f' is at most 3
        assert true_residual(case, result) <= RTOL + (2e-5 if dtype == "float32" else 1e-9)
    else:
        assert result.error > RTOL
        assert len(said) == 1 and "did not converge" in said[0]


@pytest.mark.parametrize("scale", [1e-6, 1e9])
def test_sizes_beyond_single_precision_are_refused(scale, device):
    """Ferrofluids have 5 nm particles: double precision holds them, single precision says that it does not."""
    case = Case(scale * fcc_block((2, 2, 2)), scale * R)
    with pytest.raises(InputError, match="radii: must be 5e-08 to 20000 m in float32, got .*; use float64"):
        solve(case, "float32", device)
    result, force, _, _ = solve(case, "float64", device)
    assert result.converged and np.isfinite(force).all() and true_residual(case, result) <= RTOL + 1e-9


@pytest.mark.long
@pytest.mark.cuda
def test_a_clump_of_100_000_balls(device):
    """As many balls as fit ten times over: every list of neighbours is full."""
    case = Case(_random(100_000, 0.25, seed=5))
    result, force, _, said = solve(case, "float32", device)
    assert np.isfinite(force).all() and np.isfinite(result.magnetizations).all()
    assert result.converged or "did not converge" in said[0]
