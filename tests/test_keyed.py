"""What follows keys: poses as USD composes them at any time, what they carry along, fields and magnetizations.

Motions are compared with USD's own, and with closed forms of what is carried, magnetized and turned.
"""

import math

import numpy as np
import pytest
from pxr import Gf, Ts, Usd, UsdGeom

from warpmag import InputError, Simulation
from warpmag.usd import check, hold, open_stage, survey

MU0 = 4e-7 * math.pi
G = 9.81
RATE = 24.0
HEAD = """#usda 1.0
(
    metersPerUnit = 1
    kilogramsPerUnit = 1
    upAxis = "Z"
    defaultPrim = "World"
    startTimeCode = START
    endTimeCode = 100
    timeCodesPerSecond = 24
    framesPerSecond = 12
)
def Xform "World"
{
def PhysicsScene "Scene" (prepend apiSchemas = ["WarpmagSceneAPI"])
{
    vector3f physics:gravityDirection = (0, 0, -1)
    float physics:gravityMagnitude = GRAVITY
    SCENE
}
def Material "Rough" (prepend apiSchemas = ["PhysicsMaterialAPI"])
{
    float physics:staticFriction = 0.4
    float physics:dynamicFriction = 0.4
    float physics:restitution = 0
}
BODIES
}
"""
MAGNET, BODY, COLLIDER = "WarpmagMagnetAPI", "PhysicsRigidBodyAPI", "PhysicsCollisionAPI"
KINEMATIC = "bool physics:kinematicEnabled = 1"


def prim(kind, name, apis, *lines):
    quoted = ", ".join(f'"{one}"' for one in (*apis, "MaterialBindingAPI", "PhysicsMassAPI"))
    inner = "\n".join(("rel material:binding = </World/Rough>", *lines))
    return f'def {kind} "{name}" (prepend apiSchemas = [{quoted}])\n{{\n{inner}\n}}\n'


def operations(**given):
    """Transforms in the order given, each a value or samples, or others in the words of USD for ``order``.

    Names have double underscores for colons.
    """
    types = {"translate": "double3", "scale": "float3", "orient": "quatd", "transform": "matrix4d", "rotate": "double3"}
    lines, order = [], []
    for name, value in given.items():
        if name.startswith("order"):
            order.append(f'"{value}"')
            continue
        name = f"xformOp:{name.replace('__', ':')}"
        kind = name.split(":")[1]
        kind = "double" if kind in ("translateX", "rotateZ", "scaleY") else types[kind.rstrip("XYZ")]
        samples = ".timeSamples" if isinstance(value, dict) else ""
        lines.append(f"{kind} {name}{samples} = {text(value)}")
        order.append(f'"{name}"')
    lines.append(f"uniform token[] xformOpOrder = [{', '.join(order)}]")
    return "\n".join(lines)


def text(value):
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{time:.17g}: {one}" for time, one in value.items()) + " }"
    return str(value)


def write(folder, *bodies, scene="", gravity=0.0, start=0, name="scene.usda"):
    path = folder / name
    found = HEAD.replace("START", str(start)).replace("GRAVITY", str(gravity)).replace("SCENE", scene)
    path.write_text(found.replace("BODIES", "\n".join(bodies)))
    return path


def body_of(simulation, name):
    return simulation._scene.bodies[f"/World/{name}"]


def pose_of(stage, path, time):
    """Position, and orientation x y z w, that USD composes."""
    frame = Gf.Transform(UsdGeom.XformCache(time).GetLocalToWorldTransform(stage.GetPrimAtPath(path)))
    turn = frame.GetRotation().GetQuat()
    return np.array(frame.GetTranslation()), np.array([*turn.GetImaginary(), turn.GetReal()])


