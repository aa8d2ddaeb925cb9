"""The commands ``check`` and ``run`` report the same errors and warnings of a stage."""

import pytest
from pxr import Usd, UsdGeom, UsdPhysics
from small_stages import FIELD, LEFT, RIGHT, A, B, R, ball, errors_and_warnings, joint, physics, write

from warpmag import Simulation
from warpmag.declarations.magnets import Magnet, MagneticSettings
from warpmag.errors import InputError
from warpmag.usd import author_magnet, author_settings, check, newton_errors

OPEN = """def Mesh "Open" (prepend apiSchemas = ["PhysicsRigidBodyAPI", "PhysicsCollisionAPI",
    "PhysicsMeshCollisionAPI", "PhysicsMassAPI", "WarpmagMagnetAPI"]) {{
    float physics:mass = 0.1
    uniform token physics:approximation = "{approximation}"
    point3f[] points = [(0, 0, 1), (0.01, 0, 1), (0, 0.01, 1), (0, 0, 1.01)]
    int[] faceVertexCounts = [3, 3, 3]
    int[] faceVertexIndices = [0, 2, 1, 0, 1, 3, 1, 2, 3]
}}
"""
REFUSED = {
    "no magnets": ([physics(), ball("A", (0, 0, 1), magnet=False)], "no magnets: no prim has WarpmagMagnetAPI"),
    "nothing at all": ([], "no magnets: no prim has WarpmagMagnetAPI"),
    "two scenes": ([physics(), physics(name="Other"), A], "/World/Other: one PhysicsScene of several"),
    "a joint to nowhere": (
        [A, joint("Revolute", "A", "Nowhere", RIGHT, LEFT)],
        "/World/Joint: physics:body1 names /World/Nowhere, which is not there",
    ),
    "a joint of one body": ([A, joint("Revolute", "A", "A", RIGHT, LEFT)], "/World/Joint: both of its ends are on the"),
    "a joint to two": (
        [A, B, joint("Revolute", "A", "B", RIGHT, LEFT).replace("</World/B>", "[</World/A>, </World/B>]")],
        "/World/Joint: physics:body1 names 2 prims",
    ),
    "a spacing that is too small": (
        [physics(), ball("A", (0, 0, 1), "float warpmag:momentSpacing = 1e-5")],
        "/World/A: warpmag:momentSpacing 1e-05 m needs more than 20000 moments for one body",
    ),
    "a ball of an instancer that is out of bounds": (
        [
            physics(),
            'def PointInstancer "Balls" {\n    rel prototypes = </World/Balls/Ball>\n'
            "    int[] protoIndices = [0, 0, 0]\n"
            "    point3f[] positions = [(0, 0, 1), (0, 0, 2), (0, 0, 1e9)]\n",
            ball("Ball", (0, 0, 0)),
            "}\n",
        ],
        "/World/Balls/instance2/Ball: transform reaches 1e+09, beyond 1e+08",
    ),
    "an instancer without instances": (
        [physics(), A, 'def PointInstancer "Empty" (prepend apiSchemas = ["WarpmagSceneAPI"]) {}\n'],
        "/World/Empty: WarpmagSceneAPI on a prim that is not a PhysicsScene",
    ),
    "an open mesh": (
        [physics(), OPEN.format(approximation="none")],
        "/World/Open: mesh: not closed and consistently oriented",
    ),
    "a saturation beyond single precision": (
        [physics(), ball("A", (0, 0, 1), "float warpmag:saturationMagnetization = 1e30")],
        "/World/A: saturation: must be 1e-12 to 1e+15, got 1e+30",
    ),
    **{
        f"a physics material that is {state}": (
            [
                physics(),
                ball("A", (0, 0, 1), "rel material:binding:physics = </World/Rubber>").replace(
                    '"PhysicsMassAPI"', '"PhysicsMassAPI", "MaterialBindingAPI"'
                ),
                f'{kind} Material "Rubber" ({active} prepend apiSchemas = ["PhysicsMaterialAPI"]) {{}}\n',
            ],
            f"/World/A: its physics material /World/Rubber is {state}",
        )
        for state, kind, active in (
            ("inactive", "def", "active = false\n"),
            ("abstract", "class", ""),
            ("not defined", "over", ""),
        )
    },
}


@pytest.mark.parametrize("case", REFUSED)
def test_both_commands_report_the_same_error(case, device, tmp_path, capsys):
    parts, message = REFUSED[case]
    path = write(tmp_path, *parts)
    [error], _ = errors_and_warnings(path, tmp_path, device, capsys)
    assert message in error
    assert error in map(str, check(path).errors)  # without Newton


WARNED = {
    "a joint of nothing": ([A, joint("Revolute", None, None, RIGHT, LEFT)], "/World/Joint: joins two fixed ends"),
    "a joint of kinematic bodies": (
        [A, ball("K", (1, 0, 0), kinematic=True, magnet=False), joint("Fixed", "K", None, RIGHT, LEFT)],
        "/World/Joint: joins two fixed ends",
    ),
    "an overlap": ([A, ball("B", (1.9 * R, 0, 1))], "1 pair of bodies overlaps at the start"),
}


