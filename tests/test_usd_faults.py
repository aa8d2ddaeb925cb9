"""Faults of values, transforms, times and meshes: refused before Newton sees them, in one line that names the prim."""

import logging
import os
import subprocess
import sys
import warnings

import newton
import numpy as np
import pytest
from pxr import Sdf, Usd, UsdGeom

from warpmag import Simulation
from warpmag.engine.stepping.scene import import_scene
from warpmag.errors import InputError, SimulationError
from warpmag.kernels.rigid.monitor import HIGHEST_SPEED
from warpmag.usd import check, newton_errors, open_stage, read_magnets, stage_clock, survey
from warpmag.usd.values import _DECLARED

METRES = 'metersPerUnit = 1\nkilogramsPerUnit = 1\nupAxis = "Z"'
APIS = "PhysicsRigidBodyAPI", "PhysicsCollisionAPI", "PhysicsMassAPI", "WarpmagMagnetAPI"
TETRAHEDRON = "point3f[] points = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)]"
TO_BALL = "rel physics:body1 = </Ball>"
CORNERS = [0, 2, 1, 0, 1, 3, 0, 3, 2, 1, 2, 3]


def write(folder, body, metadata=METRES):
    path = folder / "stage.usda"
    path.write_text(f"#usda 1.0\n(\n{metadata}\n)\n{body}\n")
    return path


def ball(*lines, kind="Sphere", radius="double radius = 0.005"):
    applied = ", ".join(f'"{api}"' for api in APIS)
    inner = "\n".join((*([radius] if kind == "Sphere" else []), *lines))
    return f'def {kind} "Ball" (prepend apiSchemas = [{applied}])\n{{\n{inner}\n}}\n'


def mesh(corners=tuple(CORNERS), counts=(3, 3, 3, 3), points=TETRAHEDRON, *, more=""):
    faces = f"int[] faceVertexIndices = {list(corners)}\nint[] faceVertexCounts = {list(counts)}"
    return ball(points, faces, more, kind="Mesh")


def posed(order, *operations):
    names = ", ".join(f'"{name}"' for name in order)
    return ball(*operations, f"uniform token[] xformOpOrder = [{names}]")


def changed(place, corner):
    return [corner if k == place else entry for k, entry in enumerate(CORNERS)]


