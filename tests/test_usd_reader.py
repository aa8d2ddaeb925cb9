"""Reading of stages: what is held, and one line for each thing that is refused."""

import math

import pytest
from pxr import Usd

from warpmag.declarations.magnets import Magnet
from warpmag.errors import InputError
from warpmag.usd import check, describe, freeze, open_stage, read_magnets, stage_clock, survey

METRES = 'metersPerUnit = 1\n    kilogramsPerUnit = 1\n    upAxis = "Z"'
BALL = """
def Sphere "Ball" (prepend apiSchemas = ["PhysicsRigidBodyAPI", "PhysicsCollisionAPI", "WarpmagMagnetAPI"])
{
    double radius = 0.005
}
"""


def write(folder, body, metadata=METRES, name="stage.usda"):
    path = folder / name
    body = body.replace("}", "\n}")  # usda wants a brace on a line of its own
    path.write_text(f"#usda 1.0\n(\n    {metadata}\n)\n{body}\n")
    return path


def ball(*lines, name="Ball", kind="Sphere", apis=("PhysicsRigidBodyAPI", "PhysicsCollisionAPI", "WarpmagMagnetAPI")):
    quoted = ", ".join(f'"{api}"' for api in apis)
    inner = "\n".join(("double radius = 0.005" if kind == "Sphere" else "", *lines))
    return f'def {kind} "{name}" (prepend apiSchemas = [{quoted}])\n{{\n{inner}\n}}\n'


def translated(place):
    return f'double3 xformOp:translate = {place}\nuniform token[] xformOpOrder = ["xformOp:translate"]'


def test_plain_ball(tmp_path):
    stage = open_stage(write(tmp_path, BALL))
    assert read_magnets(stage).magnets == {"/Ball": Magnet()}


def test_magnet_on_a_collider_and_on_a_body_of_colliders(tmp_path):
    body = """
    def Xform "Tool" (prepend apiSchemas = ["PhysicsRigidBodyAPI"])
    {
        def Cube "Tip" (prepend apiSchemas = ["PhysicsCollisionAPI", "WarpmagMagnetAPI"])
        {
            uniform token warpmag:kind = "permanent"
            vector3f warpmag:magnetization = (0, 0, 1000)
        }
        def Cube "Handle" (prepend apiSchemas = ["PhysicsCollisionAPI"]) { }
    }
    def Xform "Letter" (prepend apiSchemas = ["PhysicsRigidBodyAPI", "WarpmagMagnetAPI"])
    {
        def Cube "Stroke" (prepend apiSchemas = ["PhysicsCollisionAPI"]) { }
    }
    def Cube "Anvil" (prepend apiSchemas = ["PhysicsCollisionAPI", "WarpmagMagnetAPI"]) { }
    """
    magnets = read_magnets(open_stage(write(tmp_path, body))).magnets
    assert list(magnets) == ["/Tool/Tip", "/Letter", "/Anvil"]
    assert magnets["/Tool/Tip"].magnetization == (0.0, 0.0, 1000.0)


def test_magnets_inside_instances(tmp_path):
    body = f"""
    class Xform "Prototype" {{ {BALL} }}
    def Xform "A" (instanceable = true
        references = </Prototype>) {{ }}
    def Xform "B" (instanceable = true
        references = </Prototype>) {{ }}
    """
    assert list(read_magnets(open_stage(write(tmp_path, body))).magnets) == ["/A/Ball", "/B/Ball"]


def test_initial_moments(tmp_path):
    stage = open_stage(write(tmp_path, ball("vector3f warpmag:moment = (0, 0.5, -2)")))
    assert read_magnets(stage).initial_moments == {"/Ball": (0.0, 0.5, -2.0)}


