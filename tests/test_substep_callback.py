"""Forces and controllers of the user in the substeps of a simulation."""

import numpy as np
import pytest
import warp as wp
from small_builders import add_ball, new_builder

import warpmag


@wp.kernel(enable_backward=False)
def push(force: wp.vec3, body_f: wp.array[wp.spatial_vector]):
    body = wp.tid()
    body_f[body] = body_f[body] + wp.spatial_vector(force, wp.vec3(0.0))


@pytest.mark.parametrize("graphs", [False, True])
def test_a_force_of_the_user_moves_a_body(graphs, device):
    """A lone magnet feels no other force: v = F t / m to single precision."""
    builder = new_builder(gravity=(0.0, 0.0, 0.0))
    add_ball(builder, (0.0, 0.0, 0.0), (0.0, 0.0, 1e6))
    simulation = warpmag.Simulation(
        builder, device=device, graphs=graphs,
        on_substep=lambda state, dt: wp.launch(push, 1, [wp.vec3(1e-3, 0.0, 0.0), state.body_f], device=device),
    )  # fmt: skip
    for _ in range(10):
        simulation.step()
    speed = 1e-3 * simulation.time / simulation.model.body_mass.numpy()[0]
    assert simulation.state.body_qd.numpy()[0, 0] == pytest.approx(speed, rel=1e-5)


def test_python_of_the_user_sees_magnetic_forces_in_every_substep(device):
    """It takes them away, so that the magnets stay. Without graphs by default, Python runs in each substep."""
    forces, times = [], []

    def hold(state, dt):
        forces.append(state.body_f.numpy()[:, 2].copy())  # a view on a CPU
        times.append(dt)
        state.body_f.zero_()

    builder = new_builder(gravity=(0.0, 0.0, 0.0))
    for z in (0.0, 0.02):
        add_ball(builder, (0.0, 0.0, z), (0.0, 0.0, 1e6))
    simulation = warpmag.Simulation(builder, device=device, on_substep=hold)
    for _ in range(3):
        simulation.step()
    assert simulation.statistics.repeated == 0 and not np.abs(simulation.state.body_qd.numpy()).any()
    assert sum(times) == pytest.approx(simulation.time) and len(times) == simulation.statistics.substeps
    assert (np.array(forces)[:, 0] > 0.1).all()  # the upper magnet attracts the lower one, 0.6 N by the dipoles' law


def test_what_is_no_function_is_named():
    builder = new_builder()
    add_ball(builder, (0.0, 0.0, 0.0))
    with pytest.raises(warpmag.InputError, match="on_substep: must be a function, got 'push'"):
        warpmag.Simulation(builder, on_substep="push", device="cpu")
