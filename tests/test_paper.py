"""The paper's experiments: what its figures claim, on small versions of them, and the command that draws them."""

import json

import numpy as np
import pytest
from arrangements import relative

from bench.arrangements import trace
from bench.paper import __main__ as command
from bench.paper import crystal_balls
from bench.paper.output import ORDER, Output
from bench.paper.trials import Trial, run_trial
from bench.reference import oracle

MS = 1.7e6


def course(dynamics, bar, device, iterations=300, curve="tanh"):
    """Magnetization error of the crystal balls after each iteration."""
    system = crystal_balls.make_system(
        crystal_balls.STRENGTHS[bar], dynamics, device, curve=curve, max_evaluations=iterations
    )
    if dynamics != "theta":
        crystal_balls.set_pairs(system, "across")
    return trace(system, to_residual=True)


# ---------------------------------------------------------------------------------------------------------------------
# Claims
# ---------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("cells", [crystal_balls.CELLS, crystal_balls.OTHER_CELLS])
def test_there_are_178_crystal_balls_clear_of_the_bar(cells):
    place = crystal_balls.layout(cells)
    assert place.balls.shape == (178, 3)
    outside = np.maximum(np.abs(place.balls) - place.bar_half_extents, 0.0)
    assert np.linalg.norm(outside, axis=1).min() > crystal_balls.BALL_RADIUS
    assert place.bar.volumes.sum() == pytest.approx(8.0 * np.prod(place.bar_half_extents), rel=1e-12)


@pytest.mark.parametrize("bar", crystal_balls.STRENGTHS)
def test_theta_converges_within_ten_iterations_at_any_strength(bar, device):
    """Fig. 8 (b)."""
    errors = course("theta", bar, device)
    assert len(errors) <= 10 and errors[-1] <= 1e-3


def test_llg_is_slow_under_the_weak_bar_and_lost_under_the_strong_one(device):
    """Fig. 8 (a), (c): damping only is a little faster, and stays far from the solution under the strong bar, too."""
    slow, damped = (course(dynamics, "weak", device, curve="clamped") for dynamics in ("llg", "llg-damping"))
    assert slow[-1] <= 1e-3 and damped[-1] <= 1e-3
    assert 60 < len(damped) < len(slow)
    assert course("llg", "strong", device, curve="clamped").min() > 0.1
    assert course("llg-damping", "strong", device, curve="clamped")[-1] > 1e-2


@pytest.mark.parametrize("bar", crystal_balls.STRENGTHS)
def test_the_papers_own_step_converges_at_both_strengths(bar, device):
    errors = course("theta-euler", bar, device)
    assert 10 < len(errors) < 150 and errors[-1] <= 1e-3


def test_crystal_balls_have_the_oracles_equilibrium(device):
    system = crystal_balls.make_system(1e6, "theta", device, rtol=1e-9, dtype="float64")
    system.solve()
    place = crystal_balls.layout()
    exact = oracle.equilibrium(place.balls, crystal_balls.BALL_RADIUS, crystal_balls.applied_field(1e6), saturation=MS)
    assert relative(system.magnetizations().numpy()[:178], exact.magnetizations) < 1e-8


@pytest.fixture(scope="module")
def sweeps():
    """Counts of the small grid of Fig. 9 by dynamics, and the grid."""
    from bench.paper import fig9  # noqa: PLC0415 - Matplotlib

    grid = fig9.make_grid(True)
    return {case.dynamics: fig9.sweep(case, grid) for case in fig9.PANELS.values()}, grid


def test_theta_needs_at_most_two_iterations_in_every_cell(sweeps):
    """Fig. 9 (a); one where the step is exactly k."""
    counts, grid = sweeps
    assert counts["theta"].most.max() <= 2 and not counts["theta"].failed.any()
    assert (counts["theta"].most[:, grid.multipliers == 1.0] == 1).all()


