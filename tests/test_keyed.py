"""What follows keys: poses as USD composes them at any time, and what they carry along, compared with closed forms."""

import math

import numpy as np
import pytest
from keyed_stages import (
    BODY,
    COLLIDER,
    KINEMATIC,
    MAGNET,
    RATE,
    G,
    body_of,
    cube_on_arm,
    held_ball,
    operations,
    pose_of,
    prim,
    write,
)
from pxr import Gf, Ts, Usd, UsdGeom

from warpmag import InputError, Simulation
from warpmag.usd import check, freeze, open_stage, survey

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
    keyed_values, state = simulation._stepper._keyed_values, simulation.model.state()
    for seconds in (0.0, 0.01, 1.0 / RATE, 0.41, 0.6251, 0.9, 1.3, 50.0):
        keyed_values.time.fill_(seconds)
        keyed_values.pose_for_contacts(state, 0.0, dt)
        (x, turn), (y, turned) = (pose_of(stage, "/World/Rig/Part", 5.0 + RATE * t) for t in (seconds, seconds + dt))
        q, qd = state.body_q.numpy()[body].astype(float), state.body_qd.numpy()[body].astype(float)
        # single precision of what is found, and of no sample
        np.testing.assert_allclose(q[:3], x, rtol=1e-7, atol=1e-9)
        np.testing.assert_allclose(math.copysign(1.0, q[3:] @ turn) * q[3:], turn, rtol=0, atol=2e-7)
        np.testing.assert_allclose(qd[:3], (y - x) / dt, rtol=1e-6, atol=1e-8)
        rotation = Gf.Quatd(turned[3], *turned[:3]) * Gf.Quatd(turn[3], *turn[:3]).GetInverse()
        spin = 2.0 * np.array(rotation.GetImaginary()) * math.copysign(1.0, rotation.GetReal()) / dt
        np.testing.assert_allclose(qd[3:], spin, rtol=1e-4, atol=1e-8)  # sines of small angles


@pytest.mark.parametrize("step", [1e-3, 4e-3])
def test_a_keyed_magnet_drags_a_ball_along_a_circle(tmp_path, device, step):
    """The ball it holds goes round with it, at the speed it is set off with: 1 % of the way is asked for."""
    path = write(tmp_path, cube_on_arm(rotateZ={0: 0, 24: 180}), held_ball(0.065))
    simulation = Simulation(path, device=device, dt=step)
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
        freeze(stage, time)
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
    assert [str(error) for error in check(path).errors] == [
        "/World/Part: xformOp:translateX is a spline, which a run does not read: bake it into time samples"
    ]


@pytest.mark.parametrize("name", ["ampereTurns", "voltage"])
def test_a_spline_of_a_coil_is_refused(tmp_path, name):
    path = write(tmp_path, 'def Xform "Coil" (prepend apiSchemas = ["WarpmagCoilAPI"])\n{\n'
                 "uniform float warpmag:coil:radius = 0.02\n"
                 "uniform float warpmag:coil:turns = 10\nuniform float warpmag:coil:resistance = 1\n"
                 f"float warpmag:coil:{name}.spline = {{\n0: 1,\n24: 2,\n}}\n}}\n", held_ball(1))  # fmt: skip
    assert [str(error) for error in check(path).errors] == [
        f"/World/Coil: warpmag:coil:{name} is a spline, which a run does not read: bake it into time samples"
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
    with pytest.raises(InputError, match=r"^/World/Joint: its physics:body1 /World/Carrier is moved by keys"):
        Simulation(path, device=device)
