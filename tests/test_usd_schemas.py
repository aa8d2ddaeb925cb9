"""The codeless schemas: registration, fallbacks and the round trip of every attribute."""

import dataclasses
import math
import subprocess
import sys

import newton
import numpy as np
import pytest
from pxr import Plug, Sdf, Usd, UsdGeom, UsdPhysics

import warpmag
from warpmag.declarations.attributes import attributes_of
from warpmag.declarations.coils import Coil, FieldMap
from warpmag.declarations.magnets import Magnet, MagneticSettings
from warpmag.declarations.schemas import SCHEMAS
from warpmag.errors import InputError
from warpmag.kernels.rigid.bodies import ShapeMagnets
from warpmag.usd import (
    author_coil,
    author_field_map,
    author_magnet,
    author_settings,
    magnet_of,
    open_stage,
    read_magnets,
    schemas,
    triangulate_concave_faces,
)
from warpmag.usd.schema_text import SCHEMA_FILE, schema_text

MAGNETS = {
    "/Iron": Magnet(saturation=1.2e6, susceptibility=3.5, curve="langevin", moment_spacing=0.125),
    "/Ideal": Magnet(),
    "/Steel": Magnet(curve="clamped", susceptibility=1e-3),
    "/Bar": Magnet(kind="permanent", magnetization=(1e6, -2.5e5, 0.125), moment_spacing=0.25),
}
SETTINGS = MagneticSettings(external_field=(1e3, -2e4, 0.5), force="zeeman", dynamics="theta-euler", rtol=1e-4)


def author_stage(path):
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    author_settings(UsdPhysics.Scene.Define(stage, "/Scene").GetPrim(), SETTINGS)
    for name, magnet in MAGNETS.items():
        prim = UsdGeom.Sphere.Define(stage, name).GetPrim()
        UsdPhysics.RigidBodyAPI.Apply(prim)
        UsdPhysics.CollisionAPI.Apply(prim)
        author_magnet(prim, magnet)
    stage.Save()
    return stage


@pytest.mark.parametrize("suffix", ["usda", "usdc"])
def test_every_attribute_survives_the_round_trip(tmp_path, suffix):
    path = tmp_path / f"magnets.{suffix}"
    author_stage(path)
    read = read_magnets(open_stage(path))
    assert read.magnets == MAGNETS
    assert read.settings == SETTINGS
    assert read.initial_moments == {}


def test_every_attribute_is_authored(tmp_path):
    """Newton tests for authored values: a fallback is invisible to it."""
    stage = author_stage(tmp_path / "magnets.usda")
    for name in MAGNETS:
        authored = {a.GetName() for a in stage.GetPrimAtPath(name).GetAuthoredAttributes()}
        assert {f"warpmag:{n}" for n in ("kind", "curve", "magnetization", "momentSpacing")} <= authored
        assert {"warpmag:saturationMagnetization", "warpmag:susceptibility"} <= authored


def test_fallbacks_are_the_defaults_of_the_records():
    stage = Usd.Stage.CreateInMemory()
    ball = UsdGeom.Sphere.Define(stage, "/Ball").GetPrim()
    scene = UsdPhysics.Scene.Define(stage, "/Scene").GetPrim()
    assert ball.CanApplyAPI(schemas.MAGNET_API) and scene.CanApplyAPI(schemas.SCENE_API)
    assert not ball.CanApplyAPI(schemas.SCENE_API)
    ball.AddAppliedSchema(schemas.MAGNET_API)
    scene.AddAppliedSchema(schemas.SCENE_API)
    assert schemas.magnet_of(ball) == Magnet()
    assert schemas.settings_of(scene) == MagneticSettings()


def test_the_schema_file_follows_from_the_table_of_attributes():
    """After a change of the table: python -m warpmag.usd.schema_text."""
    assert SCHEMA_FILE.read_text(encoding="utf-8") == schema_text()


