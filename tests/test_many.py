"""Models of many magnets, whose fields and forces are sums by the fast multipole method."""

import newton
import numpy as np
import pytest
import warp as wp
from pxr import Usd

import warpmag
from bench.reference import oracle
from bench.systems import moment_system
from warpmag.cli import BAD_INPUT, main
from warpmag.engine.stepping.scene import import_scene
from warpmag.moments import fmm
from warpmag.scenes_usd import make
from warpmag.usd.read import identical_balls, instancers

RADIUS = 0.0025  # m
FIELD = (0.0, 1e4, 3e4)  # A/m
RTOL = 1e-3


def apart(a, b) -> float:
    """Relative difference, NaN where anything is."""
    return float(np.linalg.norm(np.asarray(a, float) - b) / np.linalg.norm(b))


def places_of(count: int, seed: int = 0) -> np.ndarray:
    """Places of ``count`` balls in a round clump, none of which touch [m]."""
    side = int(np.ceil((2.0 * count) ** (1 / 3)))
    axis = np.arange(side) - 0.5 * (side - 1)
    grid = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    near = grid[np.argsort(np.linalg.norm(grid, axis=1), kind="stable")[:count]]
    shifted = near + np.random.default_rng(seed).uniform(-0.15, 0.15, near.shape)
    return (3.0 * RADIUS * shifted).astype(np.float32).astype(float)


def new_builder() -> newton.ModelBuilder:
    builder = newton.ModelBuilder()
    warpmag.register_attributes(builder)
    return builder


def applied(magnetics, model) -> tuple[np.ndarray, np.ndarray]:
    """Forces [N] and torques [N·m] on bodies at their first poses."""
    state = model.state()
    magnetics.apply(state)
    result = state.body_f.numpy().astype(float)
    return result[:, :3], result[:, 3:]


@pytest.fixture(autouse=True)
def small_leaves(monkeypatch):
    """Leaves small enough for few magnets to be far from each other; their errors are larger than with usual ones."""
    monkeypatch.setattr(fmm, "_DEGREES", tuple((rtol, degree, 12) for rtol, degree, _ in fmm._DEGREES))


def far_cells(magnetics) -> bool:
    """Whether there are cells that are not neighbours, so that expansions count."""
    return magnetics.system._fast._octree.counts.numpy()[0] >= 2


def test_moments_and_forces_are_those_of_all_pairs(device):
    x, builder = places_of(1500), new_builder()
    warpmag.add_balls(builder, x, RADIUS)
    magnet = np.array([[0.0, 0.01, 0.08]]), np.array([[0.0, 0.3, 1.0]])  # m, A·m²
    volume = 4.0 / 3.0 * np.pi * 0.004**3
    warpmag.add_balls(builder, magnet[0], 0.004, magnetization=tuple(magnet[1][0] / volume))
    model = builder.finalize(device=device)
    magnetics = warpmag.Magnetics(model, method="fmm", external_field=FIELD)
    forces, torques = applied(magnetics, model)
    assert magnetics.system.is_fast
    assert far_cells(magnetics)
    assert 0.0 < magnetics.system.field_error() <= RTOL
    exact = warpmag.solve_induction(
        x, RADIUS, saturation=warpmag.declarations.magnets.SATURATION_OF_IRON, external_field=FIELD, permanent=magnet,
        method="direct", rtol=1e-6, dtype="float64", device="cpu",
    )  # fmt: skip
    moments = magnetics.system.moments.numpy().astype(float)
    assert apart(moments[:-1], exact.magnetizations * 4.0 / 3.0 * np.pi * RADIUS**3) <= RTOL
    every = np.concatenate([x, magnet[0]])
    gradient = oracle.field_gradient(every, moments, radii=np.append(np.full(len(x), RADIUS), 0.004))
    assert apart(forces, oracle.kelvin_force(moments, gradient)) <= RTOL
    turning = oracle.h_field(x, moments[:-1], magnet[0])[0] + FIELD
    scale = oracle.MU0 * np.linalg.norm(moments[-1]) * np.linalg.norm(turning)
    assert np.linalg.norm(torques[-1] - oracle.MU0 * np.cross(moments[-1], turning)) <= RTOL * scale
    # a pair's forces are one number of float32 and its opposite
    assert np.abs(forces.sum(axis=0)).max() <= 1e-6 * np.linalg.norm(forces, axis=1).sum()