MOTIONS = {
    "an arm": (
        operations(translate={5: (0, 0, 0), 20: (0.1, 0.02, 0)}, rotateZ={5: 10, 25: 300}, scale=(2, 2, 2)),
        operations(
            translate__pivot=(0.01, 0, 0),
            orient={5: (1, 0, 0, 0), 15: (0.5, 0.5, 0.5, 0.5), 28: (-0.8, 0.6, 0, 0)},
            rotateYXZ={6: (0, 10, 20), 27: (50, 80, -100)},
            order="!invert!xformOp:translate:pivot",
            scale=(1, 2, 1),
        ),
    ),
    "a matrix above": (
        operations(
            transform={
                5: "( (1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0), (0.3, 0, 0, 1) )",
                25: "( (1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0), (0.3, 0.1, 0, 1) )",
            }
        ),
        "",
    ),
    "single axes": (
        operations(translateX={0: 0.3, 9: 0.2}, rotateZYX={5: (1, 2, 300), 50: (7, 90, 5)}),
        operations(translate={7: (0, 0, 1)}, rotateXZY={8: (0, 10, 20), 9: (50, 80, -100)}, scaleY=2.0),
    ),
    "what resets": (
        operations(translate={5: (0, 0, 0), 20: (9, 0, 0)}),
        operations(order="!resetXformStack!", translate={5: (0, 1, 0), 20: (1, 0, 0)}),
    ),
}


@pytest.mark.parametrize("kinematic", [True, False], ids=["a kinematic body", "a collider that is no body"])
@pytest.mark.parametrize("motion", MOTIONS, ids=str)
def test_bodies_go_where_usd_composes_them(tmp_path, device, motion, kinematic):
    above, own = MOTIONS[motion]
    apis = (BODY, COLLIDER, MAGNET) if kinematic else (COLLIDER, MAGNET)
    lines = [own, "double size = 0.01", *([KINEMATIC] if kinematic else [])]
    rig = f'def Xform "Rig"\n{{\n{above}\n{prim("Cube", "Part", apis, *lines)}\n}}'
    path = write(tmp_path, rig, start=5)
    report = check(path)
    assert not report.errors
    assert list(report.contents.motions) == report.contents.kinematic == ["/World/Rig/Part"]
    simulation, stage = Simulation(path, device=device), Usd.Stage.Open(str(path))
    body, dt = body_of(simulation, "Rig/Part"), 5e-4
    drive, state = simulation._stepper._drive, simulation.model.state()
    for seconds in (0.0, 0.01, 1.0 / RATE, 0.41, 0.6251, 0.9, 1.3, 50.0):
        drive.time.fill_(seconds)
        drive.place(state, 0.0, dt)
        (x, turn), (y, turned) = (pose_of(stage, "/World/Rig/Part", 5.0 + RATE * t) for t in (seconds, seconds + dt))
        q, qd = state.body_q.numpy()[body].astype(float), state.body_qd.numpy()[body].astype(float)
        # single precision of what is found, and of no sample
        np.testing.assert_allclose(q[:3], x, rtol=1e-7, atol=1e-9)
        np.testing.assert_allclose(math.copysign(1.0, q[3:] @ turn) * q[3:], turn, rtol=0, atol=2e-7)
        np.testing.assert_allclose(qd[:3], (y - x) / dt, rtol=1e-6, atol=1e-8)
        rotation = Gf.Quatd(turned[3], *turned[:3]) * Gf.Quatd(turn[3], *turn[:3]).GetInverse()
        spin = 2.0 * np.array(rotation.GetImaginary()) * math.copysign(1.0, rotation.GetReal()) / dt
        np.testing.assert_allclose(qd[3:], spin, rtol=1e-4, atol=1e-8)  # sines of small angles


def held_ball(distance):
    return prim("Sphere", "Ball", (BODY, COLLIDER, MAGNET), "double radius = 0.005", "float physics:density = 7874",
                operations(translate=(distance, 0, 0)))  # fmt: skip


