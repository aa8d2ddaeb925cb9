"""Random heaps of iron bodies and magnets: solved, balanced, with a positive definite operator of induction."""

from dataclasses import asdict

import newton
import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation

import warpmag
from bench import heaps


def test_heaps_are_stable_and_balanced(device):
    """Twenty heaps; ``python -m bench.heaps`` has 2,000."""
    verdicts = list(heaps.judge(20, 7, 100, device))
    assert [asdict(verdict) for verdict in verdicts if not verdict.passes] == []
    assert len(verdicts) == 20 and sum(verdict.operator is not None for verdict in verdicts) > 4
    sums = np.array([[verdict.force_sum, verdict.torque_sum] for verdict in verdicts])
    assert np.median(sums) < 3e-7 and np.quantile(sums, 0.8) < 1e-6


def test_sweeps_that_diverge_end(device):
    """Plain steps converge in 45 evaluations where cells lie in two balls that overlap; with sweeps it took 797."""
    number = 643
    heap = heaps.draw(number // heaps.BATCH, 7)[number % heaps.BATCH]
    (verdict,) = heaps.SolvedHeaps([heap], device).verdicts(number)
    assert verdict.passes and verdict.evaluations < 200


@pytest.mark.parametrize(("number", "seed"), [(1374, 7), (648, 11)])
def test_small_cells_inside_large_ones_converge(number, seed, device):
    """Balls of small cells share little of a large cell's volume, but all of their own: steps must be short.

    With the steps for the shares of the large cells these heaps did not converge in 1,000 evaluations.
    """
    heap = heaps.draw(number // heaps.BATCH, seed)[number % heaps.BATCH]
    (verdict,) = heaps.SolvedHeaps([heap], device).verdicts(number)
    assert verdict.passes and verdict.evaluations < 100


SHEETS = {
    "inside": [((0.024, 0.024, 0.003), 0.0025, (0.0, 0.0, 0.0)), ((0.024, 0.024, 0.001), 0.0018, (0.0, 0.0, 0.0))],
    "turned": [((0.024, 0.024, 0.0005), 0.0022, (0.0, 0.0, 0.0)), ((0.024, 0.024, 0.0005), 0.0022, (0.0, 0.0, 0.3))],
    "across": [((0.024, 0.024, 0.003), 0.0025, (0.0, 0.0, 0.0)), ((0.024, 0.024, 0.001), 0.0018, (1.2, 0.0, 0.3))],
}
"""Sides [m], spacing of cells [m] and rotation vector of intersecting sheets."""


@pytest.mark.parametrize("which", SHEETS)
def test_sheets_that_intersect_are_stable(which, device):
    """Cells of sheets far wider than thick reach into each other, though no inscribed balls of theirs do."""
    iron = {"susceptibility": 1000.0, "saturation": 1e9}
    pieces = [
        heaps.Piece(
            heaps.Geometry("plate", np.array(sides) / 2.0, spacing, None), np.zeros(3), Rotation.from_rotvec(turn), iron
        )
        for sides, spacing, turn in SHEETS[which]
    ]
    (verdict,) = heaps.SolvedHeaps([heaps.Heap(pieces, np.array([0.0, 1e3, 500.0]))], device).verdicts(0, 400)
    assert verdict.passes and verdict.operator is not None
    assert verdict.demagnetization is not None and verdict.demagnetization > 0.0


@pytest.mark.parametrize("spread", [5e-4, 4e-3])
def test_many_bodies_that_intersect_converge(spread, device):
    """30 cones in nearly one place. With the added demagnetization of one overlap the residual grew."""
    rng, builder = np.random.default_rng(3), newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    warpmag.register_custom_attributes(builder)
    for _ in range(30):
        place, turn = rng.uniform(-spread, spread, 3), rng.normal(size=3) * 50.0 * spread
        cone = builder.add_body(xform=wp.transform(wp.vec3(*place), wp.quat(*Rotation.from_rotvec(turn).as_quat())))
        builder.add_shape_cone(cone, radius=0.01, half_height=0.02)
        warpmag.add_inducible(builder, body=cone, moment_spacing=0.005)
    model = builder.finalize(device=device)
    magnetics = warpmag.Magnetics(model)
    magnetics.set_external_field((0.0, 2e4, 5e3))
    magnetics.induce(model.state())
    assert magnetics.system.converged.numpy().all() and magnetics.evaluations.numpy().max() < 100


def test_heaps_have_all_shapes_and_materials():
    """Every shape and kind of material is drawn, and heaps repeat."""
    drawn = heaps.draw(0, 7)
    pieces = [piece for heap in drawn for piece in heap.pieces]
    assert len({piece.geometry.shape for piece in pieces}) == 10
    for name in ("saturation", "curve", "material", "magnetization"):
        assert sum(name in piece.material for piece in pieces) > len(drawn) // 6
    assert heaps.draw(0, 7)[3].field.tolist() == drawn[3].field.tolist() != heaps.draw(1, 7)[3].field.tolist()


def test_a_heap_that_fails_is_seen():
    """Sums and eigenvalues that are NaN fail."""
    good = heaps.Verdict(0, 10, 20, converged=True, finite=True, force_sum=1e-7, torque_sum=1e-7, operator=0.1)
    assert good.passes
    for name, value in {"converged": False, "finite": False, "operator": -0.1}.items():
        assert not heaps.Verdict(**(asdict(good) | {name: value})).passes
    for name in ("force_sum", "torque_sum", "operator"):
        assert not heaps.Verdict(**(asdict(good) | {name: np.nan})).passes
