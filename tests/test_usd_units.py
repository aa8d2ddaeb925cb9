"""Stages in centimetres, grams and Y up run as their twins in metres do, and their results are in their units."""

import contextlib
import math

import newton_usd_schemas  # noqa: F401  (registers Newton's schemas)
import numpy as np
import pytest
from pxr import Gf, Sdf, Tf, Usd, UsdGeom, UsdPhysics, Vt

from warpmag.engine.stepping.scene import import_scene
from warpmag.engine.stepping.simulation import Simulation
from warpmag.errors import InputError
from warpmag.usd import check, open_stage, survey
from warpmag.usd.read.units import _exponents

SI, ARTIST = (1.0, 1.0, "Z"), (0.01, 1.0, "Y")
GRAMS = (0.01, 0.001, "Z")


class Author:
    """Writes a stage, given in metres, kilograms and Z up, in other units."""

    def __init__(self, path, units):
        self.metres, self.kilograms, self.up = units
        self.stage = Usd.Stage.CreateNew(str(path))
        UsdGeom.SetStageMetersPerUnit(self.stage, self.metres)
        UsdPhysics.SetStageKilogramsPerUnit(self.stage, self.kilograms)
        UsdGeom.SetStageUpAxis(self.stage, self.up)
        self.stage.SetTimeCodesPerSecond(48)
        self.stage.SetEndTimeCode(48)
        scene = UsdPhysics.Scene.Define(self.stage, "/Physics")
        scene.CreateGravityDirectionAttr(Gf.Vec3f(*self.turned((0.0, 0.0, -1.0))))
        scene.CreateGravityMagnitudeAttr(9.81 * self.length)
        self.stage.SetDefaultPrim(UsdGeom.Xform.Define(self.stage, "/World").GetPrim())

    @property
    def length(self):
        """Units of length in a metre."""
        return 1.0 / self.metres

    def turned(self, vector):
        """A vector of the world, as the axis that is up wants it."""
        x, y, z = vector
        return (x, z, -y) if self.up == "Y" else (x, y, z)

    def place(self, prim, place, angle=0.0):
        """Put a prim somewhere, turned about the vertical by some degrees."""
        turn = Gf.Rotation(Gf.Vec3d(0, 0, 1), angle)
        if self.up == "Y":
            turn *= Gf.Rotation(Gf.Vec3d(1, 0, 0), -90.0)
        xform = UsdGeom.Xformable(prim)
        xform.AddTranslateOp().Set(Gf.Vec3d(*self.turned(place)) * self.length)
        xform.AddOrientOp(UsdGeom.XformOp.PrecisionDouble).Set(turn.GetQuat())
        return prim

    def shape(self, kind, path, **sizes):
        """A collider; sizes in metres, other values as they are."""
        prim = self.stage.DefinePrim(f"/World/{path}", kind)
        for name, value in sizes.items():
            prim.GetAttribute(name).Set(value * self.length if isinstance(value, float) else value)
        UsdPhysics.CollisionAPI.Apply(prim)
        return prim

    def body(self, prim, *, mass=0.0, density=0.0, kinematic=False):
        UsdPhysics.RigidBodyAPI.Apply(prim).CreateKinematicEnabledAttr(kinematic)
        UsdPhysics.MassAPI.Apply(prim).CreateMassAttr(mass / self.kilograms)
        UsdPhysics.MassAPI(prim).CreateDensityAttr(density / self.kilograms * self.metres**3)
        return prim

    def magnet(self, prim, spacing, **attributes):
        prim.AddAppliedSchema("WarpmagMagnetAPI")
        types = {str: Sdf.ValueTypeNames.Token, float: Sdf.ValueTypeNames.Float, tuple: Sdf.ValueTypeNames.Vector3f}
        for name, value in (*attributes.items(), ("momentSpacing", spacing * self.length)):
            attribute = prim.CreateAttribute(f"warpmag:{name}", types[type(value)], custom=False)
            attribute.Set(Gf.Vec3f(*value) if isinstance(value, tuple) else value)
        return prim

    def horseshoe(self, path):
        """A bar bent to a U, as a mesh of polygons."""
        angles = np.linspace(0.0, math.pi, 8)
        outer, inner = (np.c_[radius * np.cos(angles), radius * np.sin(angles)] for radius in (0.02, 0.01))
        outer, inner = ([(side[0, 0], -0.02), *side, (side[-1, 0], -0.02)] for side in (outer, inner))
        points = [(x, y, z) for y in (-0.005, 0.005) for side in (outer, inner) for x, z in side]
        n = len(outer)
        front = [(k, k + 1, n + k + 1, n + k) for k in range(n - 1)]
        back = [tuple(2 * n + k for k in reversed(face)) for face in front]
        top = [(k, 2 * n + k, 2 * n + k + 1, k + 1) for k in range(n - 1)]
        below = [tuple(n + k for k in reversed(face)) for face in top]
        ends = [(0, n, 3 * n, 2 * n), (n - 1, 3 * n - 1, 4 * n - 1, 2 * n - 1)]
        faces = [*front, *back, *top, *below, *ends]
        prim = self.shape("Mesh", path, subdivisionScheme="none")
        mesh = UsdGeom.Mesh(prim)
        mesh.CreatePointsAttr(Vt.Vec3fArray([Gf.Vec3f(*(self.length * entry for entry in point)) for point in points]))
        mesh.CreateFaceVertexCountsAttr([4] * len(faces))
        mesh.CreateFaceVertexIndicesAttr([k for face in faces for k in face])
        return prim