def cube_on_arm(**arm):
    """A magnet of 2 cm, 5 cm from the axis of what turns it."""
    own = operations(translate=(0.05, 0, 0))
    lines = ("double size = 0.02", KINEMATIC, 'uniform token warpmag:kind = "permanent"')
    field = "vector3f warpmag:magnetization = (1e6, 0, 0)"
    cube = prim("Cube", "Magnet", (BODY, COLLIDER, MAGNET), *lines, field, own)
    return f'def Xform "Arm"\n{{\n{operations(**arm)}\n{cube}\n}}'


@pytest.mark.parametrize("step", [1e-3, 4e-3])
def test_a_keyed_magnet_drags_a_ball_along_a_circle(tmp_path, device, step):
    """The ball it holds goes round with it, at the speed it is set off with: 1 % of the way is asked for."""
    path = write(tmp_path, cube_on_arm(rotateZ={0: 0, 24: 180}), held_ball(0.065))
    simulation = Simulation(path, device=device, step=step)
    ball = body_of(simulation, "Ball")
    for _ in range(round(0.5 / step)):
        simulation.step()
    angle = math.pi * simulation.time
    exact = 0.065 * np.array([math.cos(angle), math.sin(angle), 0.0])
    q, qd = simulation.state.body_q.numpy()[ball], simulation.state.body_qd.numpy()[ball]
    # as the face turns, iterations of contacts leave a thousandth of its speed as slip, in each substep the same way
    assert np.linalg.norm(q[:3] - exact) < 3e-3 * 0.065 * angle
    assert qd[:3] == pytest.approx(0.065 * math.pi * np.array([-math.sin(angle), math.cos(angle), 0.0]), abs=2e-3)
    assert simulation.capture_failure == ""
    assert simulation.statistics.capped == 0


def tray(keys):
    lines = operations(translate=keys, scale=(4, 0.1, 0.01)), "double size = 1"
    box = prim("Cube", "Box", (BODY, COLLIDER, MAGNET), "double size = 0.02", operations(translate=(0, 0, 0.015)))
    return prim("Cube", "Tray", (COLLIDER,), *lines), box


def test_a_tray_carries_a_box_by_friction(tmp_path, device):
    """It goes along below the limit of friction, and slides with the acceleration μg beyond."""
    for acceleration in (2.0, 8.0):
        keys = {code / 16: (0.5 * acceleration * (code / 16 / RATE) ** 2, 0, 0) for code in range(129)}
        simulation = Simulation(write(tmp_path, *tray(keys), gravity=G), device=device)
        for _ in range(300):
            simulation.step()
        q = simulation.state.body_q.numpy()
        box, under = q[body_of(simulation, "Box")], q[body_of(simulation, "Tray")]
        t = simulation.time
        assert under[0] == pytest.approx(0.5 * acceleration * t**2, rel=1e-4)  # between keys 2.6 ms apart
        # at each key the tray's speed jumps by aδ, which friction makes up for in aδ/μg: 0.4 % of the way is lost
        assert box[0] == pytest.approx(0.5 * min(acceleration, 0.4 * G) * t**2, rel=0.01)
        assert box[2] == pytest.approx(0.015, abs=1e-4)


def test_a_piston_pushes_what_it_meets(tmp_path, device):
    """Also when it sets out from far away at once: contacts are sought with the speed that it is going to have."""
    keys = {0: (-0.5, 0, 0), 2.4: (-0.5, 0, 0), 4.8: (0.0, 0, 0), 24: (0, 0, 0)}  # 5 m/s from 0.1 s to 0.2 s
    piston = prim("Cube", "Piston", (COLLIDER,), "double size = 0.02", operations(translate=keys))
    simulation = Simulation(write(tmp_path, piston, held_ball(-0.1)), device=device)
    for _ in range(180):
        simulation.step()
    at = simulation.state.body_q.numpy()
    ball, face = at[body_of(simulation, "Ball")][0], at[body_of(simulation, "Piston")][0] + 0.01
    assert face == pytest.approx(-0.09, abs=1e-5)
    assert -1e-5 < ball - 0.005 - face < 1e-3
    assert simulation.state.body_qd.numpy()[body_of(simulation, "Ball")][0] == pytest.approx(5.0, rel=0.01)