@pytest.mark.parametrize("schema", SCHEMAS, ids=lambda schema: schema.name)
def test_usd_knows_every_row_of_the_table(schema):
    """Names, types, variability, tokens and defaults, as USD registers them."""
    definition = Usd.SchemaRegistry().FindAppliedAPIPrimDefinition(schema.name)
    assert set(definition.GetPropertyNames()) == {row.usd_name for row in schema.attributes}
    assert {field.name for field in dataclasses.fields(schema.record)} <= {row.field for row in schema.attributes}
    for row in schema.attributes:
        spec = definition.GetSchemaAttributeSpec(row.usd_name)
        assert str(spec.typeName) == row.usd_type
        assert tuple(spec.allowedTokens or ()) == row.tokens
        assert (spec.variability == Sdf.VariabilityUniform) == row.uniform
        assert spec.documentation
        if isinstance(row.default, (str, bool)) or row.default is None:
            assert spec.default == row.default
        else:  # single precision keeps seven digits
            np.testing.assert_array_equal(np.ravel(spec.default), np.ravel(np.float32(row.default)))


def test_models_and_kernels_have_every_row_of_magnets():
    """Newton's arrays, and the struct in which kernels compare all but magnetizations."""
    builder = newton.ModelBuilder()
    warpmag.register_custom_attributes(builder)
    rows = attributes_of(Magnet)
    assert {f"warpmag:{row.field}" for row in rows} < set(builder.custom_attributes)
    assert set(ShapeMagnets.vars) == {row.field for row in rows if row.model_change != "substep"}


def test_registering_twice_is_harmless():
    folder = schemas.Path(schemas.__file__).parent / "schema"
    assert Plug.Registry().RegisterPlugins(str(folder)) == []