def table(path, units):
    """A horseshoe magnet over iron discs in the air and nails on a table."""
    author = Author(path, units)
    author.place(author.shape("Cube", "Table", size=0.2), (0.0, 0.0, -0.1))
    shoe = author.place(author.horseshoe("Horseshoe"), (0.0, 0.0, 0.035))
    author.magnet(author.body(shoe, kinematic=True), 0.008, kind="permanent", magnetization=(3e5, 0.0, 0.0))
    for k in range(4):
        disc = author.shape("Cylinder", f"Disc{k}", radius=0.005, height=0.002, axis="Z")
        author.place(disc, (0.013 * (k - 1.5), 0.006 * (k % 2), 0.006))
        author.magnet(author.body(disc, density=7870.0), 0.004, saturationMagnetization=1.6e6)
    for k in range(3):
        nail = author.place(
            author.stage.DefinePrim(f"/World/Nail{k}", "Xform"), (0.02 * (k - 1), -0.03, 0.003), 20.0 * k
        )
        author.magnet(author.body(nail, mass=0.0011), 0.002)
        author.shape("Capsule", f"Nail{k}/Shaft", radius=0.001, height=0.02, axis="Y")
        head = author.shape("Cylinder", f"Nail{k}/Head", radius=0.0025, height=0.001, axis="Y")
        UsdGeom.Xformable(head).AddTranslateOp().Set(Gf.Vec3d(0.0, 0.011, 0.0) * author.length)
    author.stage.Save()
    return path


def motion(path):
    """Places [frames, bodies, 3] of all bodies [m], Z up, and the moments of magnets [A·m²]."""
    stage = Usd.Stage.Open(str(path))
    unit, up = UsdGeom.GetStageMetersPerUnit(stage), UsdGeom.GetStageUpAxis(stage)
    turn = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]] if up == "Y" else np.eye(3))
    prims = [prim for prim in stage.Traverse() if prim.HasAPI("PhysicsRigidBodyAPI")]
    places, moments = [], []
    for code in np.arange(stage.GetStartTimeCode(), stage.GetEndTimeCode() + 0.5):
        cache = UsdGeom.XformCache(code)
        places.append([cache.GetLocalToWorldTransform(prim).ExtractTranslation() for prim in prims])
        moments.append([prim.GetAttribute("warpmag:moment").Get(code) for prim in prims])
    return unit * np.array(places) @ turn.T, np.array(moments) @ turn.T


def test_an_artists_table_runs_as_its_twin(device, tmp_path):
    results = []
    for name, units in (("si", SI), ("artist", ARTIST)):
        path, output = table(tmp_path / f"{name}.usda", units), tmp_path / f"{name}.out.usda"
        assert check(path).findings == ()
        Simulation(path, device=device).run(1, output=output)
        results.append(motion(output))
    (places, moments), (theirs, others) = results
    assert places.shape == (2, 8, 3) and np.abs(places[1] - places[0]).max() > 1e-3
    # Nails have come to rest on the table. Later, as discs hit edges, rounding grows without bound.
    np.testing.assert_allclose(theirs, places, rtol=0.0, atol=1e-5)
    np.testing.assert_allclose(others[1:], moments[1:], rtol=0.0, atol=1e-4 * np.abs(moments).max())