QUAD = """point3f[] points = [(-0.1, -0.1, 0), (0.1, -0.1, 0), (0.1, 0.1, 0), (-0.1, 0.1, 0)]
int[] faceVertexCounts = [4]
int[] faceVertexIndices = [0, 1, 2, 3]"""


@pytest.mark.parametrize(("kind", "lines"), [("Plane", ('uniform token axis = "Z"',)), ("Mesh", (QUAD,))])
def test_what_has_no_mass_lifts_as_well(tmp_path, device, kind, lines):
    """Planes and open meshes are no rigid bodies otherwise."""
    lift = prim(kind, "Lift", (COLLIDER,), *lines, operations(translate={0: (0, 0, -0.0052), 24: (0, 0, 0.0448)}))
    simulation = Simulation(write(tmp_path, lift, held_ball(0.0), gravity=G), device=device)
    for _ in range(400):
        simulation.step()
    height = simulation.state.body_q.numpy()[body_of(simulation, "Ball"), 2]
    assert height == pytest.approx(0.05 * simulation.time - 0.0002, abs=1e-5)


def test_a_collider_in_an_instance_that_keys_move_is_refused(tmp_path):
    keys = operations(translate={0: (0, 0, 0), 24: (0, 0, 1)})
    copy = 'def Xform "Copy" (instanceable = true\nreferences = </World/Original>)\n{\n}'
    original = 'def Xform "Original"\n{\n' + prim("Cube", "Part", (COLLIDER,), "double size = 0.01") + "}"
    path = write(tmp_path, f'def Xform "Rig"\n{{\n{keys}\n{copy}\n}}', original, held_ball(1))
    message = r"^/World/Rig/Copy/Part: moves by keys inside an instance: set instanceable = false on /World/Rig/Copy$"
    with pytest.raises(InputError, match=message):
        check(path)


def test_a_stage_is_held_at_another_moment_as_well(tmp_path):
    """What a collider that is no body became, it stays."""
    keys = operations(translate={0: (0, 0, 0), 24: (0, 0, 1)})
    path = write(tmp_path, prim("Cube", "Part", (COLLIDER,), "double size = 0.01", keys), held_ball(1))
    stage = open_stage(path)
    for time in (12.0, 24.0):
        hold(stage, time)
        assert UsdGeom.XformCache().GetLocalToWorldTransform(stage.GetPrimAtPath("/World/Part"))[3][2] == time / 24.0
        contents = survey(stage)
        assert contents.kinematic == ["/World/Part"]
        assert contents.motions["/World/Part"].operations[0].keys.times.tolist() == [0.0, 24.0]


def test_a_spline_is_refused_where_a_run_would_follow_it(tmp_path):
    lines = "double size = 0.01", operations(translateX=0.0)
    path = write(tmp_path, prim("Cube", "Part", (COLLIDER,), *lines), held_ball(1))
    spline = Ts.Spline("double")
    for time, value in ((0.0, 0.0), (24.0, 1.0)):
        knot = Ts.Knot("double", time=time, value=value)
        spline.SetKnot(knot)
    stage = Usd.Stage.Open(str(path))
    stage.GetAttributeAtPath("/World/Part.xformOp:translateX").SetSpline(spline)
    stage.Save()
    assert [str(one) for one in check(path).errors] == [
        "/World/Part: xformOp:translateX is a spline, of which a run reads no keys: bake it into time samples"
    ]


