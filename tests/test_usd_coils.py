"""Coils and field maps on stages: what is read, what a run makes of it, and one line for each that is refused."""

import dataclasses
import math

import numpy as np
import pytest
from pxr import Usd, UsdGeom

import warpmag
from warpmag import cli
from warpmag.declarations.attributes import attributes_of
from warpmag.declarations.coils import Coil, FieldMap
from warpmag.declarations.schemas import COIL_SCHEMA, FIELD_MAP_SCHEMA
from warpmag.errors import InputError
from warpmag.usd import author_coil, author_field_map, check, open_stage, survey
from warpmag.usd.schemas import read_fields

HEAD = '#usda 1.0\n(\n    metersPerUnit = 1\n    kilogramsPerUnit = 1\n    upAxis = "Z"\n)\n'
BALL = """
def Sphere "Ball" (prepend apiSchemas = ["PhysicsRigidBodyAPI", "PhysicsCollisionAPI", "WarpmagMagnetAPI"])
{
    double radius = 0.005
}
"""
COILS = {
    "/Driven": Coil(radius=0.25, resistance=2.5, voltage=-0.5, turns=30.0, inductance=0.125),
    "/Loop": Coil(radius=0.25, wire_radius=0.125, ampere_turns=-2.5),
    "/Solenoid": Coil("solenoid", radius=0.25, length=2.0, ampere_turns=1e3),
    "/Polyline": Coil("polyline", points=((0.0, 0.0, 0.0), (1.0, 0.5, 0.0), (0.0, 0.0, 2.0))),
    "/Open": Coil("polyline", points=((0.0, 0.0, 0.0), (1.0, 0.5, 0.0)), closed=False),
}
VALUES = np.random.default_rng(0).normal(size=(2, 3, 4, 3)).astype(np.float32).astype(float)
MAP = FieldMap((0.5, 0.25, -1.0), (0.5, 0.25, 1.0), VALUES, 2.0)


def write(folder, *prims):
    path = folder / "stage.usda"
    path.write_text(HEAD + BALL + "\n".join(prims))
    return path


def prim(api, *lines, name="Thing", kind="Xform"):
    return "\n".join([f'def {kind} "{name}" (prepend apiSchemas = ["{api}"])', "{", *lines, "}", ""])


def coil(*lines, **where):
    return prim("WarpmagCoilAPI", *lines, **where)


def field_map(*lines, **where):
    return prim("WarpmagFieldMapAPI", *lines, **where)


@pytest.mark.parametrize("suffix", ["usda", "usdc"])
def test_every_attribute_survives_the_round_trip(tmp_path, suffix):
    path = tmp_path / f"coils.{suffix}"
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    for name, source in COILS.items():
        author_coil(UsdGeom.Xform.Define(stage, name).GetPrim(), source)
    author_field_map(UsdGeom.Xform.Define(stage, "/Map").GetPrim(), MAP)
    stage.Save()
    sources = survey(open_stage(path)).sources
    assert list(sources) == [*COILS, "/Map"]
    for name, source in COILS.items():
        assert [placed.source for placed in sources[name]] == [source]
    read = sources["/Map"][0].source
    assert (read.origin, read.spacing, read.factor) == (MAP.origin, MAP.spacing, MAP.factor)
    np.testing.assert_array_equal(read.values, VALUES)
    authored = {attribute.GetName() for attribute in stage.GetPrimAtPath("/Loop").GetAuthoredAttributes()}
    assert authored == {row.usd_name for row in attributes_of(Coil)}  # a run writes the current


def test_fallbacks_are_the_defaults_of_the_records():
    stage = Usd.Stage.CreateInMemory()
    coil, field_map = (UsdGeom.Xform.Define(stage, name).GetPrim() for name in ("/Coil", "/Map"))
    coil.AddAppliedSchema("WarpmagCoilAPI")
    field_map.AddAppliedSchema("WarpmagFieldMapAPI")
    assert read_fields(coil, COIL_SCHEMA.attributes) == dataclasses.asdict(Coil()) | {"current": 0.0}
    assert read_fields(field_map, FIELD_MAP_SCHEMA.attributes) == {"origin": (0.0, 0.0, 0.0), "factor": 1.0}


