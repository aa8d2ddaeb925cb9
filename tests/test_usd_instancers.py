"""Point instancers of bodies become prims, and run as prims that somebody wrote one by one."""

import numpy as np
import pytest
from pxr import Usd, UsdGeom

from warpmag.engine.stepping import scene as scenes
from warpmag.engine.stepping.scene import import_scene
from warpmag.engine.stepping.simulation import Simulation
from warpmag.errors import InputError
from warpmag.show.export import export
from warpmag.usd import check, open_stage, survey

HEAD = """#usda 1.0
(
    metersPerUnit = 1
    kilogramsPerUnit = 1
    upAxis = "Z"
    timeCodesPerSecond = 60
    startTimeCode = 0
    endTimeCode = 60
)
def PhysicsScene "Scene" {
    float physics:gravityMagnitude = 9.81
    vector3f physics:gravityDirection = (0, 0, -1)
}
"""
BODY = '(prepend apiSchemas = ["PhysicsRigidBodyAPI", "PhysicsCollisionAPI", "WarpmagMagnetAPI"])'
BALL = f'def Sphere "Ball" {BODY} {{\n double radius = 0.004 \n}}\n'
BOX = f'def Cube "Box" {BODY} {{\n double size = 0.006 \n}}\n'
STATIC = 'def Cube "Stone" (prepend apiSchemas = ["PhysicsCollisionAPI"]) {\n double size = 0.01 \n}\n'
MAGNET = """def Cube "Magnet" (prepend apiSchemas = ["PhysicsCollisionAPI", "WarpmagMagnetAPI"]) {
    double size = 0.03
    double3 xformOp:translate = (0.1, 0, 0.12)
    uniform token[] xformOpOrder = ["xformOp:translate"]
    uniform token warpmag:kind = "permanent"
    vector3f warpmag:magnetization = (0, 0, 8e5)
}
"""
PLACED = "double3 xformOp:translate = {}\nquatf xformOp:orient = {}\nfloat3 xformOp:scale = {}\n"
PLACED += 'uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:orient", "xformOp:scale"]\n'


def write(folder, *parts, name="scene.usda"):
    path = folder / name
    path.write_text(HEAD + "".join(parts))
    return path


def instancer(prototypes, indices, positions, lines="", inner=""):
    targets = ", ".join(f"</World/Many/Kinds/{prototype}>" for prototype in prototypes)
    return f"""def Xform "World" {{
    double3 xformOp:translate = (0.1, 0, 0.02)
    double xformOp:rotateZ = 30
    uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateZ"]
    def PointInstancer "Many" {{
        rel prototypes = [{targets}]
        int[] protoIndices = {indices}
        point3f[] positions = {positions}
        {lines}
        def Scope "Kinds" {{
            {inner}
        }}
    }}
}}
"""


def placed(prim, place=(0, 0, 0), turn=(1, 0, 0, 0), scale=(1, 1, 1)):
    return prim.replace(" \n}", "\n" + PLACED.format(place, turn, scale) + "}")


def motion(path, codes):
    """Poses [frames, bodies, 4, 4] in the world and moments [frames, bodies, 3], by order of place at the start."""
    stage = Usd.Stage.Open(str(path))
    prims = [prim for prim in stage.Traverse() if prim.HasAPI("PhysicsRigidBodyAPI")]
    caches = [UsdGeom.XformCache(code) for code in codes]
    poses = np.array([[np.array(cache.GetLocalToWorldTransform(prim)) for prim in prims] for cache in caches])
    moments = np.array([[prim.GetAttribute("warpmag:moment").Get(code) for prim in prims] for code in codes])
    order = np.lexsort(poses[0, :, 3, :3].round(6).T)
    return poses[:, order], moments[:, order]