def test_a_joint_to_a_keyed_body_follows_it(tmp_path, device):
    carrier = prim("Cube", "Carrier", (BODY, COLLIDER), "double size = 0.01", KINEMATIC,
                   operations(translate={0: (0, 0, 0), 24: (0.5, 0, 0)}))  # fmt: skip
    joint = """def PhysicsFixedJoint "Joint"
{
    rel physics:body0 = </World/FIRST>
    rel physics:body1 = </World/SECOND>
    point3f physics:localPos0 = PLACE
}"""
    right = joint.replace("FIRST", "Carrier").replace("SECOND", "Ball").replace("PLACE", "(0.03, 0, 0)")
    simulation = Simulation(write(tmp_path, carrier, held_ball(0.03), right), device=device)
    for _ in range(200):
        simulation.step()
    ball = simulation.state.body_q.numpy()[body_of(simulation, "Ball")]
    assert ball[0] - 0.03 == pytest.approx(0.5 * simulation.time, rel=0.01)
    wrong = joint.replace("FIRST", "Ball").replace("SECOND", "Carrier").replace("PLACE", "(-0.03, 0, 0)")
    path = write(tmp_path, carrier, held_ball(0.03), wrong, name="wrong.usda")
    with pytest.raises(InputError, match=r"^/World/Joint: hangs on /World/Carrier, which keys move, by physics:body1"):
        Simulation(path, device=device)


def pulse(height):
    return {0: (0, 0, 0), 1.2: (0, 0, 0), 2.4: f"(0, {height}, 0)", 4.8: (0, 0, 0)}


def test_a_pulsed_field_turns_a_compass_and_magnetizes_iron(tmp_path, device):
    """As much as its keys say: I ω = μ0 m ∫ H dt while the needle has hardly turned, and m = 4π R³ H of iron."""
    height, radius, strength = 40.0, 0.005, 1e4
    compass = prim(
        "Sphere", "Compass", (BODY, COLLIDER, MAGNET), f"double radius = {radius}", "float physics:density = 7874",
        'uniform token warpmag:kind = "permanent"', f"vector3f warpmag:magnetization = ({strength}, 0, 0)",
    )  # fmt: skip
    iron = held_ball(50.0).replace("Ball", "Iron")
    scene = f"vector3f warpmag:externalField.timeSamples = {text(pulse(height))}"
    simulation = Simulation(write(tmp_path, compass, iron, scene=scene), device=device)
    assert check(tmp_path / "scene.usda").contents.field_keys is not None
    volume = 4.0 / 3.0 * math.pi * radius**3
    inertia, moment = 0.4 * 7874.0 * volume * radius**2, volume * strength
    needle, spun = body_of(simulation, "Compass"), []
    for number in range(250):
        simulation.step()
        field = np.interp(simulation.time - 5e-4, [0.05, 0.1, 0.2], [0.0, height, 0.0])  # of the last substep
        found = simulation.magnetics.system.external_field.numpy()
        assert found[:, 1] == pytest.approx(field, abs=1e-5 * height)
        if number % 50 == 0:
            moments = dict(zip(simulation.magnetics.shapes, simulation.magnetics.shape_moments(), strict=True))
            shape = simulation._scene.magnet_shapes["/World/Iron"][0]
            # of an ideally permeable ball, and the compass at 50 m; rtol of the induction
            assert moments[shape][1] == pytest.approx(3.0 * volume * field, rel=1e-3, abs=1e-9)
        spun.append(simulation.state.body_qd.numpy()[needle, 5])
    area = 0.5 * height * 0.15
    # the needle turns by 0.02 meanwhile: the cosine, and half a substep of the pulse
    assert spun[-1] == pytest.approx(MU0 * moment * area / inertia, rel=2e-3)
    assert spun[45] == 0.0 or abs(spun[45]) < 1e-6
    assert simulation.capture_failure == ""


def test_a_field_that_is_given_stands_in_for_the_keys(tmp_path, device):
    path = write(tmp_path, held_ball(0.0), scene=f"vector3f warpmag:externalField.timeSamples = {text(pulse(9.0))}")
    simulation = Simulation(path, device=device, external_field=(1.0, 2.0, 3.0))
    for _ in range(120):
        simulation.step()
    assert (simulation.magnetics.system.external_field.numpy() == (1.0, 2.0, 3.0)).all()