def test_a_run_has_the_coils_of_its_stage_in_their_places(tmp_path, device):
    """Turned, scaled, on a body and in the world; a map, too; and by its path a coil is switched."""
    places = """
    def Xform "Board" (prepend apiSchemas = ["PhysicsRigidBodyAPI"])
    {
        float3 xformOp:rotateXYZ = (90, 0, 0)
        double3 xformOp:translate = (0.1, 0.2, 0.3)
        uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateXYZ"]
        def Cube "Plate" (prepend apiSchemas = ["PhysicsCollisionAPI"]) { double size = 0.01
        }
        def Xform "Coil" (prepend apiSchemas = ["WarpmagCoilAPI"])
        {
            float warpmag:coil:radius = 0.02
            float warpmag:coil:ampereTurns = 50
            double3 xformOp:translate = (0, 0, 0.5)
            float3 xformOp:scale = (2, 2, 2)
            uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:scale"]
        }
    }
    """
    nodes = ", ".join(["(0, 7, 0)"] * 8)
    area = field_map(
        "point3f warpmag:fieldMap:origin = (-2, -2, -2)",
        "vector3f warpmag:fieldMap:spacing = (4, 4, 4)",
        "int3 warpmag:fieldMap:counts = (2, 2, 2)",
        f"vector3f[] warpmag:fieldMap:values = [{nodes}]",
    )
    simulation = warpmag.Simulation(write(tmp_path, places, area), device=device)
    magnetics = simulation.magnetics
    middle = [[0.1, -0.3, 0.3]]  # half a metre along the board's z, which lies along -y
    for current in (50.0, -20.0):
        magnetics.set_current("/Board/Coil", current)
        magnetics.induce(simulation.state)
        expected = [0.0, 7.0 - current / (2.0 * 0.04), 0.0]
        np.testing.assert_allclose(magnetics.h_field(middle)[0], expected, atol=1e-4 * 700.0)  # the ball adds a little
    simulation.step()
    assert any("100 % of its maximum on the boundary of the map" in line for line in simulation.warnings())


def test_a_current_follows_its_time_samples(tmp_path, device):
    """A pulse: linear between its keys, and held after them; the ball is magnetized as it says at each step."""
    pulse = coil(
        "float warpmag:coil:radius = 0.04",
        "float warpmag:coil:ampereTurns.timeSamples = { 0: 100, 24: 0, 48: -50, }",
        "double3 xformOp:translate = (0, 0, 0.03)",
        'uniform token[] xformOpOrder = ["xformOp:translate"]',
    )
    path = write(tmp_path, pulse)
    path.write_text(path.read_text().replace("metersPerUnit", "timeCodesPerSecond = 2400\n    metersPerUnit"))
    simulation = warpmag.Simulation(path, device=device, dt=1e-3, rtol=1e-5)
    sites = np.flatnonzero([bool(text) for text in simulation.model.warpmag.source])
    currents = []
    for _ in range(25):
        simulation.step()
        currents.append(float(simulation.model.warpmag.strength.numpy()[sites[0]]))
        z = 0.03 - float(simulation.state.body_q.numpy()[0, 2])
    # those of the last substep, of 0.5 ms, which takes what is its own at its begin
    times = 2400.0 * 1e-3 * (np.arange(25) + 0.5)
    np.testing.assert_allclose(currents, np.interp(times, [0.0, 24.0, 48.0], [100.0, 0.0, -50.0]), atol=1e-4)
    moment = simulation.magnetics.shape_moments()[0, 2]
    expected = 3.0 * 4.0 / 3.0 * np.pi * 0.005**3 * -50.0 * 0.04**2 / (2.0 * (0.04**2 + z**2) ** 1.5)
    assert abs(moment / expected - 1.0) < 0.01  # the ball falls by 0.5 % of that in a substep


