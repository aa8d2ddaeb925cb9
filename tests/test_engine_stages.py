"""Runs of a stage: what is imported, at which steps frames stand, and which moments they have."""

import math

import magpylib
import numpy as np
import pytest
from pxr import Gf, Usd, UsdGeom, UsdPhysics

from bench.reference import oracle
from warpmag.declarations.magnets import Magnet
from warpmag.engine.stepping.simulation import Simulation
from warpmag.scenes_usd import balls_up
from warpmag.usd import author_magnet

R = 0.005  # m


@pytest.fixture(scope="module")
def stage_run(device, tmp_path_factory):
    """A small Balls Up, run for six frames and written."""
    folder = tmp_path_factory.mktemp("run")
    balls_up.author(folder / "scene.usda", columns=2, rows=2, layers=1, height=0.05)
    simulation = Simulation(folder / "scene.usda", device=device)
    shown = []
    simulation.run(6, output=folder / "out.usda", on_frame=shown.append)
    return simulation, folder, shown


def test_a_stage_is_imported_with_its_magnets(stage_run):
    simulation, _, _ = stage_run
    kinds = [magnet.magnet.kind for magnet in simulation.magnetics.magnets]
    assert kinds == ["inducible"] * 4 + ["permanent"]
    assert simulation.statistics.magnets == 4
    assert simulation.step_size == pytest.approx(1e-3)
    assert simulation.frame_count == 180


def test_frames_stand_at_the_steps_nearest_to_them(stage_run):
    simulation, folder, shown = stage_run
    assert shown == list(range(7))
    stage = Usd.Stage.Open(str(folder / "out.usda"))
    ball = stage.GetPrimAtPath("/World/Balls/Ball_0003")
    codes = ball.GetAttribute("xformOp:translate:warpmag").GetTimeSamples()
    steps = [0, 17, 33, 50, 67, 83, 100]  # 1 ms steps at 60 frames per second
    np.testing.assert_allclose(codes, [60.0 * 1e-3 * step for step in steps], atol=1e-9)
    last = ball.GetAttribute("xformOp:translate:warpmag").Get(codes[-1])
    np.testing.assert_allclose(last, simulation.state.body_q.numpy()[-1, :3], atol=1e-7)


def test_moments_of_the_stage_are_those_of_the_run(stage_run):
    simulation, folder, _ = stage_run
    stage = Usd.Stage.Open(str(folder / "out.usda"))
    moments = {
        str(prim.GetPath()): np.array(prim.GetAttribute("warpmag:moment").Get(6.0))
        for prim in stage.Traverse()
        if prim.GetAttribute("warpmag:moment")
    }
    assert len(moments) == 5
    np.testing.assert_allclose(moments["/World/Magnet"], (0.0, 0.0, 1e6 * 0.04**3), rtol=1e-6)
    total = sum(moments.values())
    np.testing.assert_allclose(total, simulation.magnetics.shape_moments().sum(axis=0), atol=1e-6 * 64.0)


def test_the_first_frame_has_the_moments_of_the_start(stage_run):
    """Before any step: what the float64 reference finds in the cube's closed-form field, to the solve's 1e-3."""
    _, folder, _ = stage_run
    stage = Usd.Stage.Open(str(folder / "out.usda"))
    balls = [f"/World/Balls/Ball_{number:04d}" for number in range(4)]
    moments = {
        path: np.array(stage.GetAttributeAtPath(f"{path}.warpmag:moment").Get(0.0))
        for path in ("/World/Magnet", *balls)
    }
    np.testing.assert_allclose(moments["/World/Magnet"], (0.0, 0.0, 1e6 * 0.04**3), rtol=1e-6)
    places = np.array([stage.GetAttributeAtPath(f"{path}.xformOp:translate").Get() for path in balls])
    cube = magpylib.magnet.Cuboid(dimension=(0.04,) * 3, magnetization=(0.0, 0.0, 1e6), position=(0.0, 0.0, 0.05))
    balance = oracle.equilibrium(places, R, cube.getH(places), saturation=1.7e6)
    expected = balance.magnetizations * 4.0 / 3.0 * math.pi * R**3
    np.testing.assert_allclose([moments[path] for path in balls], expected, atol=2e-3 * np.abs(expected).max())


def test_to_be_recorded_changes_no_bit_of_a_run(stage_run, device):
    """The moments of the first frame are solved for beside the run, which still starts from none."""
    simulation, folder, _ = stage_run
    alone = Simulation(folder / "scene.usda", device=device)
    for _ in range(100):
        alone.step()
    np.testing.assert_array_equal(alone.state.body_q.numpy(), simulation.state.body_q.numpy())
    np.testing.assert_array_equal(alone.magnetics.shape_moments(), simulation.magnetics.shape_moments())


def test_magnetization_of_a_collider_prim_is_in_its_own_frame(device, tmp_path):
    stage = Usd.Stage.CreateNew(str(tmp_path / "rod.usda"))
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdGeom.SetStageUpAxis(stage, "Z")
    UsdPhysics.Scene.Define(stage, "/Scene")
    body = UsdGeom.Xform.Define(stage, "/Rod")
    UsdPhysics.RigidBodyAPI.Apply(body.GetPrim())
    rod = UsdGeom.Cylinder.Define(stage, "/Rod/Shape")
    rod.CreateAxisAttr("X")
    rod.CreateRadiusAttr(0.005)
    rod.CreateHeightAttr(0.04)
    rod.AddRotateZOp().Set(90.0)
    UsdPhysics.CollisionAPI.Apply(rod.GetPrim())
    author_magnet(rod.GetPrim(), Magnet("permanent", magnetization=(1e6, 0.0, 0.0)))
    body.AddTranslateOp().Set(Gf.Vec3d(0.0, 0.0, 1.0))
    stage.Save()
    simulation = Simulation(tmp_path / "rod.usda", device=device)
    simulation.magnetics.apply(simulation.state)
    moment = 1e6 * math.pi * 0.005**2 * 0.04
    np.testing.assert_allclose(simulation.magnetics.shape_moments(), [(0.0, moment, 0.0)], atol=1e-5 * moment)