@pytest.mark.parametrize("where", ["a body", "a capsule that is no body", "a named material"])
def test_a_magnet_that_is_switched(tmp_path, device, where):
    """Its moment is what the keys say at each substep, in the frame of its prim."""
    samples = {0: (0, 0, 0), 6: (0, 0, 2e5), 12: (1e5, 0, -1e5)}
    common = ['uniform token warpmag:kind = "permanent"']
    strength = 1.0
    if where == "a named material":
        samples = {0: (0, 0, 3), 6: (0, 0, 1), 12: (0.0, 0, -0.5)}
        common.append('uniform token warpmag:material = "N42"')
    common.append(f"vector3f warpmag:magnetization.timeSamples = {text(samples)}")
    if where == "a capsule that is no body":
        lines = "double radius = 0.005", "double height = 0.01", 'uniform token axis = "X"', operations(rotateZ=90)
        magnet = prim("Capsule", "Magnet", (COLLIDER, MAGNET), *lines, *common)
    else:
        magnet = prim("Cube", "Magnet", (BODY, COLLIDER, MAGNET), "double size = 0.01", KINEMATIC,
                      operations(rotateZ=90), *common)  # fmt: skip
    path = write(tmp_path, magnet, held_ball(0.1))
    assert list(check(path).contents.magnetization_keys) == ["/World/Magnet"]
    simulation = Simulation(path, device=device)
    times, values = np.array(list(samples)) / RATE, np.array(list(samples.values()), dtype=float)
    if where == "a named material":
        from warpmag.materials import MATERIALS  # noqa: PLC0415

        strength = MATERIALS["n42"].magnetization if "n42" in MATERIALS else MATERIALS["N42"].magnetization
        values = np.sign(values) * strength
    shape = simulation._scene.magnet_shapes["/World/Magnet"][0]
    row = simulation.magnetics.shapes.tolist().index(shape)
    for _ in range(6):
        for _ in range(100):
            simulation.step()
        own = [np.interp(simulation.time - 5e-4, times, column) for column in values.T]
        turned = np.array([-own[1], own[0], own[2]])  # the prim is turned by 90 degrees about z
        found = simulation.magnetics.shape_moments()[row] / simulation.magnetics.shape_volumes[row]
        np.testing.assert_allclose(found, turned, rtol=0, atol=1e-5 * np.abs(values).max())


def test_substeps_that_are_shortened_follow_the_same_keys(tmp_path, device):
    """Balls that fall on a moving magnet: attempts are repeated, and the magnet stands where it is to."""
    keys = {0: (0, 0, 0), 12: (0, 0, 0.05)}
    cube = prim("Cube", "Magnet", (BODY, COLLIDER, MAGNET), "double size = 0.02", KINEMATIC,
                'uniform token warpmag:kind = "permanent"', "vector3f warpmag:magnetization = (0, 0, 1e6)",
                operations(translate=keys))  # fmt: skip
    balls = [
        held_ball(0).replace("Ball", f"Ball{k}").replace("(0, 0, 0)", f"({0.006 * k - 0.009}, {0.011 * (k % 2)}, 0.04)")
        for k in range(4)
    ]
    simulation = Simulation(write(tmp_path, cube, *balls, gravity=G), device=device, step=2e-3)
    body = body_of(simulation, "Magnet")
    for _ in range(60):
        simulation.step()
        at = simulation.state.body_q.numpy()[body, 2]
        assert at == pytest.approx(0.1 * simulation.time, abs=1e-8)
    figures = simulation.statistics
    assert figures.repeated > 0
    assert figures.substeps > 4 * 60


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        (operations(translate={0: (0, 0, 0), 5: ("nan", 0, 0)}), "/World/Part: xformOp:translate is not finite"),
        (operations(translate={0: (0, 0, 0), 5: None}), "/World/Part: xformOp:translate has no value at time code 5"),
        (operations(translate={0: (0, 0, 0), 5: (1e12, 0, 0)}), "/World/Part: keyed transform reaches beyond"),
        (operations(scale={0: (1, 1, 1), 5: (2, 2, 2)}), "/World/Part: its scale is keyed"),
        (operations(scale={0: (1, 1, 1), 5: (1, 1, -1)}), "/World/Part: keyed transform"),
        (operations(orient={0: (1, 0, 0, 0), 5: (0, 0, 0, 0)}), "/World/Part: xformOp:orient has a quaternion of zero"),
    ],
)
def test_what_no_body_can_follow_is_refused(tmp_path, lines, message):
    lines = lines.replace("'", "").replace("None", "None")
    path = write(tmp_path, prim("Cube", "Part", (BODY, COLLIDER), "double size = 0.01", KINEMATIC, lines), held_ball(1))
    refusals = [str(one) for one in check(path).errors]
    assert refusals and refusals[0].startswith(message), refusals