def test_a_stage_drives_a_coil_by_voltages(tmp_path, device):
    """A voltage that is switched on; a run that is interrupted and resumed ends with the same current."""
    circuit = coil(
        *("float warpmag:coil:radius = 0.04", "float warpmag:coil:resistance = 3", "float warpmag:coil:turns = 50"),
        *("float warpmag:coil:inductance = 0.03", "double3 xformOp:translate = (0, 0, 0.03)"),
        "float warpmag:coil:voltage.timeSamples = { 0: 0, 1: 6, 2: 6 }",
        'uniform token[] xformOpOrder = ["xformOp:translate"]',
    )
    path, output = write(tmp_path, circuit), tmp_path / "out.usda"
    currents = []
    for last in (2, 9):
        simulation = warpmag.Simulation(path, device=device, dt=1e-3)
        simulation.run(4, output=output, resume=last == 9, on_frame=lambda frame, last=last: frame < last)
    currents = simulation.magnetics.coils.currents.numpy()
    stage = Usd.Stage.Open(str(output))
    attribute = stage.GetPrimAtPath("/Thing").GetAttribute("warpmag:coil:current")
    assert len(attribute.GetTimeSamples()) == 5 and attribute.Get(0.0) == 0.0
    assert attribute.Get(4.0) == pytest.approx(currents[0], rel=1e-6)
    uninterrupted = warpmag.Simulation(path, device=device, dt=1e-3)
    uninterrupted.run(4)
    assert np.array_equal(uninterrupted.magnetics.coils.currents.numpy(), currents)
    rate, keys = 3.0 / 0.03, simulation.model.warpmag.voltage.numpy()
    assert keys.max() == 6.0
    frame = 1.0 / 24.0  # a ramp of one frame, then three at 6 V
    end = 2.0 - 2.0 / (rate * frame) * (1.0 - np.exp(-rate * frame))
    assert currents[0] == pytest.approx(2.0 + (end - 2.0) * np.exp(-3.0 * rate * frame), rel=2e-3)


def test_a_run_starts_from_the_current_of_an_earlier_one(tmp_path, device):
    """A superconducting coil keeps its current, which the stage gives as the result of a run does."""
    circuit = coil(
        *("float warpmag:coil:radius = 0.04", "float warpmag:coil:resistance = 1e-9", "float warpmag:coil:turns = 50"),
        "double warpmag:coil:current.timeSamples = { 0: 2, 24: 3 }",
    )
    simulation = warpmag.Simulation(write(tmp_path, circuit), device=device)
    assert simulation.magnetics.coils.currents.numpy()[0] == pytest.approx(2.0)
    assert simulation.model.warpmag.strength.numpy().max() == pytest.approx(100.0)


def test_check_tells_what_a_stage_holds(tmp_path, capsys):
    path = write(tmp_path, coil("float warpmag:coil:radius = 0.02"), coil(*["float warpmag:coil:radius = 1"], name="B"))
    assert cli.main(["check", str(path)]) in (0, None)
    assert "sources     2 coils, 0 field maps" in capsys.readouterr().out


MAPPED = ("vector3f warpmag:fieldMap:spacing = (1, 1, 1)", "int3 warpmag:fieldMap:counts = (2, 2, 2)")
UNEVEN = "float3 xformOp:scale = (1, 2, 1)", 'uniform token[] xformOpOrder = ["xformOp:scale"]'