@pytest.mark.parametrize("case", WARNED)
def test_warnings_of_both_are_the_same(case, device, tmp_path, capsys):
    parts, message = WARNED[case]
    errors, warnings = errors_and_warnings(write(tmp_path, *parts), tmp_path, device, capsys)
    assert errors == []
    assert any(message in warning for warning in warnings)


SLIPS = {
    "/World/Spelt": (
        'uniform token warpmag:kind = "permanent"\nvector3f warpmag:magnetisation = (0, 0, 1e6)',
        "warpmag:magnetisation has no effect: no schema has it, the nearest is warpmag:magnetization",
        "a permanent magnet without magnetization: author warpmag:magnetization",
    ),
    "/World/Soft": (
        "vector3f warpmag:magnetization = (0, 0, 1e6)\nfloat warpmag:recoilPermeability = 1.05",
        "warpmag:magnetization has no effect on an inducible magnet, as warpmag:kind declares it",
        "warpmag:recoilPermeability has no effect on an inducible magnet, as warpmag:kind declares it",
    ),
    "/World/Space": (
        'uniform token wrapmag:kind = "permanent"\nvector3f warpMag:magnetization = (0, 0, 1e6)\nfloat wax:kind = 1',
        "wrapmag:kind has no effect: no schema has it, the nearest is warpmag:kind",
        "warpMag:magnetization has no effect: no schema has it, the nearest is warpmag:magnetization",
    ),
    "/World/Bare": (
        "float warpmag:saturationMagnetization = 1e6\nfloat warpmag:rtol = 1e-2",
        "warpmag:saturationMagnetization has no effect: the prim has no WarpmagMagnetAPI",
        "warpmag:rtol has no effect: the prim has no WarpmagSceneAPI",
        "WarpMagMagnetAPI has no effect: there is no such schema, the nearest is WarpmagMagnetAPI",
    ),
}


IN_INSTANCE = {
    "a prim": (ball("Extra", (0.1, 0, 1)), "Extra"),
    "a value": ('over "Ball" {\n double radius = 0.02\n}\n', "Ball"),
    "a schema": ('over "Ball" (prepend apiSchemas = ["PhysicsMassAPI"]) {\n}\n', "Ball"),
    "a cycle": ('def "Again" (references = </World/Copy>) {\n}\n', "Again"),
}
KINDS = f'def Xform "Kinds" {{\n{ball("Ball", (0, 0, 1))}}}\n'
COPY = 'def Xform "Copy" (instanceable = true\n references = </World/Kinds>) {{\n{}}}\n'
NESTED = 'def Xform "Outer" (instanceable = true\n references = </World/Inner>) {\n}\n'


@pytest.mark.parametrize("metres", [1, 0.01])
@pytest.mark.parametrize("case", IN_INSTANCE)
def test_what_usd_passes_over_in_an_instance_is_refused(case, metres, tmp_path):
    """It would count in the result of a run, which makes such an instance editable, or when units are converted."""
    text, name = IN_INSTANCE[case]
    path = write(tmp_path, physics(), KINDS, COPY.format(text))
    path.write_text(path.read_text().replace("metersPerUnit = 1", f"metersPerUnit = {metres}"))
    with pytest.raises(InputError) as caught:
        Simulation(path, device="cpu")
    assert str(caught.value).startswith(f"/World/Copy: USD ignores the override /World/Copy/{name} in the instance")


def test_so_is_what_an_instance_in_an_instance_says(tmp_path, device, capsys):
    inner = f'def Xform "Inner" {{\n{COPY.format(IN_INSTANCE["a value"][0])}}}\n'
    path = write(tmp_path, physics(), KINDS, inner.replace("def Xform", "over", 1), NESTED)
    (error,), _ = errors_and_warnings(path, tmp_path, device, capsys)
    assert error.startswith("/World/Outer/Copy: USD ignores the override /World/Inner/Copy/Ball in the instance")


def test_in_what_is_only_seen_it_does_not_matter(tmp_path):
    """Not even where units are converted; a body of its own there would be one more."""
    for text, bodies in (('over "Ball" {\n double radius = 0.02\n}\n', ["/World/A"]), (IN_INSTANCE["a prim"][0], [])):
        path = write(tmp_path, A, KINDS.replace("Physics", "Nothing").replace("Warpmag", "Nothing"), COPY.format(text))
        path.write_text(path.read_text().replace("metersPerUnit = 1", "metersPerUnit = 0.01"))
        try:
            assert check(path).contents.bodies == bodies
        except InputError as error:
            assert not bodies and "USD ignores the override /World/Copy/Extra" in str(error)