def test_two_hundred_balls_move_as_prims_do(device, tmp_path):
    """To the last bit. The magnet is a ball, too, and comes first on the stage: USD tells of shapes kind by kind, and a
    cube would be the last shape beside prims, and the second beside instances, which are added when all prims are
    there; contacts are summed in the order of shapes, and in a heap of balls their roundings grow without bound."""
    magnet = MAGNET.replace("def Cube", "def Sphere").replace("double size = 0.03", "double radius = 0.018")
    grid = np.stack(np.meshgrid(range(5), range(5), range(8), indexing="ij"), axis=-1).reshape(-1, 3)
    places = (0.0082 * grid + (0.0002, 0.0001, 0.0) * grid[:, ::-1]).astype(np.float32).tolist()
    listed = [tuple(place) for place in places]
    many = instancer(["Ball"], [0] * len(listed), listed, inner=BALL)
    single = many[: many.index("def PointInstancer")] + 'def Xform "Many" {\n'
    single += "".join(placed(BALL, place).replace('"Ball"', f'"Ball{number}"') for number, place in enumerate(listed))
    results = []
    for name, scene in (("many", many), ("single", single + "}\n}\n")):
        output = tmp_path / f"{name}.out.usda"
        Simulation(write(tmp_path, magnet, scene, name=f"{name}.usda"), device=device).run(3, output=output)
        results.append(motion(output, range(4)))
    (poses, moments), (expected, theirs) = results
    assert poses.shape == (4, 200, 4, 4)
    assert np.abs(poses[3] - poses[0])[:, 3].max() > 1e-3  # they jump
    np.testing.assert_allclose(poses, expected, rtol=0.0, atol=1e-15)  # transforms above bodies, in double precision
    np.testing.assert_array_equal(moments, theirs)
    for source, frame in ((tmp_path / "many.out.usda", 3), (tmp_path / "many.usda", 0)):
        export(source, tmp_path / "render.usdc", fps=60.0)
        stage = Usd.Stage.Open(str(tmp_path / "render.usdc"))
        shown = UsdGeom.PointInstancer(stage.GetPrimAtPath("/World/Render/Balls"))
        above = UsdGeom.XformCache(frame).GetLocalToWorldTransform(shown.GetPrim())
        seen = np.array([above.Transform(place) for place in shown.GetPositionsAttr().Get(frame)])
        np.testing.assert_allclose(np.sort(seen, axis=0), np.sort(poses[frame, :, 3, :3], axis=0), atol=1e-6)


def test_instances_stand_where_usd_puts_them(tmp_path):
    arrays = """
        quatf[] orientationsf = [(1, 0, 0, 0), (0.6, 0.8, 0, 0), (0.5, 0.5, 0.5, 0.5), (0.6, 0, 0, 0.8)]
        float3[] scales = [(1, 1, 1), (2, 2, 2), (1, 1, 1), (0.5, 0.5, 0.5)]
        int64[] ids = [7, 8, 9, 10]
        int64[] invisibleIds = [7]
    """
    inner = placed(BALL, (0.001, 0, 0), (0.8, 0.6, 0, 0)) + placed(BOX)
    places = [(0, 0, 0), (0.1, 0, 0), (0, 0.1, 0), (0, 0, 0.1)]
    path = write(tmp_path, instancer(["Ball", "Box"], [0, 1, 0, 1], places, arrays, inner))
    path.write_text(path.read_text().replace('"Many" {', '"Many" (inactiveIds = [9]) {'))
    stage = open_stage(path)
    assert survey(stage).bodies == [f"/World/Many/instance{n}" for n in ("0/Ball", "1/Box", "3/Box")]
    plain = Usd.Stage.Open(str(path))
    many = UsdGeom.PointInstancer(plain.GetPrimAtPath("/World/Many"))
    world = UsdGeom.XformCache().GetLocalToWorldTransform(many.GetPrim())
    kinds = UsdGeom.PointInstancer
    expected = many.ComputeInstanceTransformsAtTime(0, 0, kinds.IncludeProtoXform, kinds.IgnoreMask)
    for row, body in ((0, "Ball"), (1, "Box"), (3, "Box")):
        actual = UsdGeom.XformCache().GetLocalToWorldTransform(stage.GetPrimAtPath(f"/World/Many/instance{row}/{body}"))
        np.testing.assert_allclose(np.array(actual), np.array(expected[row] * world), atol=1e-6)


