"""Fields and magnetizations that follow keys, what no body can follow, and the stages of such runs."""

import math

import numpy as np
import pytest
from keyed_stages import (
    BODY,
    COLLIDER,
    KINEMATIC,
    MAGNET,
    MU0,
    RATE,
    G,
    body_of,
    cube_on_arm,
    held_ball,
    operations,
    pose_of,
    prim,
    text,
    write,
)
from pxr import Usd

from warpmag import Simulation
from warpmag.usd import check


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
        result = simulation.magnetics.system.external_field.numpy()
        assert result[:, 1] == pytest.approx(field, abs=1e-5 * height)
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
        from warpmag.declarations.materials import MATERIALS  # noqa: PLC0415

        strength = MATERIALS["n42"].magnetization if "n42" in MATERIALS else MATERIALS["N42"].magnetization
        values = np.sign(values) * strength
    shape = simulation._scene.magnet_shapes["/World/Magnet"][0]
    row = simulation.magnetics.shapes.tolist().index(shape)
    for _ in range(6):
        for _ in range(100):
            simulation.step()
        own = [np.interp(simulation.time - 5e-4, times, column) for column in values.T]
        turned = np.array([-own[1], own[0], own[2]])  # the prim is turned by 90 degrees about z
        result = simulation.magnetics.shape_moments()[row] / simulation.magnetics.shape_volumes[row]
        np.testing.assert_allclose(result, turned, rtol=0, atol=1e-5 * np.abs(values).max())


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
    simulation = Simulation(write(tmp_path, cube, *balls, gravity=G), device=device, dt=2e-3)
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
        (operations(translate={0: (0, 0, 0), 5: (1e12, 0, 0)}), "/World/Part: keyed transform reaches"),
        (operations(scale={0: (1, 1, 1), 5: (2, 2, 2)}), "/World/Part: its scale is keyed"),
        (operations(scale={0: (1, 1, 1), 5: (1, 1, -1)}), "/World/Part: keyed transform"),
        (operations(orient={0: (1, 0, 0, 0), 5: (0, 0, 0, 0)}), "/World/Part: xformOp:orient has a quaternion of zero"),
    ],
)
def test_what_no_body_can_follow_is_refused(tmp_path, lines, message):
    lines = lines.replace("'", "").replace("None", "None")
    path = write(tmp_path, prim("Cube", "Part", (BODY, COLLIDER), "double size = 0.01", KINEMATIC, lines), held_ball(1))
    refusals = [str(error) for error in check(path).errors]
    assert refusals and refusals[0].startswith(message), refusals


def test_samples_of_fields_that_are_not_finite_are_refused(tmp_path):
    bad = text({0: "(0, 0, 0)", 5: "(0, nan, 0)"})
    path = write(tmp_path, held_ball(0), scene=f"vector3f warpmag:externalField.timeSamples = {bad}")
    assert [str(error) for error in check(path).errors] == [
        "/World/Scene: warpmag:externalField at time code 5: must be finite, got (0.0, nan, 0.0)"
    ]
    lines = 'uniform token warpmag:kind = "permanent"', f"vector3f warpmag:magnetization.timeSamples = {bad}"
    path = write(tmp_path, prim("Sphere", "Part", (COLLIDER, MAGNET), "double radius = 0.01", *lines), held_ball(1))
    assert [str(error) for error in check(path).errors] == [
        "/World/Part: warpmag:magnetization at time code 5: must be finite, got (0.0, nan, 0.0)"
    ]


def test_the_stage_of_a_run_has_the_scenes_keys(tmp_path, device, capsys):
    """A run leaves them alone, so that a keyed prim stands between frames, too, where the scene says."""
    from warpmag.cli import main  # noqa: PLC0415 - imports Warp

    path = write(tmp_path, cube_on_arm(rotateZ={0: 0, 24: 180}), held_ball(0.065))
    assert main(["check", str(path)]) == 0
    assert "keyed       1 bodies, 0 magnetizations\n" in capsys.readouterr().out
    Simulation(path, device=device).run(3, output=tmp_path / "out.usda")
    scene, result = (Usd.Stage.Open(str(entry)) for entry in (path, tmp_path / "out.usda"))
    for time in (0.0, 1.1, 3.3, 24.0):
        for expected, actual in zip(
            *(pose_of(entry, "/World/Arm/Magnet", time) for entry in (scene, result)), strict=True
        ):
            assert (expected == actual).all()
    ball = result.GetPrimAtPath("/World/Ball").GetAttribute("xformOp:translate:warpmag")
    assert ball.GetNumTimeSamples() == 4
    moments = result.GetPrimAtPath("/World/Arm/Magnet").GetAttribute("warpmag:moment")
    assert moments.GetNumTimeSamples() > 2


def test_a_resumed_run_goes_on_along_the_keys(tmp_path, device, monkeypatch):
    """Killed and resumed, it ends with the bits of a run that nobody disturbed."""
    from test_run_survives import samples  # noqa: PLC0415

    monkeypatch.setattr("warpmag.usd.write.writer._CHECKPOINT_SECONDS", 0.0)
    monkeypatch.setattr("warpmag.usd.write.writer._CHECKPOINT_SHARE", math.inf)
    scene = f"vector3f warpmag:externalField.timeSamples = {text(pulse(4e4))}"
    path = write(tmp_path, cube_on_arm(rotateZ={0: 0, 24: 180}), held_ball(0.0662), scene=scene)

    def run(name, last, resume):
        simulation = Simulation(path, device=device)
        output = tmp_path / name / "out.usda"
        figures = simulation.run(4, output=output, resume=resume, on_frame=lambda frame: frame < last)
        return figures.evaluations, figures.substeps, samples(output)

    expected = run("whole", 4, False)
    for last in (1, 3, 4):
        actual = run("parts", last, True)
    assert actual == expected