def test_baseline_dynamics_fail_as_the_field_grows(sweeps):
    """Fig. 9 (b), (c): LLG fails in nearly all the plane, damping only beyond κ‖H‖ = 2 Ms."""
    counts, grid = sweeps
    strong = grid.strengths >= 8.0
    for dynamics, share in (("llg", 0.9), ("llg-damping", 0.3)):
        assert counts[dynamics].failed.mean() > share
        assert (counts[dynamics].failed[strong] == 1.0).all()
    assert counts["theta-euler"].failed.mean() < 0.01
    # An aligned pair that tilts as one comes back by 1 − κ‖H‖/Ms a step, one that opens by 1 − κ(‖H‖/Ms − 1/3).
    limit = 2.0 / (0.3 * grid.multipliers)
    stable = grid.strengths[:, None] < limit - 0.02
    unstable = grid.strengths[:, None] > limit + 1.0 / 3.0 + 0.02
    assert (counts["llg-damping"].failed[unstable] == 1.0).all()
    assert (counts["llg-damping"].failed[stable & (grid.strengths >= 0.5)[:, None]] == 0.0).all()


def test_sweep_counts_what_the_flow_needs():
    """In a weak field the plain flow's error is (1 − ω)ⁿ: the least n that brings it to the tolerance."""
    from bench.paper import fig9  # noqa: PLC0415 - Matplotlib

    grid = fig9.Grid(np.array([1.0, 1.15, 1.3, 1.45]), np.array([1e-4]), 8)
    counts = fig9.sweep(fig9.Case("theta-flow", "tanh", 3.0), grid)
    expected = [1] + [int(np.ceil(np.log(1e-3) / np.log(omega - 1.0))) for omega in (1.15, 1.3, 1.45)]
    assert counts.most[0].tolist() == expected and counts.mean[0].tolist() == expected


# ---------------------------------------------------------------------------------------------------------------------
# The command
# ---------------------------------------------------------------------------------------------------------------------


def test_every_figure_can_be_drawn(tmp_path, device):
    """The small version of each but the scenes: lines with machine and commit, pictures, one report in order."""
    names = [name for name in ORDER if name not in ("stability", "table1")]
    for name in reversed(names):
        assert command.main([name, "--small", "--device", device, "-o", str(tmp_path)]) == 0
        lines = [json.loads(line) for line in (tmp_path / f"{name}.jsonl").read_text().splitlines()]
        assert lines and all(line["small"] and {"machine", "commit", "device"} <= line.keys() for line in lines)
    report = (tmp_path / "report.md").read_text()
    at = [report.index(f"<!-- section {name} -->") for name in names]
    assert at == sorted(at)
    for name in names[:4]:
        assert f"![{name}]({name}.png)" in report and (tmp_path / f"{name}.png").stat().st_size > 10_000
    eq4 = [json.loads(line) for line in (tmp_path / "fig10.jsonl").read_text().splitlines()]
    # Eq. 4 is never the weaker law, and 24/3 of Kelvin's where f' = 3, to float32 of small differences
    assert all(1.0 <= line["smallest_ratio"] and line["largest_ratio"] < 8.01 for line in eq4)
    apart = [json.loads(line) for line in (tmp_path / "uniqueness.jsonl").read_text().splitlines()]
    agreed = [line for line in apart if line.get("converged")]
    assert len(agreed) >= 8 and all(line["from_newton"] < 1e-6 for line in agreed)


def test_a_part_of_a_section_stays_when_another_is_measured(tmp_path):
    for name, text, part in (
        ("table1", "old", "cpu"),
        ("fig7", "seven", ""),
        ("table1", "gpu", "gpu"),
        ("table1", "new", "cpu"),
    ):
        Output(name, tmp_path, "cpu", True).report(text, part)
    report = (tmp_path / "report.md").read_text()
    at = [
        report.index(text)
        for text in ("<!-- section fig7 -->\nseven", "<!-- section table1 cpu -->\nnew", "gpu -->\ngpu")
    ]
    assert at == sorted(at) and "old" not in report


def test_a_trial_ends_at_its_time_limit(device):
    """What is left is a row: however slow the method, a step was done and timed."""
    values = run_trial(Trial("balls_up", "kim2018", seconds=1.0, device=device, time_limit=0.1))
    assert 2 <= values["steps"] < 100 and values["simulated"] == pytest.approx(1e-3 * values["steps"])
    assert all(0.0 < values[key] < 1e4 for key in ("ti_ms", "tf_ms", "tr_ms")) and not values["ended"]


def test_bad_device_is_one_line(capsys):
    with pytest.raises(SystemExit) as raised:
        command.main(["fig7", "--device", "cuda:99"])
    assert raised.value.code == 2
    assert "device" in capsys.readouterr().err.splitlines()[-1]