def test_reading_works_even_where_registration_came_too_late(tmp_path):
    """USD fixes its schemas at the first stage of a process; another library may have opened one already."""
    author_stage(tmp_path / "magnets.usda")
    program = (
        "import sys\nfrom pxr import Usd, UsdGeom\n"
        "stage = Usd.Stage.CreateInMemory()\nUsdGeom.Sphere.Define(stage, '/A').GetRadiusAttr().Get()\n"
        "from warpmag.usd import open_stage, read_magnets\n"
        "print(len(read_magnets(open_stage(sys.argv[1])).magnets))"
    )
    done = subprocess.run(
        [sys.executable, "-c", program, str(tmp_path / "magnets.usda")], capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == str(len(MAGNETS))


def test_import_of_warpmag_needs_no_usd():
    done = subprocess.run(
        [sys.executable, "-c", "import sys, warpmag, warpmag.declarations.magnets; print('pxr' in sys.modules)"],
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.strip() == "False"


@pytest.mark.parametrize("magnet", [Magnet(saturation=-1.0), Magnet(saturation=math.nan), Magnet(kind="iron")])
def test_authoring_refuses_bad_magnets(magnet):
    stage = Usd.Stage.CreateInMemory()
    with pytest.raises(InputError, match=r"^/Ball: "):
        author_magnet(UsdGeom.Sphere.Define(stage, "/Ball").GetPrim(), magnet)


AUTHORS = {
    author_magnet: Magnet(),
    author_settings: MagneticSettings(),
    author_coil: Coil(radius=0.01),
    author_field_map: FieldMap((0.0,) * 3, (0.01,) * 3, np.ones((2, 2, 2, 3))),
}


def prims():
    """A stage, and prims by kind of which only the first can be authored."""
    stage = Usd.Stage.CreateInMemory()
    ball = UsdGeom.Sphere.Define(stage, "/World/Ball").GetPrim()
    copy = stage.DefinePrim("/Copy")
    copy.GetReferences().AddInternalReference("/World")
    copy.SetInstanceable(True)
    lost = Usd.Stage.CreateInMemory().DefinePrim("/Ball")
    proxy = stage.GetPrimAtPath("/Copy/Ball")
    return stage, {"right": ball, "root": stage.GetPseudoRoot(), "proxy": proxy, "null": Usd.Prim(), "lost": lost}


@pytest.mark.parametrize("wrong", ["root", "proxy", "null", "lost", None, "/World/Ball", 3])
def test_wrong_prim(wrong):
    stage, kinds = prims()
    prim, message = kinds.get(wrong, wrong), "is the root of" if wrong in ("root", "proxy") else "must be a valid"
    for author, record in AUTHORS.items():
        with pytest.raises(InputError, match=f"^prim: .*{message}[^\n]*$"):
            author(prim, record)
    if wrong not in ("root", "proxy"):
        with pytest.raises(InputError, match="^prim: must be a valid Usd.Prim, got "):
            magnet_of(prim)
    assert not stage.GetPrimAtPath("/World/Ball").GetAuthoredAttributes()


@pytest.mark.parametrize("author", AUTHORS)
def test_wrong_record(author):
    stage, kinds = prims()
    for record in (None, "magnet", {}, np.ones(3), *(other for key, other in AUTHORS.items() if key is not author)):
        with pytest.raises(InputError, match=r"^(magnet|settings|coil|field_map): must be a \w+, got [^\n]*$"):
            author(kinds["right"], record)
    assert not stage.GetPrimAtPath("/World/Ball").GetAuthoredAttributes()


@pytest.mark.parametrize("stage", [None, "scene.usda", 3, Usd.Prim, np.ones(3)])
def test_wrong_stage(stage):
    for function in (read_magnets, triangulate_concave_faces):
        with pytest.raises(InputError, match="^stage: must be a Usd.Stage, got "):
            function(stage)


@pytest.mark.parametrize("time_code", ["x", math.nan, math.inf, [1.0], np.ones(3), True, 1j, Usd.Prim()])
def test_wrong_time_code(time_code, tmp_path):
    author_stage(tmp_path / "magnets.usda")
    with pytest.raises(InputError, match="^time_code: (must be |cannot be read )"):
        open_stage(tmp_path / "magnets.usda", time_code)


def test_numbers_of_numpy_are_authored():
    _stage, kinds = prims()
    numbers = {"saturation": np.float32(1e6), "susceptibility": np.int64(3), "moment_spacing": np.float64(0.5)}
    author_magnet(kinds["right"], Magnet(**numbers, magnetization=np.array([1, 2, 3])))
    magnet = magnet_of(kinds["right"])
    assert {name: getattr(magnet, name) for name in numbers} == numbers
    assert magnet.magnetization == (1.0, 2.0, 3.0)


@pytest.mark.parametrize(
    "values", [{"magnetization": "x"}, {"magnetization": (1.0, 2.0)}, {"recoil_permeability": -1.0}]
)
def test_attributes_of_the_other_kind_are_checked(values):
    """All of them are authored, so that a stage would have them."""
    stage, kinds = prims()
    with pytest.raises(InputError, match="^/World/Ball: (magnetization|recoil permeability): "):
        author_magnet(kinds["right"], Magnet("inducible", **values))
    assert not stage.GetPrimAtPath("/World/Ball").GetAuthoredAttributes()


@pytest.mark.parametrize("points", [3, 1j, np.array(1.0), None])
@pytest.mark.parametrize("shape", [{"radius": 0.01}, {"shape": "polyline"}])
def test_points_of_a_coil_that_are_none(shape, points):
    with pytest.raises(InputError, match="^coil: points: must be vectors, got "):
        Coil(**shape, points=points).check("coil")


@pytest.mark.parametrize("values", [[[1.0], [2.0, 3.0]], [], None, np.zeros((2, 2, 2)), [[[["x"] * 3] * 2] * 2] * 2])
def test_values_of_a_map_that_are_none(values):
    with pytest.raises(InputError, match=r"^map: values: [^\n]*$"):
        FieldMap((0.0,) * 3, (0.01,) * 3, values).check("map")