REFUSED = {
    "array for a radius": (ball(radius="double[] radius = [0.005, 1]"), "/Ball: radius must be a float, got an array"),
    "string for a mass": (ball('string physics:mass = "x"'), "/Ball: physics:mass must be a float, got 'x'"),
    "token for a switch": (ball('token physics:rigidBodyEnabled = "y"'), "/Ball: physics:rigidBodyEnabled must be"),
    "vector for a density": (ball("float3 physics:density = (1, 2, 3)"), "/Ball: physics:density must be a float"),
    "doubles for a velocity": (ball("double3 physics:velocity = (1, 2, 3)"), "/Ball: physics:velocity must be a Vec3f"),
    "text for a saturation": (ball('string warpmag:saturationMagnetization = "1e6"'), "'1e6' is not a float"),
    "switch for a saturation": (ball("bool warpmag:saturationMagnetization = 1"), "True is not a float"),
    "text for a moment": (ball('string warpmag:moment = "123"'), "/Ball: warpmag:moment: '123' is not a vector"),
    "number for a material": (ball("float warpmag:material = 2"), "/Ball: warpmag:material: 2 is not a str"),
    "radius beyond single precision": (ball(radius="double radius = 1e300"), "/Ball: radius must be from"),
    "radius without a mass": (ball(radius="double radius = 1e-30"), "/Ball: radius must be from 1e-07 to 1e+06"),
    "scaled to nothing": (
        posed(["xformOp:scale"], "float3 xformOp:scale = (1.2e-5, 1.2e-5, 1.2e-5)"),
        "/Ball: radius 0.005 scaled by 1.2e-05 to 1.2e-05 must be",
    ),
    "negative mass": (ball("float physics:mass = -1"), "/Ball: physics:mass must not be negative"),
    "infinite density": (ball("float physics:density = inf"), "/Ball: physics:density must not be negative"),
    "infinite centre": (ball("point3f physics:centerOfMass = (inf, 0, 0)"), "/Ball: physics:centerOfMass must be fin"),
    "NaN inertia": (ball("float3 physics:diagonalInertia = (nan, 0, 0)"), "/Ball: physics:diagonalInertia must"),
    "NaN axes of inertia": (ball("quatf physics:principalAxes = (nan, 0, 0, 0)"), "/Ball: physics:principalAxes must"),
    "inertia of no body": (ball("float3 physics:diagonalInertia = (3, 1, 1)"), "/Ball: physics:diagonalInertia must"),
    "axes of inertia too long": (
        ball("quatf physics:principalAxes = (2, 0, 0, 0)"),
        "must be a quaternion of length 1",
    ),
    "frame of a joint": (
        ball()
        + 'def PhysicsFixedJoint "Joint"\n{\nrel physics:body0 = </Ball>\nquatf physics:localRot0 = (0, 0, 0, 0)\n}',
        "/Joint: physics:localRot0 must be a quaternion of length 1",
    ),
    "axis of no name": (ball('uniform token axis = "W"', kind="Cone"), "/Ball: axis must be one of X, Y, Z, got 'W'"),
    "NaN that a kind has no use for": (
        ball("vector3f warpmag:magnetization = (nan, 0, 0)"),
        "/Ball: magnetization: must be finite",
    ),
    "collider that is no shape": (ball(kind="Xform"), "/Ball: a magnet without colliders that are solid"),
    "magnet as large as a country": (ball(radius="double radius = 1e5"), "/Ball: radius 100000 scaled by 1 to 1 must"),
    "too fast": (ball("vector3f physics:velocity = (1e30, 0, 0)"), "/Ball: physics:velocity must be from"),
    "negative margin": (ball("float newton:contactMargin = -1"), "/Ball: newton:contactMargin must be from 0"),
    "double for float": (ball("double physics:mass = 2"), "/Ball: physics:mass must be of type float, not double"),
    "float for double": (ball(radius="float radius = 0.005"), "/Ball: radius must be of type double, not float"),
    "half for float": (
        ball() + 'def Material "Rubber" (prepend apiSchemas = ["PhysicsMaterialAPI"])\n'
        "{\nhalf physics:restitution = 0.5\n}",
        "/Rubber: physics:restitution must be of type float, not half",
    ),
    "double gravity": (
        ball() + 'def PhysicsScene "Scene"\n{\ndouble physics:gravityMagnitude = 5\n}',
        "/Scene: physics:gravityMagnitude must be of type float, not double",
    ),
    "NaN gap": (ball("float newton:contactGap = nan"), "/Ball: newton:contactGap must be finite"),
    "friction of a material": (
        ball() + 'def Material "Rubber" (prepend apiSchemas = ["PhysicsMaterialAPI"])\n'
        "{\nfloat physics:dynamicFriction = -0.5\n}",
        "/Rubber: physics:dynamicFriction must be from 0",
    ),
    "restitution above one": (
        ball() + 'def Material "Rubber" (prepend apiSchemas = ["PhysicsMaterialAPI"])\n'
        "{\nfloat physics:restitution = 1.5\n}",
        "/Rubber: physics:restitution must be from 0 to 1",
    ),
    "operation that is missing": (posed(["xformOp:scale:a"]), "/Ball: xformOpOrder names 'xformOp:scale:a', which"),
    "operation without a name": (posed([""]), "/Ball: xformOpOrder names '', which"),
    "operation of a wrong type": (
        posed(["xformOp:translate"], "float xformOp:translate = 2"),
        "/Ball: xformOp:translate has a type or value that USD cannot compose",
    ),
    "order that is text": (
        ball('string xformOpOrder = "xformOp:translate"'),
        "/Ball: xformOpOrder must be a TokenArray",
    ),
    "rotation that is text": (ball('string physics:localRot0 = "x"'), "/Ball: physics:localRot0 must be a quaternion"),
    "order that is a number": (ball("bool xformOpOrder = 1"), "/Ball: xformOpOrder must be a TokenArray"),
    "far away": (
        posed(["xformOp:translate"], "double3 xformOp:translate = (1e25, 0, 0)"),
        "/Ball: transform reaches 1e+25",
    ),
    "projection": (
        posed(
            ["xformOp:transform"],
            "matrix4d xformOp:transform = ((1, 0, 0, 0.5), (0, 1, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1))",
        ),
        "/Ball: transform is a projection",
    ),
    "index beyond the points": (mesh(changed(5, 20)), "/Ball: faceVertexIndices name point 20, but there are points 0"),
    "index beyond the points of a prim with a warning": (
        mesh(changed(5, 20), more="float physics:staticFriction = 1"),
        "/Ball: faceVertexIndices name point 20",
    ),
    "negative index": (mesh(changed(0, -1)), "/Ball: faceVertexIndices name point -1"),
    "face of two": (mesh(CORNERS, (3, 3, 2, 4)), "/Ball: faceVertexCounts must be 3 or more, got 2"),
    "negative count": (mesh(CORNERS, (3, 3, -3, 9)), "/Ball: faceVertexCounts must be 3 or more, got -3"),
    "counts that do not sum": (mesh(CORNERS, (3, 3, 3)), "/Ball: faceVertexCounts sum to 9, but there are 12"),
    "no faces": (mesh([], []), "/Ball: mesh has no faces"),
    "point at 1e28": (
        mesh(points=TETRAHEDRON.replace("(1, 0, 0)", "(1e28, 0, 0)")),
        "/Ball: points must be from -1e+08 to 1e+08",
    ),
    "long mesh": (mesh(points=TETRAHEDRON.replace("(1, 0, 0)", "(2e6, 0, 0)")), "/Ball: mesh is 2e+06 m long"),
    "open magnet": (mesh(CORNERS[:9], (3, 3, 3)), "/Ball: mesh: not closed"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_refused_with_one_line(tmp_path, capfd, case):
    body, message = REFUSED[case]
    path = write(tmp_path, body)
    with warnings.catch_warnings(), pytest.raises(InputError) as caught:
        warnings.simplefilter("error")
        read_magnets(open_stage(path))
    assert message in str(caught.value) and "\n" not in str(caught.value)
    assert any(message in str(finding) for finding in check(path).errors)
    assert capfd.readouterr().err == ""


SOUND = {
    "sizes of other shapes": ball('string height = "x"', "double[] size = [1, 2]"),
    "infinities that are the schema's own": ball(
        "point3f physics:centerOfMass = (-inf, -inf, -inf)", "float newton:contactGap = -inf"
    )
    + 'def PhysicsScene "Scene"\n{\nfloat physics:gravityMagnitude = -inf\n}',
    "zeros that mean nothing given": ball("float physics:mass = 0", "float3 physics:diagonalInertia = (0, 0, 0)"),
    "other numbers for a magnet": ball(
        "double warpmag:saturationMagnetization = 2e6", "int warpmag:susceptibility = 5"
    ),
    "polygons": mesh([0, 3, 2, 1, 0, 1, 4, 1, 2, 4, 2, 3, 4, 3, 0, 4], (4, 3, 3, 3, 3)).replace(
        TETRAHEDRON, "point3f[] points = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0.5, 0.5, 1)]"
    ),
    "inverted operation": posed(
        ["xformOp:translate", "!invert!xformOp:translate"], "double3 xformOp:translate = (1, 2, 3)"
    ),
    "types of other roles": ball("float3 physics:velocity = (0, 0, 1)", "float3 physics:centerOfMass = (0, 0, 0)"),
    "notes of somebody": ball('custom float note = nan\ncustom string other = "x"'),
    "empty mesh to look at": ball() + 'def Mesh "Decoration"\n{\npoint3f[] points = []\n}',
}


@pytest.mark.parametrize("case", SOUND)
def test_sound(tmp_path, case):
    assert [str(finding) for finding in survey(open_stage(write(tmp_path, SOUND[case]))).findings] == []


@pytest.mark.parametrize("value", ["1e400", "nan"])
def test_a_color_that_is_not_finite(value, tmp_path):
    """It makes whole pictures not finite; `render` divides by it."""
    path = write(tmp_path, ball(f"color3f[] primvars:displayColor = [({value}, 0.5, 0.5)]"))
    with pytest.raises(InputError, match=r"^/Ball: color must be finite, got \((inf|nan), "):
        import_scene(path)


def test_an_open_mesh_that_its_hull_closes(tmp_path):
    body = mesh(CORNERS[:9], (3, 3, 3), more='uniform token physics:approximation = "convexHull"')
    (finding,) = survey(open_stage(write(tmp_path, body))).findings
    assert finding.severity == "warning"
    assert "/Ball: mesh: not closed" in str(
        finding
    ) and "its approximation for collisions, convexHull, is magnetized" in str(finding)


@pytest.mark.parametrize(
    ("times", "message"),
    [
        ("startTimeCode = nan", "startTimeCode must be finite"),
        ("endTimeCode = inf", "endTimeCode must be finite"),
        ("startTimeCode = 9\nendTimeCode = 5", "endTimeCode 5 is before startTimeCode 9"),
        ("timeCodesPerSecond = 5e-324", "timeCodesPerSecond must be from 0.001"),
        ("timeCodesPerSecond = 0", "timeCodesPerSecond must be positive"),
        ("timeCodesPerSecond = 24\nframesPerSecond = 1e9", "framesPerSecond must be from 0.001"),
        ("endTimeCode = 1e11", "frames from startTimeCode to endTimeCode"),
    ],
)
def test_times(tmp_path, times, message):
    path = write(tmp_path, ball(), f"{METRES}\n{times}")
    with pytest.raises(InputError) as caught:
        stage_clock(open_stage(path))
    assert str(caught.value).startswith(f"{path}: ") and message in str(caught.value)


LAYERS = {
    "root": "",
    "sublayer": "subLayers = [@moving.usda@]\ntimeCodesPerSecond = 24\n",
    "reference": "timeCodesPerSecond = 24\n",
}
MOVING = """def Xform "Moving"
{
    double3 xformOp:translate.timeSamples = { 0: (0, 0, 0), 24: (0, 1, 0) }
    uniform token[] xformOpOrder = ["xformOp:translate"]
}
"""
READ_WITHIN = (
    "import sys, resource as r; r.setrlimit(r.RLIMIT_CPU, (10, 10)); from warpmag.usd import open_stage as o; "
)


@pytest.mark.parametrize(
    ("layer", "rate"),
    [
        ("root", "0"),
        ("root", "nan"),
        ("root", "inf"),
        ("sublayer", "5e-324"),
        ("reference", "5e-324"),
        ("sublayer", "-1"),
    ],
)
def test_rates_that_usd_loops_over(tmp_path, layer, rate):
    """In a process of its own, for none of these ends otherwise but the negative one, whose samples come unsorted."""
    own = f"timeCodesPerSecond = {rate}\n"
    units = 'metersPerUnit = 0.01\nkilogramsPerUnit = 1\nupAxis = "Y"\n'
    moving = tmp_path / "moving.usda"
    moving.write_text(f"#usda 1.0\n(\n{own})\n{MOVING}")
    body = {"root": MOVING, "sublayer": "", "reference": 'def "Here" (references = @moving.usda@</Moving>) {}'}[layer]
    path = write(tmp_path, body, units + (LAYERS[layer] or own))
    command = [sys.executable, "-c", READ_WITHIN + "o(sys.argv[1])", str(path)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    last = done.stderr.splitlines()[-1] if done.stderr else f"ended with {done.returncode}"
    named = path if layer == "root" else moving
    assert f"InputError: {named}: timeCodesPerSecond must be " in last


def test_a_hull_without_mass(tmp_path):
    """Newton takes the volume of the mesh, also of an open one; that of a kinematic body counts for nothing."""
    points = TETRAHEDRON.replace("1", "0.01")
    hull = 'uniform token physics:approximation = "convexHull"\n'
    bodies = [
        mesh([0, 2, 1, 0, 1, 3, 0, 3, 2], (3, 3, 3), points, more=hull + more).replace(
            '"PhysicsMassAPI"', '"PhysicsMeshCollisionAPI"'
        )
        for more in ("", "bool physics:kinematicEnabled = 1")
    ]
    with pytest.raises(InputError, match=r"^/Ball: its colliders have no mass"):
        import_scene(write(tmp_path, bodies[0]))
    import_scene(write(tmp_path, bodies[1]))


@pytest.mark.parametrize("unit", ["metersPerUnit", "kilogramsPerUnit"])
@pytest.mark.parametrize("value", ["0", "-1", "nan", "inf", "5e-324"])
def test_units(tmp_path, unit, value):
    metadata = METRES.replace(f"{unit} = 1", f"{unit} = {value}")
    with pytest.raises(InputError, match=f"stage.usda: {unit} must be positive and finite"):
        read_magnets(open_stage(write(tmp_path, ball(), metadata)))


def test_time_samples_of_another_type(tmp_path):
    path = write(tmp_path, ball('string physics:velocity.timeSamples = { 0: "a", 10: "b" }'))
    with pytest.raises(InputError, match="^/Ball: physics:velocity must be a Vec3f, got 'a'"):
        open_stage(path)


INSTANCES = """
class Xform "Prototype"
{
    BODY
}
def Xform "A" (instanceable = true
    references = </Prototype>)
{
}
"""


@pytest.mark.parametrize(
    "animated",
    [
        "double radius.timeSamples = { 0: 0.02, 10: 0.03 }",
        "double radius = 0.02\ndouble3 xformOp:translate.timeSamples = { 0: (0, 0, 1) }\n"
        'uniform token[] xformOpOrder = ["xformOp:translate"]',
    ],
)
def test_time_samples_inside_instances(tmp_path, animated):
    path = write(tmp_path, INSTANCES.replace("BODY", ball(radius=animated)))
    errors = [str(finding) for finding in survey(open_stage(path)).findings if finding.severity == "error"]
    assert len(errors) == 1 and errors[0].startswith("/A/Ball: ") and "set instanceable = false on /A" in errors[0]
    path.write_text(path.read_text().replace("instanceable = true", "instanceable = false"))
    stage = open_stage(path)
    assert survey(stage).findings == []
    held = stage.GetPrimAtPath("/A/Ball")
    assert held.GetAttribute("radius").Get(Usd.TimeCode.Default()) == 0.02


def test_constant_samples_inside_instances_are_sound(tmp_path):
    both = "double radius = 0.02\ndouble radius.timeSamples = { 0: 0.02 }"
    assert survey(open_stage(write(tmp_path, INSTANCES.replace("BODY", ball(radius=both))))).findings == []


def test_what_newton_raises_or_leaves_out_is_one_line():
    for error in (KeyError("joint"), ZeroDivisionError("x\ny"), MemoryError()):
        with (
            pytest.raises(InputError, match=r"^s\.usda: Newton cannot import it") as caught,
            newton_errors("s.usda", "import"),
        ):
            raise error
        assert "\n" not in str(caught.value)
    with pytest.raises(InputError) as caught, newton_errors("s.usda", "import"):
        Usd.Stage.CreateInMemory().DefinePrim("no path")
    assert str(caught.value).startswith("s.usda: Newton cannot import it (") and "pxrInternal" not in str(caught.value)
    with (
        pytest.raises(InputError, match="cannot import all of it .Skipping collider /A"),
        newton_errors("s.usda", "import"),
    ):
        warnings.warn("Skipping collider /A: no volume", stacklevel=1)
    with pytest.raises(InputError, match="expected 6. Ignoring"), newton_errors("s.usda", "import"):
        warnings.warn("newton:inertia has 1 elements, expected 6. Ignoring.", stacklevel=1)
    with newton_errors("s.usda", "import"):
        warnings.warn("a remark", stacklevel=1)
        warnings.warn("mass is authored, too. Ignoring body-level density.", stacklevel=1)


def test_what_no_schema_asks_for_is_a_warning(tmp_path):
    body = ball("float physics:mass = 2").replace('"PhysicsMassAPI", ', "")
    body += 'def Material "Rubber"\n{\nfloat physics:density = 900\nfloat physics:restitution = 0.5\n}\n'
    findings = survey(open_stage(write(tmp_path, body))).findings
    assert {finding.severity for finding in findings} == {"warning"}
    assert [str(finding) for finding in findings] == [
        "/Ball: physics:mass has no effect: the prim has no PhysicsMassAPI",
        "/Rubber: physics:density has no effect: the prim has no PhysicsMassAPI or PhysicsMaterialAPI",
        "/Rubber: physics:restitution has no effect: the prim has no PhysicsMaterialAPI",
    ]


DECLARED = 'custom float newton:my:thing = 1 (customData = {string assignment = "model"\nstring frequency = "body"})'
DECLARATIONS = {  # a line in the scene, what is said of it and how gravely
    "by a name of no schema": ("custom float newton:my:thing = 1", "no schema has it, and its customData", "warning"),
    "for what Newton does not know": (DECLARED.replace("body", "bodies"), "no schema has it, and its", "warning"),
    "by a number": (DECLARED.replace('string assignment = "model"', "int assignment = 5"), "the assignment 5", "error"),
    "by a relationship": ("custom rel newton:my:thing = </Ball>", "is a relationship, but in no schema", "error"),
}


@pytest.mark.parametrize("case", DECLARATIONS)
def test_attributes_that_a_scene_declares(device, tmp_path, capfd, case):
    line, message, severity = DECLARATIONS[case]
    path = write(tmp_path, f'def PhysicsScene "Scene"\n{{\n{line}\n}}\n{ball()}')
    result = [finding for finding in survey(open_stage(path)).findings if "newton:my:thing" in finding.message]
    assert {(finding.where, finding.severity) for finding in result if message in finding.message} == {
        ("/Scene", severity)
    }
    if severity == "warning":
        assert any("newton:my:thing" in line for line in import_scene(path).warnings)
        assert capfd.readouterr().err == ""  # nor does Newton say it again


def test_sound_declarations_reach_newton(device, tmp_path, capfd):
    options = "int newton:timeStepsPerSecond = 500\nfloat newton:joint_drive_gains_scaling = 1\n"
    options += "uniform float newton:xpbd:rigidContactRelaxation = 0.8"  # of a schema that is not applied
    path = write(tmp_path, f'def PhysicsScene "Scene"\n{{\n{DECLARED}\n{options}\n}}\n{ball()}')
    assert survey(open_stage(path)).findings == []
    assert "my:thing" in import_scene(path).builder.custom_attributes
    assert capfd.readouterr().err == ""


def test_what_newton_takes_as_declared():
    """Equal for the newest Newton; earlier ones lack some frequencies."""
    assert {entry.name.lower() for entry in newton.Model.AttributeAssignment} == set(_DECLARED["assignment"])
    contacts = {"contact", "contact_rigid", "contact_soft"}  # which a builder refuses
    frequencies, known = {entry.name.lower() for entry in newton.Model.AttributeFrequency}, set(_DECLARED["frequency"])
    newest = hasattr(newton.Model.AttributeFrequency, "TENDON_GUIDE")
    assert frequencies - contacts == known if newest else frequencies - contacts < known


def test_what_newton_logs_is_kept_off_stderr_or_one_line(capfd):
    log = logging.getLogger("newton._src.usd.utils")
    with newton_errors("s.usda", "import"):
        log.warning("a remark")
    with pytest.raises(InputError, match="cannot import all of it .Skipping /A"), newton_errors("s.usda", "import"):
        log.warning("Skipping %s", "/A")
    assert capfd.readouterr().err == ""


def hinged(operation, value):
    """A ball on a hinge to a frame that is no body."""
    order = f'uniform token[] xformOpOrder = ["{operation.split()[1]}"]'
    frame = f'def Xform "Frame"\n{{\n{operation} = {value}\n{order}\n}}\n'
    return f'{ball()}{frame}def PhysicsRevoluteJoint "Joint"\n{{\nrel physics:body0 = </Frame>\n{TO_BALL}\n}}\n'


@pytest.mark.parametrize(
    ("operation", "value", "message"),
    [
        ("float xformOp:translate", "2", "xformOp:translate has a type or value that USD cannot compose"),
        ("float3 xformOp:scale", "(0, 0, 0)", "transform has a scale of zero"),
        ("double3 xformOp:translate", "(nan, 0, 0)", "transform is not finite"),
        ("double3 xformOp:translate", "(1e30, 0, 0)", "transform reaches 1e+30"),
    ],
)
def test_a_joint_to_a_frame_that_is_nowhere(tmp_path, operation, value, message):
    report = check(write(tmp_path, hinged(operation, value)))
    assert [error.where for error in report.errors if message in error.message] == ["/Frame"]


@pytest.mark.parametrize(("apart", "warned"), [(1e-5, False), (3e-4, True), (0.5, True)])
def test_ends_of_a_joint_that_are_apart(tmp_path, apart, warned):
    report = check(write(tmp_path, hinged("double3 xformOp:translate", f"({apart}, 0, 0)")))
    assert not report.errors
    result = [str(entry) for entry in report.warnings if entry.where == "/Joint"]
    warning = f"/Joint: its ends are {apart:g} m apart at the start, and the run begins by pulling them together"
    assert result == [warning] * warned


@pytest.mark.parametrize(("place", "apart"), [("(0, 0, 0.5)", 0.0), ("(0.3, 0, 0.5)", 0.3), ("(0, 0.4, 0)", 0.4)])
def test_ends_of_a_prismatic_joint_may_be_apart_along_its_axis(tmp_path, place, apart):
    turned = "quatf physics:localRot0 = (0.70710678, 0, -0.70710678, 0)"  # takes X to Z
    joint = hinged("double3 xformOp:translate", place).replace("Revolute", "Prismatic")
    joint = joint.replace(TO_BALL, f'{TO_BALL}\nuniform token physics:axis = "X"\n{turned}')
    result = [str(entry) for entry in check(write(tmp_path, joint)).warnings if entry.where == "/Joint"]
    warning = f"/Joint: its ends are {apart:g} m apart at the start, and the run begins by pulling them together"
    assert result == [warning] * (apart > 0)


def test_a_moment_of_an_impossible_magnetization(device, tmp_path):
    path = write(tmp_path, ball("vector3f warpmag:moment = (0, 1e38, 0)"))
    with pytest.raises(InputError, match=r"^/Ball: magnetization by warpmag:moment: must be at most 1e\+30 A/m, got "):
        Simulation(path, device=device)


@pytest.mark.parametrize(
    ("name", "value", "cause"),
    [
        ("external field", (0.0, 1e9, 0.0), r"an applied field of 1e\+09 A/m"),
        ("magnetization", (0.0, 0.0, 1e38), r"a magnetization of 1e\+38 A/m"),
        ("strength", 1e28, r"a coil's current \[A\] or a field map's factor of 1e\+28"),
        ("voltage", 1e12, r"a coil's voltage of 1e\+12 V"),
    ],
)
def test_a_run_that_ends_names_a_strength_beyond_all_measure(device, tmp_path, monkeypatch, name, value, cause):
    simulation = Simulation(write(tmp_path, ball()), device=device)
    if name == "external field":
        simulation.magnetics.set_external_field(value)
    else:
        getattr(simulation.model.warpmag, name).fill_(value)

    def end():
        raise SimulationError("step 1: /Ball has left")

    monkeypatch.setattr(simulation._stepper, "read_reports", end)
    with pytest.raises(SimulationError, match=rf"/Ball has left; {cause} moves magnets too fast"):
        simulation.step()
        assert simulation.state  # waits for a GPU


def test_a_run_that_ends_names_what_pulled(device, tmp_path, monkeypatch):
    simulation = Simulation(write(tmp_path, hinged("double3 xformOp:translate", "(0.5, 0, 0)")), device=device)

    def end():
        raise SimulationError("step 1: /Ball has left")

    monkeypatch.setattr(simulation._stepper, "read_reports", end)
    with pytest.raises(SimulationError, match="/Ball has left; the ends of the joint /Joint were apart at the start"):
        simulation.step()
        assert simulation.state


def test_keys_may_move_a_body_at_any_speed(device, tmp_path):
    """An animator hides a magnet by a key far away; a body that forces move would end the run at this speed."""
    body = ball(
        "bool physics:kinematicEnabled = 1",
        "double3 xformOp:translate.timeSamples = {0: (0, 0, 0), 1: (0, 1e6, 0)}",
        'uniform token[] xformOpOrder = ["xformOp:translate"]',
    )
    simulation = Simulation(write(tmp_path, body), device=device)
    simulation.step()
    assert np.linalg.norm(simulation.state.body_qd.numpy()[0, :3]) > HIGHEST_SPEED


def test_a_point_instancer_as_a_collider_of_a_magnet(tmp_path):
    body = ball('def PointInstancer "Shape" (prepend apiSchemas = ["PhysicsCollisionAPI"]) {}', kind="Xform")
    report = check(write(tmp_path, body.replace('"PhysicsCollisionAPI", ', "", 1)))
    assert [str(error) for error in report.errors] == [
        "/Ball: a magnet without colliders that are solid: no shape to magnetize"
    ]


def test_an_axis_of_a_shape_that_has_none(device, tmp_path):
    """A stranger's attribute of any type on a static magnet."""
    body = ball("float3 axis = (0, 1, 0)").replace('"PhysicsRigidBodyAPI", ', "")
    assert "PhysicsRigidBodyAPI" not in body
    assert len(Simulation(write(tmp_path, body), device=device).magnetics.shapes) == 1


def test_a_file_that_changed_is_read_again(tmp_path):
    """USD keeps the layers of open stages, and gives them out as they were."""
    first = open_stage(write(tmp_path, ball()))
    path = write(tmp_path, ball(radius="double radius = 0.007"))
    os.utime(path, ns=(1, 1))  # another time than the clock's last tick
    again = open_stage(path)
    assert again.GetPrimAtPath("/Ball").GetAttribute("radius").Get() == 0.007
    again.GetPrimAtPath("/Ball").GetAttribute("radius").Set(0.006)  # unsaved: whoever has it open wants it so
    assert open_stage(path).GetPrimAtPath("/Ball").GetAttribute("radius").Get() == 0.006
    assert first


def test_samples_of_the_order_of_operations_are_nothing_to_usd(tmp_path):
    order = 'uniform token[] xformOpOrder = ["xformOp:translate"]'
    samples = 'uniform token[] xformOpOrder.timeSamples = { 0: [], 1: ["!resetXformStack!"] }'
    stage = open_stage(write(tmp_path, ball("double3 xformOp:translate = (1, 2, 3)", order, samples)))
    matrix = UsdGeom.XformCache(Usd.TimeCode.Default()).GetLocalToWorldTransform(stage.GetPrimAtPath("/Ball"))
    assert tuple(matrix.ExtractTranslation()) == (1.0, 2.0, 3.0)


def test_metadata_that_cannot_be_read(tmp_path):
    layer = Sdf.Layer.CreateAnonymous()
    layer.ImportFromString(write(tmp_path, ball()).read_text())
    layer.documentation = "a note that a byte is changed of"
    path = tmp_path / "stage.usdc"
    layer.Export(str(path))
    path.write_bytes(path.read_bytes().replace(b"a note that", b"a n\x80te that"))
    report = check(path)
    assert [str(error) for error in report.errors] == [f"{path}: documentation cannot be read (text that is not UTF-8)"]


def test_offsets_of_sublayers_are_no_metadata_to_copy(tmp_path):
    write(tmp_path, ball()).rename(tmp_path / "below.usda")
    path = write(tmp_path, "", f"{METRES}\nsubLayers = [@./below.usda@ (offset = 2; scale = 2)]")
    assert check(path).errors == ()
