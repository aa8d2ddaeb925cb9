"""Magnets in environments of Isaac Lab, which ``.ci/isaaclab`` installs: fields and forces against closed forms."""

import numpy as np
import pytest
from pxr import Usd, UsdGeom, UsdPhysics

pytest.importorskip("isaaclab", reason="needs Isaac Lab: .ci/isaaclab")

import torch
import warp as wp
from isaaclab.app import launch_simulation
from isaaclab.assets import RigidObjectCfg
from isaaclab.envs import DirectRLEnv, DirectRLEnvCfg
from isaaclab.scene import InteractiveSceneCfg
from isaaclab.sim import SimulationCfg, UsdFileCfg
from isaaclab_newton.physics import NewtonCfg, NewtonManager, XPBDSolverCfg

from warpmag import InputError
from warpmag.declarations.magnets import Magnet
from warpmag.isaaclab import Magnets
from warpmag.usd import author_magnet

MU0 = 4e-7 * np.pi
R, M, MASS = 0.005, 1e6, 0.004  # radius [m], magnetization [A/m] and mass [kg] of the needle, along z
MOMENT = 4 / 3 * np.pi * R**3 * M  # A·m²
LOOP, HALL, NEEDLE = 0.05, 0.05, 0.1  # radius of the coil around the origin, heights of sensor and needle [m]
CURRENT, DT = 1000.0, 0.002  # A·turns, s
RESISTANCE, INDUCTANCE = 0.5, 2e-3  # of a second coil, Ω and H


def on_axis(current, z):
    """Flux density on the axis of the coil [T], and its derivative along the axis [T/m]."""
    squared = LOOP**2 + z**2
    field = MU0 * current * LOOP**2 / (2 * squared**1.5)
    return field, -3 * z / squared * field


def reading(current):
    """Field of the coil and of the needle at the sensor, which are on one axis [T]."""
    return on_axis(current, HALL)[0] + MU0 * 2 * MOMENT / (4 * np.pi * (NEEDLE - HALL) ** 3)


def needle_file(folder):
    """A file with a ball that is a magnet by its attributes."""
    path = str(folder / "needle.usda")
    stage = Usd.Stage.CreateNew(path)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    body = UsdGeom.Xform.Define(stage, "/Needle").GetPrim()
    stage.SetDefaultPrim(body)
    UsdPhysics.RigidBodyAPI.Apply(body)
    UsdPhysics.MassAPI.Apply(body).CreateMassAttr(MASS)
    ball = UsdGeom.Sphere.Define(stage, "/Needle/ball")
    ball.CreateRadiusAttr(R)
    UsdPhysics.CollisionAPI.Apply(ball.GetPrim())
    author_magnet(ball.GetPrim(), Magnet("permanent", magnetization=(0.0, 0.0, M)))
    stage.Save()
    return path


class Environment(DirectRLEnv):
    def _pre_physics_step(self, actions): ...

    def _apply_action(self): ...

    def _get_observations(self):
        return {"policy": torch.zeros(self.num_envs, 1)}

    def _get_rewards(self):
        return torch.zeros(self.num_envs)

    def _get_dones(self):
        never = torch.zeros(self.num_envs, dtype=torch.bool)
        return never, never

    def step_once(self):
        self.step(torch.zeros(self.num_envs, 1))


@pytest.fixture(scope="module")
def environment(tmp_path_factory):
    start = RigidObjectCfg.InitialStateCfg(pos=(0.0, 0.0, NEEDLE))
    scene = InteractiveSceneCfg(num_envs=3, env_spacing=2.0)
    spawn = UsdFileCfg(usd_path=needle_file(tmp_path_factory.mktemp("needle")))
    scene.needle = RigidObjectCfg(prim_path="{ENV_REGEX_NS}/Needle", spawn=spawn, init_state=start)
    physics = NewtonCfg(solver_cfg=XPBDSolverCfg(), num_substeps=2)
    sim = SimulationCfg(dt=DT, device="cpu", gravity=(0.0, 0.0, 0.0), physics=physics)
    cfg = DirectRLEnvCfg(
        decimation=1, episode_length_s=10.0, action_space=1, observation_space=1, state_space=0, sim=sim, scene=scene
    )
    with launch_simulation(cfg, {"visualizer": "none"}):
        magnets = Magnets()
        magnets.add_coil("coil", shape="loop", radius=LOOP, ampere_turns=CURRENT)
        aside = (0.5, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)
        circuit = {"resistance": RESISTANCE, "turns": 1, "inductance": INDUCTANCE, "voltage": 1.0}
        magnets.add_coil("driven", shape="loop", radius=0.01, xform=aside, **circuit)
        magnets.add_magnetometer("hall", xform=((0.0, 0.0, HALL), (0.0, 0.0, 0.0, 1.0)))
        environment = Environment(cfg)
        environment.magnets = magnets
        environment.reset()
        yield environment
        environment.close()


def test_magnets_of_prims_and_coils_are_in_all_environments(environment):
    magnets = environment.magnets
    magnets.reset()
    magnets.update()
    # single precision, and positions of environments of 2 m
    assert np.allclose(magnets.readings("hall").numpy(), [0.0, 0.0, reading(CURRENT)], rtol=1e-5, atol=1e-8)