def test_samples_of_fields_that_are_not_finite_are_refused(tmp_path):
    bad = text({0: "(0, 0, 0)", 5: "(0, nan, 0)"})
    path = write(tmp_path, held_ball(0), scene=f"vector3f warpmag:externalField.timeSamples = {bad}")
    assert [str(one) for one in check(path).errors] == [
        "/World/Scene: warpmag:externalField at time code 5: must be finite, got (0.0, nan, 0.0)"
    ]
    lines = 'uniform token warpmag:kind = "permanent"', f"vector3f warpmag:magnetization.timeSamples = {bad}"
    path = write(tmp_path, prim("Sphere", "Part", (COLLIDER, MAGNET), "double radius = 0.01", *lines), held_ball(1))
    assert [str(one) for one in check(path).errors] == [
        "/World/Part: warpmag:magnetization at time code 5: must be finite, got (0.0, nan, 0.0)"
    ]


def test_the_stage_of_a_run_has_the_scenes_keys(tmp_path, device, capsys):
    """A run leaves them alone, so that a keyed prim stands between frames, too, where the scene says."""
    from warpmag.cli import main  # noqa: PLC0415 - imports Warp

    path = write(tmp_path, cube_on_arm(rotateZ={0: 0, 24: 180}), held_ball(0.065))
    assert main(["check", str(path)]) == 0
    assert "keyed       1 bodies, 0 magnetizations\n" in capsys.readouterr().out
    Simulation(path, device=device).run(3, output=tmp_path / "out.usda")
    scene, result = (Usd.Stage.Open(str(one)) for one in (path, tmp_path / "out.usda"))
    for time in (0.0, 1.1, 3.3, 24.0):
        for expected, found in zip(*(pose_of(one, "/World/Arm/Magnet", time) for one in (scene, result)), strict=True):
            assert (expected == found).all()
    ball = result.GetPrimAtPath("/World/Ball").GetAttribute("xformOp:translate:warpmag")
    assert ball.GetNumTimeSamples() == 4
    moments = result.GetPrimAtPath("/World/Arm/Magnet").GetAttribute("warpmag:moment")
    assert moments.GetNumTimeSamples() > 2


def test_a_resumed_run_goes_on_along_the_keys(tmp_path, device, monkeypatch):
    """Killed and resumed, it ends with the bits of a run that nobody disturbed."""
    from test_run_survives import samples  # noqa: PLC0415

    monkeypatch.setattr("warpmag.usd.writer._CHECKPOINT_SECONDS", 0.0)
    monkeypatch.setattr("warpmag.usd.writer._CHECKPOINT_SHARE", math.inf)
    scene = f"vector3f warpmag:externalField.timeSamples = {text(pulse(4e4))}"
    path = write(tmp_path, cube_on_arm(rotateZ={0: 0, 24: 180}), held_ball(0.0662), scene=scene)

    def run(name, last, resume):
        simulation = Simulation(path, device=device)
        output = tmp_path / name / "out.usda"
        figures = simulation.run(4, output=output, resume=resume, on_frame=lambda frame: frame < last)
        return figures.evaluations, figures.substeps, samples(output)

    expected = run("whole", 4, False)
    for last in (1, 3, 4):
        found = run("parts", last, True)
    assert found == expected