def test_a_field_of_magnets_far_away_is_as_exact(device):
    """Fields of few magnets at balls that are far from them and from each other, of which no near pair is a part."""
    random, builder = np.random.default_rng(3), new_builder()
    warpmag.add_balls(builder, 4.0 * places_of(1000) + [0.0, 0.0, 0.7], RADIUS)
    for place in random.uniform(-0.2, 0.2, (30, 3)):
        along = random.standard_normal(3)
        warpmag.add_balls(builder, [place], 0.004, magnetization=tuple(6e6 * along / np.linalg.norm(along)))
    model = builder.finalize(device=device)
    magnetics = warpmag.Magnetics(model, method="fmm")
    applied(magnetics, model)
    assert far_cells(magnetics)
    assert magnetics.system.field_error() <= 0.3 * RTOL


def test_worlds_are_as_if_alone(device):
    x, clump, whole = places_of(400), new_builder(), new_builder()
    warpmag.add_balls(clump, x, RADIUS)
    for _ in range(3):
        whole.add_world(clump)
    model = whole.finalize(device=device)
    magnetics = warpmag.Magnetics(model, method="fmm", external_field=FIELD)
    strengths = np.array([[0.0, 0.0, 1e4], FIELD, [1e6, 0.0, 0.0]])
    magnetics.set_external_field(strengths)
    forces, _ = applied(magnetics, model)
    assert far_cells(magnetics)
    alone = clump.finalize(device=device)
    for own, field in zip(np.split(forces, 3), strengths, strict=True):
        expected, _ = applied(warpmag.Magnetics(alone, method="direct", external_field=tuple(field)), alone)
        # a force has the errors of two magnetizations, each of two solves
        assert apart(own, expected) <= 4.0 * RTOL


@pytest.fixture
def rods():
    """Bodies of two balls and of a magnet and a ball, turned at random; none of them touch."""
    random, builder = np.random.default_rng(5), new_builder()
    for place in places_of(300):
        turn = random.standard_normal(4)
        body = builder.add_body(xform=wp.transform(2.0 * place, wp.quat(*(turn / np.linalg.norm(turn)).tolist())))
        for end in (-1.0, 1.0):
            shape = builder.add_shape_sphere(body, xform=wp.transform((end * RADIUS, 0.0, 0.0)), radius=RADIUS)
            if end > 0.0 and body % 2:
                warpmag.add_permanent(builder, shape=shape, magnetization=(3e5, 2e5, 0.0))
            else:
                warpmag.add_inducible(builder, shape=shape)
    return builder


def test_bodies_of_several_moments_do_not_turn_themselves(rods, device):
    model = rods.finalize(device=device)
    magnetics = warpmag.Magnetics(model, method="fmm")
    actual, expected = (
        applied(entry, model) for entry in (magnetics, warpmag.Magnetics(model, method="direct", rtol=1e-5))
    )
    assert far_cells(magnetics)
    for own, exact in zip(actual, expected, strict=True):
        assert apart(own, exact) <= 3.0 * RTOL


def test_long_bodies_are_right_and_not_chosen(device, monkeypatch):
    """Of a chain of magnets in one body no part acts on another."""
    builder = new_builder()
    body = builder.add_body()
    for place in np.arange(300)[:, None] * [0.006, 0.002, 0.0]:
        shape = builder.add_shape_sphere(body, xform=wp.transform(tuple(place.tolist())), radius=RADIUS)
        warpmag.add_permanent(builder, shape=shape, magnetization=(0.0, 1e6, 0.0))
    warpmag.add_balls(builder, [[0.0, 0.1, 0.1]], RADIUS, magnetization=(0.0, 0.0, 1e6))
    model = builder.finalize(device=device)
    forces, torques = applied(warpmag.Magnetics(model, method="fmm"), model)
    monkeypatch.setattr(fmm, "_COSTS", dict.fromkeys(fmm._COSTS, (3e4, 0.0)))
    chosen = warpmag.Magnetics(model)
    assert not chosen.system.is_fast
    expected = applied(chosen, model)
    assert apart(forces, expected[0]) <= RTOL
    assert apart(torques, expected[1]) <= RTOL


def test_a_graph_does_what_launches_do(device):
    builder = new_builder()
    warpmag.add_balls(builder, places_of(600), RADIUS)
    model = builder.finalize(device=device)
    results = []
    for captured in (False, True):
        magnetics, state = warpmag.Magnetics(model, method="fmm", external_field=FIELD), model.state()
        magnetics.apply(state)
        magnetics.system.start_cold()
        state.body_q.assign(state.body_q.numpy() * np.float32(1.3))  # other cells
        state.clear_forces()
        if captured:
            with wp.ScopedCapture(device) as capture:
                magnetics.apply(state)
            wp.capture_launch(capture.graph)
        else:
            magnetics.apply(state)
        results.append(state.body_f.numpy())
    assert np.isfinite(results[0]).all()
    assert (results[0] == results[1]).all()