def test_currents_of_some_environments(environment):
    magnets = environment.magnets
    magnets.reset()
    magnets.set_current("coil", torch.tensor([-500.0, 200.0]), torch.tensor([2, 0]))
    magnets.update()
    expected = [reading(200.0), reading(CURRENT), reading(-500.0)]
    assert np.allclose(magnets.readings("hall")[:, 2].numpy(), expected, rtol=1e-5)
    magnets.reset([0])
    magnets.update()
    assert np.allclose(magnets.readings("hall")[:, 2].numpy(), [expected[1], *expected[1:]], rtol=1e-5)
    magnets.set_current("coil", 0.0)
    magnets.update()
    assert np.allclose(magnets.readings("hall")[:, 2].numpy(), reading(0.0), rtol=1e-5)


def test_forces_act_in_every_substep(environment):
    magnets = environment.magnets
    environment.reset()
    magnets.reset()
    magnets.set_current("coil", torch.tensor([0.0, CURRENT, -CURRENT]))
    environment.step_once()
    speeds = wp.to_torch(NewtonManager.get_state_0().body_qd)[:, 2].numpy()
    expected = MOMENT * on_axis(CURRENT, NEEDLE)[1] * DT / MASS
    # the needle moves by 4e-6 m, which changes the force by 2e-4
    assert np.allclose(speeds, [0.0, expected, -expected], rtol=1e-3, atol=1e-6)


def test_currents_follow_from_voltages(environment):
    """Each environment has its own voltage in every substep; a reset restores the declared one."""
    magnets, steps = environment.magnets, 3
    environment.reset()
    magnets.reset()
    magnets.set_voltage("driven", torch.tensor([2.0, -1.0]), torch.tensor([0, 1]))
    for _ in range(steps):
        environment.step_once()
    voltages = np.array([2.0, -1.0, 1.0])
    expected = voltages / RESISTANCE * (1.0 - np.exp(-RESISTANCE / INDUCTANCE * steps * DT))
    currents = magnets.magnetics.coils.currents
    assert np.allclose(currents.numpy(), expected, rtol=1e-3)  # the needle and the other coil link little flux
    magnets.reset([0])
    assert currents.numpy()[0] == 0.0 and magnets.magnetics.model.warpmag.voltage.numpy().max() == 1.0
    with pytest.raises(InputError, match=r"^set_voltage: 'coil' has no resistance"):
        magnets.set_voltage("coil", 1.0)
    with pytest.raises(InputError, match=r"^set_current: 'driven' has a voltage"):
        magnets.set_current("driven", 1.0)


def test_a_second_start_of_the_physics_replaces_the_first(environment):
    magnets, first = environment.magnets, environment.magnets.magnetics
    environment.sim.reset()
    environment.reset()
    assert magnets.magnetics is not first
    test_magnets_of_prims_and_coils_are_in_all_environments(environment)
    test_forces_act_in_every_substep(environment)


def test_bad_names_and_shapes_are_refused(environment):
    magnets = environment.magnets
    with pytest.raises(InputError, match=r"^set_current: 'coils' is unknown, there are coil, driven$"):
        magnets.set_current("coils", 1.0)
    with pytest.raises(InputError, match=r"^readings: 'coil' is unknown"):
        magnets.readings("coil")
    with pytest.raises(InputError, match=r"^set_current: shape must be "):
        magnets.set_current("coil", torch.zeros(2))
    with pytest.raises(InputError, match=r"^Magnets: the physics has not started"):
        Magnets().set_current("coil", 1.0)
    with pytest.raises(InputError, match=r"^add_coil: 'hall' exists already"):
        magnets.add_coil("hall", shape="loop", radius=LOOP)
    with pytest.raises(InputError, match=r"^add_coil: radius: "):
        magnets.add_coil("other", shape="loop", radius=-1.0)


WRONG = {
    "set_current: env_ids": lambda magnets: magnets.set_current("coil", 1.0, [7]),
    "set_current: must be a number": lambda magnets: magnets.set_current("coil", "1"),
    "set_current: must be finite": lambda magnets: magnets.set_current("coil", torch.tensor([0.0, np.inf, 0.0])),
    "set_current: shape": lambda magnets: magnets.set_current("coil", torch.zeros(2)),
    r"set_current: \[1\] is unknown": lambda magnets: magnets.set_current([1], 1.0),
    "reset: env_ids": lambda magnets: magnets.reset("all"),
    "readings: None is unknown": lambda magnets: magnets.readings(None),
    "add_coil: name": lambda magnets: magnets.add_coil(3, radius=0.1, ampere_turns=1.0),
    "add_coil: body": lambda magnets: magnets.add_coil("another", body=3, radius=0.1, ampere_turns=1.0),
    "add_magnetometer: xform": lambda magnets: magnets.add_magnetometer("another", xform=(0.0, 0.0)),
}


@pytest.mark.parametrize("message", WRONG)
def test_wrong_arguments_are_one_line(message, environment):
    with pytest.raises(InputError, match=f"^{message}[^\n]*$"):
        WRONG[message](environment.magnets)