def test_velocities_of_instances_are_those_of_their_bodies(device, tmp_path):
    """They are in the frame of the instancer, which is turned by 30 degrees, and so is each instance."""
    arrays = """
        quath[] orientations = [(0.7071, 0, 0, 0.7071)]
        vector3f[] velocities = [(0.1, 0, 0)]
        vector3f[] angularVelocities = [(0, 90, 0)]
    """
    path = write(tmp_path, instancer(["Ball"], [0], [(0, 0, 1)], arrays, placed(BALL, (0, 0, 0.01))))
    simulation = Simulation(path, device=device)
    [speeds] = simulation.state.body_qd.numpy().copy()
    simulation.run(1, output=tmp_path / "out.usda")
    cos, sin = np.cos(np.pi / 6.0), np.sin(np.pi / 6.0)
    across = 0.5 * np.pi * 0.01  # the ball is 1 cm above the point about which its instance turns
    np.testing.assert_allclose(speeds[:3], np.array((cos, sin, 0.0)) * (0.1 + across), atol=1e-6)
    np.testing.assert_allclose(speeds[3:], np.array((-sin, cos, 0.0)) * 0.5 * np.pi, atol=1e-5)


def test_velocities_reach_bodies_in_instances(tmp_path):
    inner = 'def Xform "Kind" {\ndef "In" (instanceable = true\nreferences = </Asset>) {\n}\n}\n'
    scene = instancer(["Kind"], [0], [(0, 0, 1)], "vector3f[] velocities = [(0, 0, 2)]", inner)
    stage = open_stage(write(tmp_path, scene, f'class "Asset" {{\n{BALL}}}\n'))
    body = stage.GetPrimAtPath("/World/Many/instance0/Kind/In/Ball")
    assert body.GetAttribute("physics:velocity").Get() == (0.0, 0.0, 2.0)


def test_prototypes_of_several_bodies_and_instancers(tmp_path):
    """Two bodies in a prototype, colliders without a body, and an instancer within a prototype."""
    pair = f'def Xform "Pair" {{\n{placed(BALL)}{placed(BOX, (0.01, 0, 0))}{placed(STATIC, (0, 0.1, 0))}}}\n'
    row = f"""def Xform "Row" {{
        def PointInstancer "Inner" {{
            rel prototypes = </World/Many/Kinds/Row/Inner/Ball>
            int[] protoIndices = [0, 0]
            point3f[] positions = [(0, 0, 0.02), (0, 0, 0.04)]
            {BALL}
        }}
    }}
    """
    path = write(tmp_path, instancer(["Pair", "Row"], [0, 1, 1], [(0, 0, 0), (0.1, 0, 0), (0.2, 0, 0)], "", pair + row))
    contents = survey(stage := open_stage(path))
    assert contents.findings == []
    assert len(contents.bodies) == 6 and len(contents.colliders) == 7 and len(contents.magnets) == 6
    last = stage.GetPrimAtPath("/World/Many/instance2/Row/Inner/instance1/Ball")
    place = UsdGeom.XformCache().GetLocalToWorldTransform(last).ExtractTranslation()
    expected = np.array((0.1, 0, 0.06)) + 0.2 * np.array((np.cos(np.pi / 6.0), np.sin(np.pi / 6.0), 0.0))
    np.testing.assert_allclose(place, expected, atol=1e-7)


def test_instances_of_what_keys_move_follow_them(device, tmp_path):
    kinematic = BALL.replace(" \n}", "\n bool physics:kinematicEnabled = 1\n}")
    moving = instancer(["Ball"], [0, 0], [(0, 0, 0), (0, 0, 0)], "", kinematic).replace(
        "positions = [(0, 0, 0), (0, 0, 0)]",
        "positions.timeSamples = {\n 0: [(0,0,0), (0,0,1)],\n 60: [(1,0,0), (0,0,3)] }",
    )
    simulation = Simulation(write(tmp_path, moving), device=device)
    for _ in range(250):
        simulation.step()
    poses = simulation.state.body_q.numpy()[:, :3]
    x = np.array((np.cos(np.pi / 6.0), np.sin(np.pi / 6.0), 0.0))
    start = np.array((0.1, 0.0, 0.02))
    np.testing.assert_allclose(poses, (start + 0.25 * x, (*start[:2], start[2] + 1.5)), atol=1e-5)