def test_the_result_is_in_the_units_of_the_stage(device, tmp_path):
    author = Author(tmp_path / "scene.usda", (0.01, 0.001, "Y"))
    ball = author.place(author.shape("Sphere", "Ball", radius=0.005), (0.1, 0.2, 0.3))
    author.magnet(author.body(ball, density=7870.0), 0.0, kind="permanent", magnetization=(0.0, 0.0, 1e5))
    author.stage.Save()
    simulation = Simulation(tmp_path / "scene.usda", device=device)
    volume = 4.0 / 3.0 * math.pi * 0.005**3
    assert simulation.model.body_mass.numpy()[0] == pytest.approx(7870.0 * volume, rel=1e-6)
    simulation.run(1, output=tmp_path / "out.usda")
    stage = Usd.Stage.Open(str(tmp_path / "out.usda"))
    assert (UsdGeom.GetStageMetersPerUnit(stage), UsdGeom.GetStageUpAxis(stage)) == (0.01, "Y")
    assert UsdPhysics.GetStageKilogramsPerUnit(stage) == 0.001
    prim, end = stage.GetPrimAtPath("/World/Ball"), stage.GetEndTimeCode()
    assert prim.GetAttribute("radius").Get() == 0.5
    place = UsdGeom.XformCache(end).GetLocalToWorldTransform(prim).ExtractTranslation()
    seconds = end / 48.0
    last = 42 * 5e-4  # the end of the last substep; places in between are interpolated
    fallen = 50.0 * 9.81 * seconds * (last + 5e-4)  # cm
    np.testing.assert_allclose(place, (10.0, 30.0 - fallen, -20.0), atol=1e-3 * fallen)
    velocity = Gf.Rotation(Gf.Vec3d(1, 0, 0), -90.0).TransformDir(
        Gf.Vec3d(prim.GetAttribute("physics:velocity").Get(end))
    )
    np.testing.assert_allclose(velocity, (0.0, -981.0 * seconds, 0.0), rtol=1e-4, atol=1e-3)
    np.testing.assert_allclose(
        prim.GetAttribute("warpmag:moment").Get(end), (0.0, 1e5 * volume, 0.0), atol=0.1 * volume
    )


def _joint(author, ball, k, kind):
    """A joint of a kind, with limits and drives, for the ball number k."""
    length, mass = author.length, 1.0 / author.kilograms
    joint = author.stage.DefinePrim(f"/World/Joint{k}", f"Physics{kind}Joint")
    joint.GetRelationship("physics:body1").AddTarget(ball.GetPath())
    joint.GetAttribute("physics:localPos0").Set(Gf.Vec3f(0.1 * k, 0.0, 0.1) * length)
    joint.GetAttribute("physics:breakForce").Set(100.0 * mass * length)
    if kind == "Distance":
        joint.GetAttribute("physics:maxDistance").Set(0.05 * length)
        joint.GetAttribute("physics:minDistance").Set(0.01 * length)
    if kind in ("Prismatic", "Revolute"):
        size = length if kind == "Prismatic" else 1.0
        effort = mass * length if kind == "Prismatic" else mass * length**2
        joint.GetAttribute("physics:axis").Set("Z")
        joint.GetAttribute("physics:lowerLimit").Set(-0.02 * size)
        joint.GetAttribute("physics:upperLimit").Set(0.03 * size)
        drive = UsdPhysics.DriveAPI.Apply(joint, "linear" if kind == "Prismatic" else "angular")
        drive.CreateTargetPositionAttr(0.01 * size)
        drive.CreateTargetVelocityAttr(0.05 * size)
        drive.CreateStiffnessAttr(40.0 * effort / size)
        drive.CreateDampingAttr(2.0 * effort / size)
        drive.CreateMaxForceAttr(7.0 * effort)
        joint.AddAppliedSchema("NewtonJointAPI")
        armature = joint.GetAttribute("newton:armature")
        if armature:
            armature.Set(0.01 * (mass if kind == "Prismatic" else effort))
    if not kind:
        for axis, low in (("transX", -0.01 * length), ("rotY", -10.0)):
            limit = UsdPhysics.LimitAPI.Apply(joint, axis)
            limit.CreateLowAttr(low)
            limit.CreateHighAttr(-low)


def _sources(author):
    """A coil and a field map."""
    length = author.length
    coil = author.place(author.stage.DefinePrim("/World/Coil", "Xform"), (0.0, 0.3, 0.0))
    coil.AddAppliedSchema("WarpmagCoilAPI")
    coil.AddAppliedSchema("WarpmagFieldMapAPI")
    types, uniform = Sdf.ValueTypeNames, Sdf.VariabilityUniform
    for name, kind, value in (
        ("coil:shape", types.Token, "solenoid"),
        ("coil:radius", types.Float, 0.02 * length),
        ("coil:length", types.Float, 0.05 * length),
        ("coil:wireRadius", types.Float, 0.001 * length),
        ("fieldMap:origin", types.Point3f, Gf.Vec3f(-0.1, -0.1, -0.2) * length),
        ("fieldMap:spacing", types.Vector3f, Gf.Vec3f(0.2, 0.2, 0.4) * length),
        ("fieldMap:counts", types.Int3, Gf.Vec3i(2, 2, 2)),
        ("fieldMap:values", types.Vector3fArray, [Gf.Vec3f(0.0, 0.0, 10.0)] * 8),
    ):
        coil.CreateAttribute(f"warpmag:{name}", kind, False, uniform).Set(value)
    coil.CreateAttribute("warpmag:coil:ampereTurns", types.Float, False).Set(50.0)