REFUSED = {
    "no magnets": (ball(apis=("PhysicsRigidBodyAPI", "PhysicsCollisionAPI")), "stage.usda: no magnets"),
    "negative saturation": (ball("float warpmag:saturationMagnetization = -1"), "/Ball: saturation"),
    "zero saturation": (ball("float warpmag:saturationMagnetization = 0"), "/Ball: saturation"),
    "NaN saturation": (ball("float warpmag:saturationMagnetization = nan"), "/Ball: saturation"),
    "infinite saturation": (ball("float warpmag:saturationMagnetization = inf"), "/Ball: saturation"),
    "NaN susceptibility": (ball("float warpmag:susceptibility = nan"), "/Ball: susceptibility"),
    "negative susceptibility": (ball("float warpmag:susceptibility = -0.1"), "/Ball: susceptibility"),
    "unknown kind": (ball('uniform token warpmag:kind = "iron"'), "/Ball: kind: 'iron' is not one of inducible"),
    "unknown curve": (ball('uniform token warpmag:curve = "arctan"'), "/Ball: curve: 'arctan'"),
    "negative spacing": (ball("float warpmag:momentSpacing = -1"), "/Ball: moment spacing"),
    "NaN magnetization": (
        ball('uniform token warpmag:kind = "permanent"', "vector3f warpmag:magnetization = (0, nan, 0)"),
        "/Ball: magnetization",
    ),
    "NaN moment": (ball("vector3f warpmag:moment = (0, nan, 0)"), "/Ball: warpmag:moment"),
    "token where a number belongs": (
        ball('custom string warpmag:saturationMagnetization = "much"'),
        "/Ball: warpmag:saturationMagnetization: 'much' is not a float",
    ),
    "radius zero": (ball().replace("0.005", "0"), "/Ball: radius must be positive"),
    "radius negative": (ball().replace("0.005", "-1"), "/Ball: radius must be positive"),
    "radius NaN": (ball().replace("0.005", "nan"), "/Ball: radius must be positive"),
    "flat box": (ball("double size = 0", kind="Cube"), "/Ball: size must be positive"),
    "NaN position": (ball(translated("(0, nan, 0)")), "/Ball: transform is not finite"),
    "infinite position": (ball(translated("(0, inf, 0)")), "/Ball: transform is not finite"),
    "NaN position of the parent": (
        f'def Xform "Group" {{ {translated("(nan, 0, 0)")}\n{BALL} }}',
        "/Group: transform is not finite",
    ),
    "scale zero": (
        ball('float3 xformOp:scale = (1, 0, 1)\nuniform token[] xformOpOrder = ["xformOp:scale"]'),
        "/Ball: transform has a scale of zero",
    ),
    "uneven ball": (
        ball('float3 xformOp:scale = (1, 2, 1)\nuniform token[] xformOpOrder = ["xformOp:scale"]'),
        "/Ball: a sphere with non-uniform scale",
    ),
    "sheared": (
        ball(
            "float xformOp:rotateX = 30",
            "float3 xformOp:scale = (1, 2, 3)",
            "float xformOp:rotateY = 30",
            'uniform token[] xformOpOrder = ["xformOp:rotateX", "xformOp:scale", "xformOp:rotateY"]',
            kind="Cube",
        ),
        "/Ball: transform is sheared",
    ),
    "mirrored": (
        ball('float3 xformOp:scale = (1, 1, -1)\nuniform token[] xformOpOrder = ["xformOp:scale"]', kind="Cube"),
        "/Ball: transform is mirrored",
    ),
    "NaN velocity": (ball("vector3f physics:velocity = (nan, 0, 0)"), "/Ball: physics:velocity must be finite"),
    "NaN mass": (ball("float physics:mass = nan"), "/Ball: physics:mass"),
    "mesh without points": (ball(kind="Mesh"), "/Ball: mesh has no points"),
    "NaN points": (ball("point3f[] points = [(0, nan, 0)]", kind="Mesh"), "/Ball: points must be finite"),
    "magnet on nothing": (
        'def Xform "Thing" (prepend apiSchemas = ["WarpmagMagnetAPI"]) { }',
        "/Thing: WarpmagMagnetAPI",
    ),
    "magnet on a disabled body": (
        ball("bool physics:rigidBodyEnabled = 0", kind="Xform", apis=("PhysicsRigidBodyAPI", "WarpmagMagnetAPI")),
        "/Ball: WarpmagMagnetAPI",
    ),
    "body without colliders": (
        ball(kind="Xform", apis=("PhysicsRigidBodyAPI", "WarpmagMagnetAPI")),
        "/Ball: a magnet without colliders",
    ),
    "magnet twice": (
        'def Xform "Tool" (prepend apiSchemas = ["PhysicsRigidBodyAPI", "WarpmagMagnetAPI"]) {\n'
        'def Cube "Tip" (prepend apiSchemas = ["PhysicsCollisionAPI", "WarpmagMagnetAPI"]) { } }',
        "/Tool/Tip: its rigid body /Tool is a magnet already",
    ),
    "settings off the scene": (
        BALL + 'def Xform "Odd" (prepend apiSchemas = ["WarpmagSceneAPI"]) { }',
        "/Odd: WarpmagSceneAPI",
    ),
    "unknown force": (
        BALL
        + 'def PhysicsScene "Scene" (prepend apiSchemas = ["WarpmagSceneAPI"])'
        + '{ uniform token warpmag:force = "lorentz"\n}',
        "/Scene: force: 'lorentz'",
    ),
    "rtol zero": (
        BALL + 'def PhysicsScene "Scene" (prepend apiSchemas = ["WarpmagSceneAPI"]) { float warpmag:rtol = 0\n}',
        "/Scene: rtol",
    ),
    "NaN gravity": (
        BALL + 'def PhysicsScene "Scene" { float physics:gravityMagnitude = nan\n}',
        "/Scene: physics:gravityMagnitude must be finite",
    ),
    "two scenes": (
        BALL + 'def PhysicsScene "One" { }\ndef PhysicsScene "Two" { }',
        "/Two: one PhysicsScene of several",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_refused_with_one_line_that_names_the_prim(tmp_path, case):
    body, message = REFUSED[case]
    path = write(tmp_path, body)
    with pytest.raises(InputError) as caught:
        read_magnets(open_stage(path))
    assert message in str(caught.value) and "\n" not in str(caught.value)
    # ``warpmag check`` finds the same.
    assert any(message in str(finding) for finding in check(path).errors)


def test_all_problems_are_found(tmp_path):
    body = ball(translated("(0, nan, 0)"), "float warpmag:saturationMagnetization = -1") + ball(name="Small").replace(
        "0.005", "0"
    )
    report = check(write(tmp_path, body, 'metersPerUnit = 0\nupAxis = "Z"\nstartTimeCode = 5\nendTimeCode = 1'))
    assert {finding.where.rpartition("/")[2] for finding in report.errors} >= {"stage.usda", "Ball", "Small"}
    messages = [finding.message for finding in report.errors if finding.where == "/Ball"]
    assert "transform is not finite (xformOp:translate)" in messages and any(
        "saturation" in message for message in messages
    )
    assert report.clock is None


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("missing.usda", None, "no such file"),
        ("text.usda", b"hello", "not a USD file"),
        ("noise.usdc", bytes(range(256)), "not a USD file"),
        ("empty.usda", b"", "not a USD file"),
        ("notes.txt", b"hello", "not a USD file"),
        ("syntax.usda", b'#usda 1.0\ndef Xform "A" { oops }', "not a USD file"),
        ("broken.usda", b'#usda 1.0\ndef Xform "A" (references = @./nothing.usda@) { }', "nothing.usda"),
        ("hollow.usda", b"#usda 1.0\n(subLayers = [@./nothing.usda@])", "nothing.usda"),
        (
            "circle.usda",
            b'#usda 1.0\ndef "A" {\ndef "B" (references = </A>) {}\n}',
            "circle.usda@</A/B> CANNOT reference",
        ),
    ],
)
def test_files_that_do_not_open(tmp_path, capfd, name, content, message):
    path = tmp_path / name
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(InputError) as caught:
        open_stage(path)
    text = str(caught.value)
    assert text.startswith(f"{path}: ") and message in text and "\n" not in text
    assert capfd.readouterr().err == ""