def test_a_run_of_a_scene_of_another_number_of_balls(device, tmp_path, capsys):
    out, scene = tmp_path / "out.usda", tmp_path / "falling_magnet_150.usdc"
    options = ["--method", "fmm", "--frames", "1", "--verbose", "--device", device, "-o", str(out)]
    assert main(["run", "falling_magnet", "--balls", "150", *options]) == 0
    printed = capsys.readouterr()
    assert "151 moving" in printed.out
    assert "of fields by multipoles" in printed.out
    assert f"scene: {scene}" in printed.err
    written = Usd.Stage.Open(str(out))
    balls = [written.GetPrimAtPath(f"/World/Balls/Ball_{number:05d}") for number in range(150)]
    moments = [ball.GetAttribute("warpmag:moment").Get(written.GetEndTimeCode()) for ball in balls]
    simulation = warpmag.Simulation(scene, method="direct", device=device)
    assert simulation.run(1).field_error == 0.0
    # of two solves, at places that differ by a hundredth of a ball
    assert apart(np.array(moments), simulation.magnetics.shape_moments()[:150]) <= 3.0 * RTOL
    assert main(["run", str(scene), "--balls", "3"]) == BAD_INPUT
    assert "--balls is for bundled scenes" in capsys.readouterr().err


def test_an_invalid_generated_scene_prints_one_line(tmp_path, capsys):
    (tmp_path / "file").write_text("no folder")
    for balls, folder, reason in (
        (3, "file", f"{tmp_path}/file/million_3.usdc: cannot be written (File exists)"),
        (10**15, "new", f"balls: not enough memory for {10**15}"),
    ):
        assert main(["run", "million", "--balls", str(balls), "-o", str(tmp_path / folder / "out.usda")]) == BAD_INPUT
        assert capsys.readouterr().err == f"warpmag: {reason}\n"


def test_instances_that_stay_one_prim_are_not_counted_as_prims(tmp_path, monkeypatch):
    monkeypatch.setattr(identical_balls, "COMPACT_COUNT", 50)
    monkeypatch.setattr(instancers, "MOST_PRIMS", 60)
    stage = make("million", tmp_path, 100)
    assert import_scene(stage).builder.body_count == 101
    monkeypatch.setattr(identical_balls, "COMPACT_COUNT", 200)
    with pytest.raises(warpmag.InputError, match="more than 60 prims"):
        import_scene(stage)


@pytest.mark.parametrize("place", [np.nan, np.inf, -np.inf, 1e30])
def test_a_place_that_is_no_place_makes_no_harm(place, device):
    """As at the end of a simulation that explodes: whoever looks finds what is not finite."""
    x = places_of(300)
    x[77, 1] = place
    system = moment_system(
        radii=np.full(300, RADIUS), saturation=1e6, external_field=FIELD, method="fmm", max_evaluations=5, device=device
    )
    system.positions.assign(x.astype(np.float32))
    system.solve()
    system.apply_forces()
    assert abs(place) == 1e30 or not np.isfinite(system.forces.numpy()).all()
    octree = system._fast._octree
    assert octree.moment_begin.numpy()[octree.level_begin.numpy()[1]] == 300


def test_auto_and_bad_arguments(device, monkeypatch):
    builder = new_builder()
    warpmag.add_balls(builder, places_of(300), RADIUS)
    model = builder.finalize(device=device)
    assert not warpmag.Magnetics(model).system.is_fast
    monkeypatch.setattr(fmm, "_COSTS", dict.fromkeys(fmm._COSTS, (3e4, 0.0)))
    assert warpmag.Magnetics(model).system.is_fast
    assert not warpmag.Magnetics(model, rtol=1e-5).system.is_fast
    with pytest.raises(warpmag.InputError, match="method: 'multipole' is not one of"):
        warpmag.Magnetics(model, method="multipole")
    with pytest.raises(warpmag.InputError, match="rtol: the fast multipole method reaches 3.4e-05, got 1e-05; use"):
        warpmag.Magnetics(model, method="fmm", rtol=1e-5)
    assert warpmag.Magnetics(model, method="fmm", rtol=3.4e-5).system.is_fast