def test_an_instance_that_says_nothing_runs(tmp_path, device, capsys):
    """Nor does one that is only seen, or that says of itself where it is, or in a variant, which instances share."""
    seen = KINDS.replace("Kinds", "Seen").replace("Physics", "Nothing").replace("WarpmagMagnetAPI", "NothingAPI")
    copy_of_seen = COPY.replace("Kinds", "Seen").replace("Copy", "CopyOfSeen").format(IN_INSTANCE["a value"][0])
    large = 'variantSet "size" = {\n "large" {\n over "Ball" {\n double radius = 0.02\n}\n}\n}\n'
    variant, moved = (
        COPY.replace("Copy", name).format(
            f"""{text}double3 xformOp:translate = ({x}, 0, 0)
            uniform token[] xformOpOrder = ["xformOp:translate"]\n"""
        )
        for name, text, x in (("Copy", large, 1), ("Moved", 'over "Ball" {\n}\n', 2))
    )
    variant = variant.replace("true", 'true\n variantSets = "size"\n variants = {\n string size = "large"\n}')
    path = write(tmp_path, physics(), KINDS, seen, copy_of_seen, variant, moved)
    errors, _ = errors_and_warnings(path, tmp_path, device, capsys, frames=1)
    assert errors == []
    stage, copies = Usd.Stage.Open(str(tmp_path / "out.usda")), ["/World/Copy/Ball", "/World/Moved/Ball"]
    assert [stage.GetPrimAtPath(copy).GetAttribute("radius").Get() for copy in copies] == [0.02, R]


def test_errors_of_newton_are_reported_in_the_same_words():
    """USD names a stage with its session layer, which has an address."""
    with pytest.raises(InputError) as caught, newton_errors("scene.usda", "import"):
        raise ValueError("Cycle: @a.usda@,@anon:0x56157832e270:a-session.usda@</A/B> CANNOT reference: @a.usda@</A>")
    assert (
        str(caught.value)
        == "scene.usda: Newton cannot import it (Cycle: @a.usda@</A/B> CANNOT reference: @a.usda@</A>)"
    )


def test_slips_are_warnings_of_both(device, tmp_path, capsys):
    parts = [
        ball(path.rpartition("/")[2], (0.1 * number, 0, 1), lines, magnet="Bare" not in path)
        for number, (path, (lines, *_)) in enumerate(SLIPS.items())
    ]
    parts[-1] = parts[-1].replace('"PhysicsMassAPI"', '"PhysicsMassAPI", "warpSceneAPI", "WarpMagMagnetAPI"')
    parts.append(OPEN.format(approximation="convexHull"))
    errors, warnings = errors_and_warnings(write(tmp_path, physics(), *parts), tmp_path, device, capsys)
    assert errors == []
    expected = {f"{path}: {message}" for path, (_, *messages) in SLIPS.items() for message in messages}
    assert expected <= set(warnings)
    assert not any(foreign in warning for warning in warnings for foreign in ("wax:", "warpSceneAPI"))
    [mesh] = [warning for warning in warnings if warning.startswith("/World/Open: mesh: not closed")]
    assert "convexHull, is magnetized in its place, and a density gives it the mass of the open mesh" in mesh


def test_what_goes_together_is_no_slip(device, tmp_path, capsys):
    """All attributes authored, as ``author_magnet`` does, and magnets that are switched on later."""
    stage = Usd.Stage.CreateInMemory()
    for name, magnet in (("A", Magnet()), ("B", Magnet("permanent", magnetization=(0.0, 0.0, 1e5)))):
        prim = stage.DefinePrim(f"/{name}", "Sphere")
        for api in (UsdPhysics.RigidBodyAPI, UsdPhysics.CollisionAPI):
            api.Apply(prim)
        author_magnet(prim, magnet)
    stage.GetPrimAtPath("/B").GetAttribute("warpmag:magnetization").Set((0, 0, 0), 0.0)
    stage.GetPrimAtPath("/B").GetAttribute("warpmag:magnetization").Set((0, 0, 1e5), 10.0)
    author_settings(UsdPhysics.Scene.Define(stage, "/Scene").GetPrim(), MagneticSettings())
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.GetRootLayer().Export(str(tmp_path / "scene.usda"))
    assert check(tmp_path / "scene.usda").contents.findings == []


def test_a_body_that_is_marked_as_a_collider_itself(device, tmp_path, capsys):
    """An Xform has no shape to collide with, or to fill with moments: those of its children count."""
    inner = ball("Shape", (0, 0, 0), body=False, magnet=False)
    schemas = '"PhysicsRigidBodyAPI", "PhysicsCollisionAPI", "WarpmagMagnetAPI"'
    body = f'def Xform "A" (prepend apiSchemas = [{schemas}]) {{\nfloat warpmag:momentSpacing = 0.01\n{inner}}}\n'
    assert errors_and_warnings(write(tmp_path, physics(field=FIELD), body), tmp_path, device, capsys)[0] == []


def test_a_broken_rule_of_usd_is_a_warning(device, tmp_path, capsys):
    path = write(tmp_path, A)
    path.write_text(path.read_text().replace('defaultPrim = "World"', ""))
    assert check(path).errors == () and len(check(path).broken_rules) == 1
    errors, [warning] = errors_and_warnings(path, tmp_path, device, capsys)
    assert errors == []
    assert "missing defaultPrim" in warning