def test_a_folder_is_no_stage(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        open_stage(tmp_path)


def test_instancers_for_the_eye_are_left_alone(tmp_path):
    body = 'def PointInstancer "Grass" { rel prototypes = </Grass/A>\ndef Cube "A" { } }'
    assert survey(open_stage(write(tmp_path, BALL + body))).findings == []


@pytest.mark.parametrize(
    ("metadata", "codes", "frames"),
    [
        ("timeCodesPerSecond = 48\nframesPerSecond = 30", 48.0, 30.0),
        ("timeCodesPerSecond = 48", 48.0, 48.0),
        ("framesPerSecond = 30", 30.0, 30.0),
        ("metersPerUnit = 1", 24.0, 24.0),
    ],
)
def test_clock(tmp_path, metadata, codes, frames):
    clock = stage_clock(open_stage(write(tmp_path, BALL, metadata + "\nstartTimeCode = 5")))
    assert (clock.time_codes_per_second, clock.frames_per_second) == (codes, frames)
    assert (clock.start, clock.end, clock.step) == (5.0, 5.0, None)


def test_physics_step_is_read_only_where_authored(tmp_path):
    scene = 'def PhysicsScene "Scene" (prepend apiSchemas = ["NewtonSceneAPI"]) {{ {} }}'
    plain = open_stage(write(tmp_path, BALL + scene.format("")))
    assert stage_clock(plain).step is None
    stepped = open_stage(write(tmp_path, BALL + scene.format("int newton:timeStepsPerSecond = 500\n"), name="b.usda"))
    assert stage_clock(stepped).step == 1.0 / 500.0
    wrong = open_stage(write(tmp_path, BALL + scene.format("int newton:timeStepsPerSecond = 0\n"), name="c.usda"))
    with pytest.raises(InputError, match=r"^/Scene: newton:timeStepsPerSecond"):
        stage_clock(wrong)


def test_animated_values_are_held_at_the_start(tmp_path):
    moving = "double3 xformOp:translate.timeSamples = { 0: (0, 0, 0), 10: (1, 0, 0) }\n"
    moving += 'uniform token[] xformOpOrder = ["xformOp:translate"]'
    path = write(tmp_path, ball(moving), METRES + "\n    startTimeCode = 5\n    endTimeCode = 10")
    text = path.read_text()
    stage = open_stage(path)
    place = stage.GetAttributeAtPath("/Ball.xformOp:translate")
    assert place.Get(Usd.TimeCode.Default()) == (0.5, 0.0, 0.0)
    freeze(stage, 10.0)
    assert place.Get(Usd.TimeCode.Default()) == (1.0, 0.0, 0.0)
    assert open_stage(path, 2.5).GetAttributeAtPath("/Ball.xformOp:translate").Get() == (0.25, 0.0, 0.0)
    assert path.read_text() == text


def test_keys_of_a_kinematic_body_are_read_and_those_within_a_body_reported(tmp_path):
    moving = "double3 xformOp:translate.timeSamples = { 0: (0, 0, 0), 10: (1, 0, 0) }\n"
    moving += 'uniform token[] xformOpOrder = ["xformOp:translate"]\n'
    contents = survey(open_stage(write(tmp_path, ball(moving + "bool physics:kinematicEnabled = 1"))))
    assert not contents.findings
    (operation,) = contents.motions["/Ball"].operations
    assert (operation.kind, operation.keys.times.tolist()) == ("translate", [0.0, 10.0])
    part = ball(moving, name="Part", apis=("PhysicsCollisionAPI",))
    body = 'def Xform "Tool" (prepend apiSchemas = ["PhysicsRigidBodyAPI", "WarpmagMagnetAPI"])\n{\n' + part + "}"
    findings = survey(open_stage(write(tmp_path, body, name="b.usda"))).findings
    assert [(finding.where, finding.severity) for finding in findings] == [("/Tool/Part", "warning")]


def test_report(tmp_path):
    body = BALL + ball('uniform token warpmag:kind = "permanent"', "bool physics:kinematicEnabled = 1", name="Bar")
    report = check(write(tmp_path, body))
    assert report.contents.bodies == report.contents.colliders == ["/Ball", "/Bar"]
    assert report.contents.kinematic == ["/Bar"]
    assert (report.magnets("inducible"), report.magnets("permanent")) == (["/Ball"], ["/Bar"])
    for kind in (None, "", "iron", ["inducible"], {}):
        with pytest.raises(InputError, match="^kind: .* is not one of inducible, permanent"):
            report.magnets(kind)
    assert (report.meters_per_unit, report.kilograms_per_unit, report.up_axis) == (1.0, 1.0, "Z")
    assert report.contents.magnets["/Ball"].susceptibility == math.inf


TURNED_BOX = (
    "float xformOp:rotateX = 30\nfloat3 xformOp:scale = (1, 1, 2)\n"
    'uniform token[] xformOpOrder = ["xformOp:rotateX", "xformOp:scale"]'
)


def test_validators_of_usd_are_heard(tmp_path):
    unbound = ball("rel material:binding = </Material>") + 'def Material "Material" { }'
    report = check(write(tmp_path, unbound, METRES + '\n    defaultPrim = "Ball"'))
    assert [finding.where for finding in report.broken_rules] == ["/Ball"]
    assert "usdShadeValidators:MaterialBindingApiAppliedValidator" in report.broken_rules[0].message
    assert report.errors == () and report.broken_rules[0].message in [warning.message for warning in report.warnings]


def test_turned_boxes_are_sound(tmp_path):
    report = check(write(tmp_path, ball(TURNED_BOX, kind="Cube"), METRES + '\n    defaultPrim = "Ball"'))
    assert report.errors == report.broken_rules == ()


def test_description(tmp_path):
    path = write(tmp_path, BALL, 'doc = """One line.\n\nMore."""')
    assert describe(path) == "One line."
    assert describe(write(tmp_path, BALL, name="plain.usda")) == ""


def test_samples_that_block_a_value_are_held_as_none(tmp_path):
    samples = "double radius = 5\ndouble radius.timeSamples = { 0: None, 10: 7 }"
    stage = open_stage(write(tmp_path, ball(samples, kind="Sphere").replace("double radius = 0.005\n", "")))
    radius = stage.GetPrimAtPath("/Ball").GetAttribute("radius")
    assert (radius.Get(), radius.HasAuthoredValue()) == (None, False)
    freeze(stage, 10.0)
    assert radius.Get() == 7.0
    freeze(stage, 0.0)
    with pytest.raises(InputError, match="^/Ball: radius is blocked and has no value"):
        read_magnets(stage)


def test_messages_are_one_line_however_long_a_name_is(tmp_path):
    name = "n" * 100_000
    findings = survey(open_stage(write(tmp_path, ball("float physics:mass = -1", name=name)))).findings
    errors = [finding for finding in findings if finding.severity == "error"]
    assert len(errors) == 1 and str(errors[0]).startswith("/nnn") and len(str(errors[0])) < 1000
    with pytest.raises(InputError) as caught:
        read_magnets(open_stage(tmp_path / "stage.usda"))
    assert len(str(caught.value)) < 1000 and "must not be negative" in str(caught.value)
    assert str(InputError("a\nb\x1b[31m")) == "a b [31m"