@pytest.mark.parametrize(("body", "text"), [
    (coil(), "/Thing: radius: must be positive"),
    (coil("float warpmag:coil:radius = -1"), "/Thing: radius: must be positive"),
    (coil("float warpmag:coil:radius = 1", "float warpmag:coil:voltage = 1"), "/Thing: voltage is given, but only a"),
    (coil("float warpmag:coil:radius = 1", "float warpmag:coil:resistance = 1", "float warpmag:coil:turns = 1e12",
          "float warpmag:coil:inductance = 1"), "/Thing: inductance must be 0 or at least 1 % of the"),
    (coil("float warpmag:coil:radius = 1", "float warpmag:coil:voltage.timeSamples = { 0: 0, 1: 1 }"), "/Thing: "),
    (coil("float warpmag:coil:radius = 1", "float warpmag:coil:resistance = 1", "float warpmag:coil:turns = 9",
          "float warpmag:coil:ampereTurns.timeSamples = { 0: 0, 1: 1 }"), "but follows from the voltage"),
    (coil("float warpmag:coil:radius = inf"), "/Thing: radius"),
    (coil("token warpmag:coil:radius = \"wide\""), "/Thing: warpmag:coil:radius: 'wide' is not a float"),
    (coil('uniform token warpmag:coil:shape = "ring"'), "/Thing: shape: 'ring'"),
    (coil('uniform token warpmag:coil:shape = "polyline"', "point3f[] warpmag:coil:points = [(0, 0, 0), (1, 0, 0)]"),
     "/Thing: points: must be at least 3"),
    (coil("float warpmag:coil:radius = 1", "float warpmag:coil:ampereTurns = nan"), "/Thing: ampere turns"),
    (coil("float warpmag:coil:radius = 1", "int warpmag:coil:closed = 1"), "warpmag:coil:closed: must be true"),
    (coil("float warpmag:coil:radius = 1", "float warpmag:coil:wireRadius = 1"), "/Thing: wire radius"),
    (coil("float warpmag:coil:radius.timeSamples = { 0: 1, 1: 2, }"), "has time samples, but cannot change"),
    (coil("float warpmag:coil:radius = 1", "float warpmag:coil:ampereTurns.timeSamples = { 0: 1, 1: nan, }"),
     "warpmag:coil:ampereTurns at time code 1: must be finite"),
    (coil("float warpmag:coil:radius = 1", *UNEVEN), "must not be mirrored or have a non-uniform scale"),
    (coil("float warpmag:coil:radius = 1", kind="Scope"), "has no transform"),
    (field_map(), "/Thing: warpmag:fieldMap:spacing is missing"),
    (field_map(*MAPPED), "warpmag:fieldMap:values is missing"),
    (field_map(*MAPPED, "vector3f[] warpmag:fieldMap:values = [(0, 0, 0)]"), "has 1 vectors"),
    (field_map(*MAPPED, f"vector3f[] warpmag:fieldMap:values = [{', '.join(['(0, nan, 0)'] * 8)}]"), "must be finite"),
    (field_map("vector3f warpmag:fieldMap:spacing = (1, 0, 1)", MAPPED[1],
               f"vector3f[] warpmag:fieldMap:values = [{', '.join(['(0, 0, 0)'] * 8)}]"), "/Thing: spacing"),
    (field_map(MAPPED[0], "int3 warpmag:fieldMap:counts = (-2, -2, 2)",
               f"vector3f[] warpmag:fieldMap:values = [{', '.join(['(0, 0, 0)'] * 8)}]"), "2 or more each"),
])  # fmt: skip
def test_what_is_refused(tmp_path, body, text):
    path = write(tmp_path, body)
    report = check(path)
    assert any(text in str(finding) for finding in report.errors), list(map(str, report.errors))
    with pytest.raises(InputError, match="Thing") as error:
        warpmag.Simulation(path)
    assert "\n" not in str(error.value)


def test_a_coil_that_keys_move_without_a_body_follows_them(tmp_path, device):
    """Its field is where the keys have it at each step, though it is no rigid body; nothing pushes it."""
    moved = coil(
        "float warpmag:coil:radius = 0.04",
        "float warpmag:coil:ampereTurns = 100",
        "double3 xformOp:translate.timeSamples = { 0: (0, 0, 0.1), 24: (0, 0, 0.3), }",
        'uniform token[] xformOpOrder = ["xformOp:translate"]',
    )
    path = write(tmp_path, moved)
    assert not any("keys move" in str(finding) for finding in check(path).warnings)
    path.write_text(path.read_text().replace("metersPerUnit", "timeCodesPerSecond = 2400\n    metersPerUnit"))
    simulation = warpmag.Simulation(path, device=device, dt=1e-3, rtol=1e-5)
    for step in range(1, 13):
        simulation.step()
        z = 0.1 + 0.2 * min(2400.0 * 1e-3 * step / 24.0, 1.0)
        simulation.magnetics.induce(simulation.state)
        field = simulation.magnetics.h_field([[0.0, 0.0, z]])[0]
        np.testing.assert_allclose(field, [0.0, 0.0, 100.0 / 0.08], atol=5.0)  # the ball adds a little


def test_attributes_without_effect_cause_warnings(tmp_path):
    lone = 'def Xform "Lone" {\nfloat warpmag:fieldMap:factor = 2\n}'
    report = check(write(tmp_path, coil("float warpmag:coil:radius = 1", "float warpmag:coil:ampereturns = 5"), lone))
    messages = [str(finding) for finding in report.warnings if "no effect" in str(finding)]
    assert messages == [
        "/Thing: warpmag:coil:ampereturns has no effect: no schema has it, the nearest is warpmag:coil:ampereTurns",
        "/Lone: warpmag:fieldMap:factor has no effect: the prim has no WarpmagFieldMapAPI",
    ]


def test_largest_numbers_are_refused_by_name():
    for bad in (Coil(radius=1.0, ampere_turns=2e15), Coil(radius=1e7), Coil(radius=1.0, wire_radius=math.nan)):
        with pytest.raises(InputError, match="here"):
            bad.check("here")