def test_an_instancer_in_an_instance(tmp_path):
    """As tools export it: a set that is referenced twice, each time with the instancer in it."""
    asset = instancer(["Ball"], [0, 0], [(0, 0, 0), (0, 0, 1)], inner=BALL)
    (tmp_path / "set.usda").write_text('#usda 1.0\n(\n    defaultPrim = "World"\n)\n' + asset)
    twice = "".join(
        f'def "{name}" (instanceable = true\n references = @./set.usda@) {{ }}\n'.replace("}", "\n}") for name in "AB"
    )
    path = write(tmp_path, twice)
    bodies = survey(open_stage(path)).bodies
    assert bodies == [f"/{name}/Many/instance{number}/Ball" for name in "AB" for number in (0, 1)]
    simulation = Simulation(path)
    simulation.run(1, output=tmp_path / "out.usda")
    result = Usd.Stage.Open(str(tmp_path / "out.usda"))
    falls = [result.GetPrimAtPath(body).GetAttribute("physics:velocity").Get(1.0)[2] for body in bodies]
    np.testing.assert_allclose(falls, -9.81 / 60.0, rtol=0.05)


REFUSED = {
    "an index beyond the prototypes": (["Ball"], [0, 1], [(0, 0, 0), (0, 0, 1)], "", "protoIndices names prototype 1"),
    "a negative index": (["Ball"], [-1], [(0, 0, 0)], "", "protoIndices names prototype -1"),
    "too few positions": (["Ball"], [0, 0], [(0, 0, 0)], "", "positions has 1 values for 2 instances"),
    "no positions": (["Ball"], [0], [], "", "positions is missing for 1 instances"),
    "too many scales": (["Ball"], [0], [(0, 0, 0)], "float3[] scales = [(1, 1, 1), (1, 1, 1)]", "scales has 2 values"),
    "a quaternion of zeros": (
        ["Ball"],
        [0],
        [(0, 0, 0)],
        "quath[] orientations = [(0, 0, 0, 0)]",
        "orientations of instance 0 has length 0, not 1",
    ),
    "an infinite quaternion": (
        ["Ball"],
        [0],
        [(0, 0, 0)],
        "quath[] orientations = [(inf, 0, 0, 0)]",
        "orientations of instance 0 has length inf, not 1",
    ),
    "a long quaternion": (
        ["Ball"],
        [0, 0],
        [(0, 0, 0), (1, 0, 0)],
        "quath[] orientations = [(1, 0, 0, 0), (1, 0, 1, 0)]",
        "orientations of instance 1 has length 1.41421, not 1",
    ),
    **{
        f"{name} of {kind}": (
            ["Ball"],
            [0],
            [(0, 0, 0)],
            f"{kind} {name} = {value}",
            f"{name} is not an array of {wanted}",
        )
        for name, kind, value, wanted in (
            ("orientations", "Odd[]", "[(1, 0, 0, 0)]", "quaternions"),  # a type that USD does not know
            ("orientationsf", "float[]", "[1]", "quaternions"),
            ("scales", "Odd[]", "[(1, 1, 1)]", "vectors"),
        )
    },
    "a prototype that is not there": (["Gone"], [0], [(0, 0, 0)], "", "/World/Many/Kinds/Gone, which is not there"),
    "a place that is no number": (["Ball"], [0], [(0, 0, "nan")], "", "transform is not finite"),
    "too many, one unlike the others, so that they become prims": (
        ["Ball"],
        [0] * 260_000,
        "[(0, 0, 0)" + ", (0, 0, 0)" * 259_999 + "]",
        "float3[] scales = [(2, 2, 2)" + ", (1, 1, 1)" * 259_999 + "]",
        "more than 500000 prims",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_refused_with_one_line_that_names_the_prim(tmp_path, case):
    *arguments, message = REFUSED[case]
    path = write(tmp_path, instancer(*arguments, inner=BALL).replace("'", ""))
    with pytest.raises(InputError, match=r"^/World/Many[^\n]*$") as caught:
        report = check(path)
        raise InputError(str(report.errors[0]))
    assert message in str(caught.value)


@pytest.mark.parametrize("order", ["int xformOpOrder = -1", 'string xformOpOrder = "xformOp:scale"'])
def test_a_prototype_with_an_order_of_another_type(tmp_path, order):
    inner = BALL.replace("{", f"{{ {order}\n", 1)
    with pytest.raises(InputError, match="^/World/Many/Kinds/Ball: xformOpOrder must be a TokenArray, got "):
        check(write(tmp_path, instancer(["Ball"], [0], [(0, 0, 0)], inner=inner)))


def test_an_instancer_within_itself(tmp_path):
    path = write(tmp_path, instancer(["Ball"], [0], [(0, 0, 0)], inner=BALL).replace("/Kinds/Ball", ""))
    with pytest.raises(InputError, match=r"^/World/Many: a PointInstancer that is part of its own prototypes"):
        open_stage(path)


def test_alike_balls_are_imported_as_each_would_be_by_itself(tmp_path, monkeypatch):
    lines = """quath[] orientations = [(1,0,0,0), (0.6,0,0.8,0), (0,0.6,0,0.8), (0.8,0,0,0.6)]
        float3[] scales = [(1,1,1), (1.5,1.5,1.5), (1,1,1), (1.5,1.5,1.5)]"""
    flying = "radius = 0.004 \n vector3f physics:velocity = (0.1, 0.2, 0.3)"
    turned = BALL.replace("radius = 0.004", f"{flying} \n double3 xformOp:translate = (0.01, 0.02, 0)").replace(
        "(0.01, 0.02, 0)", '(0.01, 0.02, 0) \n uniform token[] xformOpOrder = ["xformOp:translate"]'
    )
    places = "[(0, 0, 0), (0.1, 0, 0), (0.2, 0.1, 0), (0, 0.2, 0.3)]"
    path = write(tmp_path, instancer(["Ball"], [0, 0, 0, 0], places, lines, turned))
    actual = import_scene(path)
    assert [len(balls.others) for balls in actual.identical_balls] == [1, 1]
    monkeypatch.setattr(scenes, "open_deferred", lambda path, time: (open_stage(path, time), []))
    wanted = import_scene(path)
    assert actual.bodies.keys() == wanted.bodies.keys()
    assert actual.magnets == wanted.magnets
    first, other = actual.builder.finalize(device="cpu"), wanted.builder.finalize(device="cpu")
    for prim, body in wanted.bodies.items():
        own, (shape,), (own_shape,) = actual.bodies[prim], wanted.magnet_shapes[prim], actual.magnet_shapes[prim]
        pose, wanted_pose = first.body_q.numpy()[own].astype(float), other.body_q.numpy()[body].astype(float)
        np.testing.assert_allclose(pose[:3], wanted_pose[:3], rtol=0.0, atol=1e-7)  # single precision of 0.5 m
        assert abs(abs(pose[3:] @ wanted_pose[3:]) - 1.0) < 1e-6  # of quaternions, which have two signs
        speeds = [model.body_qd.numpy()[row] for model, row in ((first, own), (other, body))]
        assert np.linalg.norm(speeds[1]) > 0.3
        np.testing.assert_allclose(*speeds, rtol=0.0, atol=1e-6)  # single precision of quaternions
        for name in ("body_mass", "body_inertia", "shape_scale", "shape_material_mu", "shape_gap", "shape_flags"):
            rows = (own, body) if name.startswith("body") else (own_shape, shape)
            np.testing.assert_array_equal(getattr(first, name).numpy()[rows[0]], getattr(other, name).numpy()[rows[1]])
        assert first.body_label[own] == first.shape_label[own_shape] == prim
    assert sorted(map(str, [first.GetPath() for first in actual.stage.Traverse()])) == sorted(
        str(first.GetPath()) for first in wanted.stage.Traverse()
    )
