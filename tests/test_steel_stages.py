"""Stages of measured materials: what their curves are read as, and what bodies of them weigh."""

import math

import numpy as np
import pytest
from pxr import Sdf, UsdGeom, UsdPhysics, UsdShade

import warpmag
from tests.test_materials import FLOAT, stage_with
from warpmag import MagnetizationCurve
from warpmag.declarations.materials import MATERIALS
from warpmag.engine.stepping.scene import import_scene
from warpmag.errors import InputError
from warpmag.usd import author_magnet, read_magnets

DOUBLE = Sdf.ValueTypeNames.DoubleArray
GOOD = [0.0, 100.0, 1e3, 1e4, 1e5], [0.0, 0.5, 1.3, 1.7, 2.0]  # A/m, T


def test_curves_on_a_stage():
    h, b = (list(map(float, values)) for values in GOOD)
    named = stage_with("", curve=(Sdf.ValueTypeNames.Token, "M-19"))
    given = stage_with("", **{"curve:h": (DOUBLE, h), "curve:b": (DOUBLE, b)})
    of_material = stage_with("M-19")
    curves = [read_magnets(stage).magnets["/Ball"].curve for stage in (named, given, of_material)]
    assert curves == [MATERIALS["M-19"].curve, MagnetizationCurve.from_bh(h, b), MATERIALS["M-19"].curve]
    for curve in curves[:2]:
        stage = stage_with("")
        author_magnet(stage.GetPrimAtPath("/Ball"), warpmag.declarations.magnets.Magnet(curve=curve))
        again = read_magnets(stage).magnets["/Ball"].curve
        np.testing.assert_allclose(again.magnetizations, curve.magnetizations, rtol=1e-9)
    assert UsdGeom.Sphere(stage.GetPrimAtPath("/Ball"))


@pytest.mark.parametrize(
    "material,attributes,message",
    [
        ("M-19", {"susceptibility": (FLOAT, 9.0)}, "M-19 sets warpmag:susceptibility"),
        ("M-19", {"curve": (Sdf.ValueTypeNames.Token, "tanh")}, "M-19 sets warpmag:curve"),
        (
            "M-19",
            {"curve": (Sdf.ValueTypeNames.Token, "1010-steel")},
            "M-19 sets the magnetization curve",
        ),
        ("iron", {"curve": (Sdf.ValueTypeNames.Token, "1010-steel")}, "iron sets the magnetization curve"),
        ("", {"curve:h": (DOUBLE, [0.0, 1e3])}, "warpmag:curve:h and warpmag:curve:b: 2 fields, but 0 values"),
        ("", {"curve:b": (DOUBLE, [0.0, 1.3])}, "warpmag:curve:h and warpmag:curve:b: 0 fields, but 2 values"),
        (
            "",
            {"curve:h": (DOUBLE, GOOD[0]), "curve:b": (DOUBLE, GOOD[1]), "saturationMagnetization": (FLOAT, 1e6)},
            "warpmag:saturationMagnetization: a measured curve sets it",
        ),
        (
            "",
            {"curve:h": (DOUBLE, [0.0, 1e3, 1e4]), "curve:b": (DOUBLE, [0.0, 1.5, 1.2])},
            "M = B/μ0 − H must not fall",
        ),
    ],
)
def test_bad_curves_on_a_stage_are_refused_by_name(material, attributes, message):
    with pytest.raises(InputError, match=f"^/Ball: .*{message}"):
        read_magnets(stage_with(material, **attributes))


def mass_of(tmp_path, material, edit=lambda stage: None):
    """Mass [kg] of a ball of 5 mm of a material after ``edit``, as Newton imports it from a file."""
    stage = stage_with(material)
    edit(stage)
    path = tmp_path / "scene.usda"
    stage.Export(str(path))
    scene = import_scene(path)
    return scene.builder.body_mass[scene.bodies["/Ball"]]


VOLUME = 4.0 / 3.0 * math.pi * 0.005**3


@pytest.mark.parametrize("material", ["1010-steel", "soft-ferrite", ""])
def test_a_magnet_weighs_what_its_material_does(tmp_path, material):
    density = MATERIALS[material].density if material else 1000.0  # Newton's own
    assert mass_of(tmp_path, material) == pytest.approx(density * VOLUME, rel=1e-5)


def _mass_of_ball(stage):
    UsdPhysics.MassAPI.Apply(stage.GetPrimAtPath("/Ball")).CreateMassAttr(0.25)


def _density_of_ball(stage):
    UsdPhysics.MassAPI.Apply(stage.GetPrimAtPath("/Ball")).CreateDensityAttr(0.25 / VOLUME)


def _density_of_bound_material(stage):
    bound = UsdShade.Material.Define(stage, "/Looks")
    UsdPhysics.MaterialAPI.Apply(bound.GetPrim()).CreateDensityAttr(0.25 / VOLUME)
    UsdShade.MaterialBindingAPI.Apply(stage.GetPrimAtPath("/Ball")).Bind(bound)


@pytest.mark.parametrize("edit", [_mass_of_ball, _density_of_ball, _density_of_bound_material])
def test_what_a_stage_says_of_its_weight_counts(tmp_path, edit):
    assert mass_of(tmp_path, "1010-steel", edit) == pytest.approx(0.25, rel=1e-5)


def _mass_without_its_schema(stage):
    stage.GetPrimAtPath("/Ball").CreateAttribute("physics:mass", FLOAT).Set(0.25)


def test_a_mass_without_its_schema_goes_on_having_no_effect(tmp_path):
    density = MATERIALS["1010-steel"].density
    assert mass_of(tmp_path, "1010-steel", _mass_without_its_schema) == pytest.approx(density * VOLUME, rel=1e-5)


def test_a_body_of_several_parts_weighs_what_each_is_made_of(tmp_path):
    def with_lid(stage):
        lid = UsdGeom.Cube.Define(stage, "/Ball/Lid")
        lid.CreateSizeAttr(0.002)
        UsdPhysics.CollisionAPI.Apply(lid.GetPrim())
        UsdPhysics.MassAPI.Apply(lid.GetPrim()).CreateMassAttr(0.01)

    density = MATERIALS["M-19"].density
    assert mass_of(tmp_path, "M-19", with_lid) == pytest.approx(density * VOLUME + 0.01, rel=1e-5)


def test_densities_are_those_of_matter():
    """Density of iron: 7,874 kg/m³ (CRC Handbook), of its alloys and oxides 3,000 to 9,000."""
    assert MATERIALS["pure-iron"].density == pytest.approx(7874.0, rel=1e-3)
    assert all(3e3 < material.density < 9e3 for material in MATERIALS.values())