def machine(path, units):
    """Joints of all kinds with limits and drives, a coil, a field map and keys, values of every dimension."""
    author = Author(path, units)
    length, mass = author.length, 1.0 / author.kilograms
    for k, kind in enumerate(("Prismatic", "Revolute", "Distance", "")):
        ball = author.place(author.shape("Sphere", f"Bob{k}", radius=0.01), (0.1 * k, 0.0, 0.1))
        author.body(ball, mass=0.1)
        UsdPhysics.MassAPI(ball).CreateDiagonalInertiaAttr(Gf.Vec3f(1e-5, 2e-5, 2.5e-5) * mass * length**2)
        UsdPhysics.MassAPI(ball).CreateCenterOfMassAttr(Gf.Vec3f(0.001, 0.0, 0.002) * length)
        UsdPhysics.RigidBodyAPI(ball).CreateVelocityAttr(Gf.Vec3f(0.0, 0.0, 0.1 * k) * length)
        ball.AddAppliedSchema("NewtonCollisionAPI")
        ball.GetAttribute("newton:contactMargin").Set(1e-4 * length)
        ball.GetAttribute("newton:contactGap").Set(2e-3 * length)
        _joint(author, ball, k, kind)
    _sources(author)
    iron = author.place(author.shape("Sphere", "Iron", radius=0.004), (0.0, 0.3, 0.06))
    author.magnet(author.body(iron, density=7870.0), 0.0)
    moved = author.place(author.shape("Cube", "Moved", size=0.02), (0.5, 0.0, 0.0))
    operation = UsdGeom.Xformable(moved).GetOrderedXformOps()[0]
    for code, height in ((0.0, 0.0), (48.0, 0.5)):
        operation.Set(Gf.Vec3d(*author.turned((0.5, 0.0, height))) * length, code)
    unsized = author.shape("Cylinder", "Unsized")  # one unit, whatever that is
    unsized.GetAttribute("height").Set(1.0 * length)
    unsized.GetAttribute("radius").Set(1.0 * length)
    author.place(unsized, (5.0, 0.0, 0.0))
    author.stage.Save()
    return path


ARRAYS = (
    *("body_mass", "body_inertia", "body_com", "body_qd", "shape_scale", "shape_margin", "shape_gap", "gravity"),
    *("joint_limit_lower", "joint_limit_upper", "joint_target_ke", "joint_target_kd", "joint_effort_limit"),
    *("joint_armature", "joint_target_q", "joint_target_qd", "joint_X_p", "joint_X_c", "body_q"),
)


def test_every_dimension_of_a_machine(device, tmp_path):
    models = [
        Simulation(machine(tmp_path / f"{number}.usda", units), device=device)
        for number, units in enumerate((SI, GRAMS))
    ]
    for name in ARRAYS:
        expected, actual = (getattr(model.model, name).numpy() for model in models)
        assert expected.size
        np.testing.assert_allclose(actual, expected, rtol=2e-6, atol=1e-9, err_msg=name)
    for simulation in models:
        for _ in range(6):
            simulation.step()
    first, second = (model.state.body_q.numpy() for model in models)
    np.testing.assert_allclose(second, first, rtol=0.0, atol=1e-6)
    points = np.array([(0.0, 0.3, 0.05), (0.01, 0.3, 0.1), (0.0, 0.45, 0.1)])
    fields = [model.magnetics.h_field(points) for model in models]
    assert np.linalg.norm(fields[0], axis=1).min() > 1.0  # A/m
    np.testing.assert_allclose(fields[1], fields[0], rtol=1e-5, atol=1e-4)


def test_sizes_that_nobody_gives_are_units_of_the_stage(tmp_path):
    author = Author(tmp_path / "scene.usda", ARTIST)
    author.magnet(author.body(author.shape("Sphere", "Ball")), 0.0)
    author.body(author.shape("Cube", "Box"))
    author.stage.Save()
    scene = import_scene(tmp_path / "scene.usda")
    sizes = dict(zip(scene.builder.shape_label, map(tuple, scene.builder.shape_scale), strict=True))
    assert sizes["/World/Ball"][0] == pytest.approx(0.01) and sizes["/World/Box"][0] == pytest.approx(0.01)


