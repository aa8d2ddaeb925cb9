"""The option ``magnetic`` of MJCF, as external field of models and stages."""

import math

import numpy as np
import pytest
from pxr import Gf, Sdf, Usd, UsdPhysics
from small_builders import new_builder

import warpmag
from warpmag.scenes_usd import balls_up
from warpmag.usd import check

MU0 = 4e-7 * math.pi
B = 0.02  # T


def imported(option):
    builder = new_builder()
    builder.add_mjcf(
        f"<mujoco>{option}<worldbody><body name='ball'><freejoint/><geom type='sphere' size='0.005'/></body>"
        "</worldbody></mujoco>"
    )
    warpmag.add_inducible(builder, body="ball")
    return builder


def test_the_field_of_an_mjcf_magnetizes_iron(device):
    """It was dropped without a word. An ideally permeable ball has 3 H0, less (3 H0 / Ms)² / 3 by the tanh curve."""
    model = imported(f"<option magnetic='0 0 {B}'/>").finalize(device=device)
    with pytest.warns(UserWarning, match=r"the option magnetic of MuJoCo, \(0, 0, 0.02\) T, becomes the ext") as caught:
        magnetics = warpmag.Magnetics(model)
    assert caught[0].filename == __file__
    with pytest.warns(UserWarning, match="magnetic of MuJoCo") as caught:
        warpmag.Simulation(imported(f"<option magnetic='0 0 {B}'/>"), device=device)
    assert caught[0].filename == __file__  # as deep as it may be
    magnetics.apply(model.state())
    moment = 1.7e6 * math.tanh(3.0 * B / MU0 / 1.7e6) * 4.0 / 3.0 * math.pi * 0.005**3
    np.testing.assert_allclose(magnetics.sum_moments().numpy(), [[0.0, 0.0, moment]], rtol=2e-3, atol=1e-6)  # rtol 1e-3


@pytest.mark.parametrize("option, given", [("", {}), ("<option magnetic='0 0 1'/>", {"external_field": (0.0,) * 3})])
def test_the_default_of_mujoco_and_a_field_of_the_user_are_no_surprise(option, given, device, recwarn):
    magnetics = warpmag.Magnetics(imported(option).finalize(device=device), **given)
    assert not magnetics.external_field.numpy().any()
    assert not [warning for warning in recwarn if "magnetic of MuJoCo" in str(warning.message)]


def test_the_field_of_an_mjcf_as_stage(tmp_path, device):
    path = tmp_path / "scene.usda"
    balls_up.author(path, columns=1, rows=1, layers=1)
    stage = Usd.Stage.Open(str(path))
    (scene,) = (prim for prim in stage.Traverse() if prim.IsA(UsdPhysics.Scene))
    scene.CreateAttribute("mjc:option:magnetic", Sdf.ValueTypeNames.Double3).Set(Gf.Vec3d(0.0, B, 0.0))
    scene.RemoveProperty("warpmag:externalField")
    stage.Save()
    report = check(path)
    assert report.contents.settings.external_field == pytest.approx((0.0, B / MU0, 0.0))
    (line,) = (str(finding) for finding in report.warnings if "magnetic of MuJoCo" in str(finding))
    assert str(scene.GetPath()) in line and "warpmag:externalField sets another" in line
    simulation = warpmag.Simulation(path, device=device)
    assert simulation.magnetics.external_field.numpy()[0] == pytest.approx((0.0, B / MU0, 0.0))
    assert line in simulation.warnings()
    scene.CreateAttribute("warpmag:externalField", Sdf.ValueTypeNames.Vector3f).Set(Gf.Vec3f(0.0))
    stage.Save()
    assert check(path).contents.settings.external_field == (0.0, 0.0, 0.0)


def test_a_simulation_of_an_mjcf_has_its_field(device):
    with pytest.warns(UserWarning, match="becomes the external field"):
        simulation = warpmag.Simulation(imported(f"<option magnetic='{B} 0 0'/>"), device=device)
    assert simulation.magnetics.external_field.numpy()[0] == pytest.approx((B / MU0, 0.0, 0.0))
