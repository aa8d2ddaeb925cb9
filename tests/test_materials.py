"""Materials by name: their numbers, in Python and on a stage."""

import math
from pathlib import Path

import newton
import numpy as np
import pytest
from pxr import Gf, Sdf, Usd, UsdGeom, UsdPhysics

import warpmag
from warpmag.declarations.materials import MATERIALS
from warpmag.engine.magnets.attributes import marked_shapes
from warpmag.errors import InputError
from warpmag.usd import author_magnet, read_magnets
from warpmag.usd.schemas import MATERIAL

MGOE = 1e5 / (4.0 * math.pi)  # J/m³
MU0 = 1.25663706212e-6  # CODATA 2018


@pytest.mark.parametrize("name", ["N35", "N42", "N52"])
def test_grades_are_named_after_their_energy_product(name):
    """An ideal magnet's is Br²/(4 μ0); grades go by whole MGOe, and their range of remanence is 3 to 4 % wide."""
    magnetization = warpmag.material(name).magnetization
    assert MU0 * magnetization**2 / 4.0 / MGOE == pytest.approx(float(name[1:]), rel=0.04)


def test_the_page_of_materials_has_all_of_them():
    page = (Path(__file__).parents[1] / "docs" / "materials.md").read_text(encoding="utf-8")
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in page.splitlines() if line.startswith("| ")][1:]
    assert {row[0]: row[2] for row in rows} == {
        name: f"{material.polarization:.4g}" for name, material in MATERIALS.items()
    }
    assert {row[0]: float(row[4]) for row in rows} == {name: material.density for name, material in MATERIALS.items()}


def test_materials_are_within_what_matter_does():
    for name, material in MATERIALS.items():
        assert material.name == name and material.source
        assert material.kind in ("inducible", "permanent")
        assert 0.3 < material.polarization < 2.45  # iron-cobalt, the strongest there is
        assert material.saturation * MU0 == pytest.approx(material.polarization, rel=1e-9)
        if material.kind == "inducible":
            assert material.susceptibility > 100.0


def ball(**magnet):
    builder = newton.ModelBuilder()
    warpmag.register_attributes(builder)
    body = builder.add_body()
    builder.add_shape_sphere(body, radius=0.005)
    add = warpmag.add_permanent if "direction" in magnet else warpmag.add_inducible
    add(builder, body=body, **magnet)
    return next(iter(marked_shapes(builder.finalize(device="cpu")).values()))


def test_bodies_of_named_materials():
    steel = warpmag.material("mild-steel")
    made = ball(material="mild-steel")
    np.testing.assert_allclose((made.saturation, made.susceptibility), (steel.saturation, steel.susceptibility), 1e-6)
    made = ball(material="N42", direction=(0.0, -3.0, 4.0))
    np.testing.assert_allclose(
        made.magnetization, warpmag.material("N42").magnetization * np.array([0, -0.6, 0.8]), 1e-6
    )
    made = ball()
    assert (made.saturation, made.susceptibility) == (np.float32(1.7e6), math.inf)


@pytest.mark.parametrize(
    "magnet,message",
    [
        ({"material": "adamantium"}, "'adamantium' is no inducible material; known are iron,"),
        ({"material": "N42"}, "'N42' is no inducible material"),
        ({"material": "iron", "direction": (0.0, 0.0, 1.0)}, "'iron' is no permanent material"),
        ({"material": "N42", "direction": (0.0, 0.0, 0.0)}, "direction of its magnetization, got zero"),
        ({"material": "iron", "saturation": 1e6}, "'iron' sets saturation"),
    ],
)
def test_bad_materials_are_refused(magnet, message):
    with pytest.raises(InputError, match=message):
        ball(**magnet)


def stage_with(material, **attributes):
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdPhysics.SetStageKilogramsPerUnit(stage, 1.0)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdPhysics.Scene.Define(stage, "/Scene")
    sphere = UsdGeom.Sphere.Define(stage, "/Ball")
    sphere.CreateRadiusAttr(0.005)
    prim = sphere.GetPrim()
    UsdPhysics.RigidBodyAPI.Apply(prim)
    UsdPhysics.CollisionAPI.Apply(prim)
    prim.AddAppliedSchema("WarpmagMagnetAPI")
    prim.CreateAttribute(MATERIAL, Sdf.ValueTypeNames.Token, custom=False).Set(material)
    for name, (kind, value) in attributes.items():
        prim.CreateAttribute(f"warpmag:{name}", kind, custom=False).Set(value)
    return stage


FLOAT = Sdf.ValueTypeNames.Float
PERMANENT = {"kind": (Sdf.ValueTypeNames.Token, "permanent")}


def test_prims_of_named_materials():
    magnet = read_magnets(stage_with("soft-ferrite")).magnets["/Ball"]
    ferrite = warpmag.material("soft-ferrite")
    assert (magnet.saturation, magnet.susceptibility) == (ferrite.saturation, ferrite.susceptibility)
    along = {"magnetization": (Sdf.ValueTypeNames.Vector3f, Gf.Vec3f(0.0, 2.0, 0.0))}
    magnet = read_magnets(stage_with("hard-ferrite", **PERMANENT, **along)).magnets["/Ball"]
    np.testing.assert_allclose(magnet.magnetization, (0.0, 0.385 / MU0, 0.0), rtol=1e-9)


def test_a_stage_written_with_the_numbers_reads_the_same():
    stage = stage_with("iron")
    magnet = read_magnets(stage).magnets["/Ball"]
    prim = stage.GetPrimAtPath("/Ball")
    prim.RemoveProperty(MATERIAL)
    author_magnet(prim, magnet)
    again = read_magnets(stage).magnets["/Ball"]
    np.testing.assert_allclose(
        (again.saturation, again.susceptibility), (magnet.saturation, magnet.susceptibility), 1e-6
    )


@pytest.mark.parametrize(
    "material,attributes,message",
    [
        ("adamantium", {}, "/Ball: warpmag:material: 'adamantium' is no inducible material"),
        ("iron", PERMANENT, "/Ball: warpmag:material: 'iron' is no permanent material"),
        ("N52", PERMANENT, "/Ball: warpmag:material: N52 needs the direction of its magnetization, got zero"),
        (
            "iron",
            {"saturationMagnetization": (Sdf.ValueTypeNames.Float, 1e6)},
            "/Ball: warpmag:material: iron sets",
        ),
    ],
)
def test_bad_prims_are_refused_by_name(material, attributes, message):
    with pytest.raises(InputError, match=message):
        read_magnets(stage_with(material, **attributes))