def test_instances_and_references_are_converted_once(tmp_path):
    author = Author(tmp_path / "scene.usda", ARTIST)
    stage = author.stage
    ball = UsdGeom.Sphere.Define(stage, stage.CreateClassPrim("/Kind").GetPath().AppendChild("Ball"))
    ball.CreateRadiusAttr(0.5)
    ball.AddTranslateOp().Set((1.0, 0.0, 0.0))
    for api in (UsdPhysics.RigidBodyAPI, UsdPhysics.CollisionAPI):
        api.Apply(ball.GetPrim())
    ball.GetPrim().AddAppliedSchema("WarpmagMagnetAPI")
    for name in ("A", "B"):
        prim = author.place(stage.DefinePrim(f"/World/{name}", "Xform"), (0.1 * (name == "B"), 0.0, 0.0))
        prim.GetReferences().AddInternalReference("/Kind")
        prim.SetInstanceable(name == "A")
    stage.Save()
    scene = import_scene(tmp_path / "scene.usda")
    assert [float(entry[0]) for entry in scene.builder.shape_scale] == pytest.approx([0.005, 0.005])
    places = [tuple(scene.builder.body_q[scene.bodies[f"/World/{name}/Ball"]])[:3] for name in "AB"]
    np.testing.assert_allclose(places, [(0.01, 0.0, 0.0), (0.11, 0.0, 0.0)], atol=1e-8)
    simulation = Simulation(tmp_path / "scene.usda", device="cpu")
    simulation.run(1, output=tmp_path / "out.usda")
    result = Usd.Stage.Open(str(tmp_path / "out.usda"))
    end = UsdGeom.XformCache(result.GetEndTimeCode())
    fallen = [
        end.GetLocalToWorldTransform(result.GetPrimAtPath(f"/World/{name}/Ball")).ExtractTranslation() for name in "AB"
    ]
    np.testing.assert_allclose([entry[0] for entry in fallen], (1.0, 11.0), atol=1e-5)
    assert all(-0.25 < entry[1] < -0.2 for entry in fallen)  # cm after 1/48 s


def test_a_missing_unit_causes_a_warning(tmp_path):
    path = table(tmp_path / "scene.usda", ARTIST)
    path.write_text(path.read_text().replace("metersPerUnit = 0.01", ""))
    result = survey(open_stage(path)).findings
    assert [(entry.severity, entry.message) for entry in result] == [
        ("warning", "metersPerUnit is not set, which in USD means 0.01: lengths are read in that unit")
    ]


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        ("float mjc:solref = 0.1", "mjc:solref is not converted"),
        ("double3 xformOp:translate.spline = { 0: 1; 1: 2 }", "spline"),
    ],
)
def test_what_cannot_be_converted_is_refused(tmp_path, lines, message):
    path = tmp_path / "scene.usda"
    if "spline" in lines:
        lines = (
            "double xformOp:translateX.spline = {\n 0: 1,\n 24: 2,\n }\n"
            + 'uniform token[] xformOpOrder = ["xformOp:translateX"]'
        )
    path.write_text(f'#usda 1.0\n(\n metersPerUnit = 0.01\n)\ndef Sphere "Ball" {{\n{lines}\n}}\n')
    with pytest.raises(InputError, match=f"^/Ball: [^\n]*{message}"):
        open_stage(path)


def test_each_attribute_of_newton_with_a_unit_is_converted_or_refused():
    """By what its documentation says of its unit."""
    registry, stage = Usd.SchemaRegistry(), Usd.Stage.CreateInMemory()
    types = Tf.Type.FindByName("UsdAPISchemaBase").GetAllDerivedTypes()
    schemas = [name for name in map(Usd.SchemaRegistry.GetSchemaTypeName, types) if name.startswith("Newton")]
    result, kept = 0, []
    for schema in schemas:
        definition = registry.FindAppliedAPIPrimDefinition(schema)
        prim = stage.DefinePrim(f"/{schema}", "PhysicsPrismaticJoint")
        prim.AddAppliedSchema(schema)
        for name in definition.GetPropertyNames() if definition else ():
            attribute = definition.GetAttributeDefinition(name)
            unit = attribute.GetDocumentation().partition("Units:")[2].lower() if attribute else ""
            if not any(word in unit for word in ("distance", "mass", "force", "effort", "torque")):
                continue
            result += 1
            with contextlib.suppress(InputError):
                kept += [name] if _exponents(prim, name) == (0, 0) else []
    assert kept == [] and result > 50
