"""What comes to rest stays where it is, and what was put into each other comes apart slowly and keeps its momentum.

Thirty iterations alone leave what sticks to slip a little in each substep: these heaps then creep.
"""

import newton
import numpy as np
import pytest
import warp as wp

import warpmag
from warpmag.kernels.contacts.solve import RECOVERY_SPEED

R = 0.005  # m


def material(mu):
    return newton.ModelBuilder.ShapeConfig(density=7874.0, mu=mu, mu_torsional=1e-3 * mu, mu_rolling=1e-3 * mu)


def new_builder(mu, ground=True):
    builder = newton.ModelBuilder()
    warpmag.register_attributes(builder)
    if ground:
        builder.add_ground_plane(cfg=material(mu))
    else:
        builder.gravity = wp.vec3(0.0, 0.0, 0.0)
    return builder


def step(simulation, seconds):
    for _ in range(round(seconds / simulation.step_size)):
        simulation.step()
    return simulation.state.body_q.numpy()[:, :3].astype(float)


def add_far_magnet(builder):
    """A simulation needs one."""
    far = builder.add_shape_sphere(-1, xform=wp.transform((5.0, 0.0, 0.0)), radius=R)
    warpmag.add_permanent(builder, shape=far, magnetization=(0.0, 0.0, 1.0))


def add_walls(builder, width):
    for normal, far in (((1.0, 0, 0), 0.0), ((-1.0, 0, 0), -width), ((0, 1.0, 0), 0.0), ((0, -1.0, 0), -width)):
        builder.add_shape_plane(plane=(*normal, -far), width=0.0, length=0.0, cfg=material(0.5))


@pytest.mark.parametrize(
    "side, settling, seconds", [(4, 0.6, 0.4), pytest.param(10, 3.0, 10.0, marks=pytest.mark.long)]
)
def test_a_pile_of_balls_does_not_creep(side, settling, seconds, device):
    """Balls that fell into a box with friction. Now and then one of many rolls on, so that half of them are asked."""
    builder = new_builder(0.5)
    add_walls(builder, 2.06 * R * side + 0.1 * R)
    random = np.random.default_rng(0)
    for place in np.ndindex(side, side, side):
        at = 2.05 * R * np.array(place[::-1]) + R + random.uniform(0.0, 0.1 * R, 3)
        body = builder.add_body(xform=wp.transform(wp.vec3(*at)))
        builder.add_shape_sphere(body, radius=R, cfg=material(0.5))
    add_far_magnet(builder)
    simulation = warpmag.Simulation(builder, device=device)
    before = step(simulation, settling)
    crept = np.linalg.norm(step(simulation, seconds) - before, axis=1)
    assert np.median(crept) < 0.1 * R * seconds / 10.0


def test_a_heap_of_boxes_does_not_creep(device):
    """Boxes that lie across each other, and touch at several points that are not told apart."""
    builder, random = new_builder(0.5), np.random.default_rng(3)
    add_walls(builder, 6.0 * R)
    for place in np.ndindex(4, 2, 2):
        turn = random.normal(size=4)
        at = 2.6 * R * np.array(place[::-1]) + 1.7 * R
        body = builder.add_body(xform=wp.transform(wp.vec3(*at), wp.quat(*(turn / np.linalg.norm(turn)))))
        builder.add_shape_box(body, hx=R, hy=0.7 * R, hz=0.8 * R, cfg=material(0.5))
    add_far_magnet(builder)
    simulation = warpmag.Simulation(builder, device=device)
    before = step(simulation, 1.0)
    crept = np.linalg.norm(step(simulation, 0.4) - before, axis=1)
    assert np.median(crept) < 0.1 * R * 0.4 / 10.0


@pytest.mark.parametrize("slope, moves", [(0.45, False), (0.55, True)])
def test_a_box_on_a_slope(slope, moves, device):
    """With friction 0.5 it stays on one and slides down the other, as far as g (sin - 0.5 cos) t²/2."""
    builder = new_builder(0.5)
    lean, seconds = np.arctan(slope), 0.2
    builder.gravity = wp.vec3(9.81 * np.sin(lean), 0.0, -9.81 * np.cos(lean))
    body = builder.add_body(xform=wp.transform((0.0, 0.0, R)))
    builder.add_shape_box(body, hx=R, hy=R, hz=R, cfg=material(0.5))
    add_far_magnet(builder)
    simulation = warpmag.Simulation(builder, device=device)
    x = step(simulation, seconds)[0, 0]
    far = 0.5 * 9.81 * (np.sin(lean) - 0.5 * np.cos(lean)) * seconds**2 if moves else 0.0
    # of first order: a substep's share of the speed at the end; and what friction gives way before it holds
    assert x == pytest.approx(far, rel=2.0 * 5e-4 / seconds, abs=1e-3 * R)


def test_a_box_that_slides_stops(device):
    """After v²/2μg, and does not spring back by what it remembers of its slip."""
    builder = new_builder(0.5)
    body = builder.add_body(xform=wp.transform((0.0, 0.0, R)))
    builder.body_qd[body] = wp.spatial_vector(0.3, 0.0, 0.0, 0.0, 0.0, 0.0)
    builder.add_shape_box(body, hx=R, hy=R, hz=R, cfg=material(0.5))
    add_far_magnet(builder)
    simulation = warpmag.Simulation(builder, device=device)
    slid = []
    for _ in range(100):
        simulation.step()
        slid.append(simulation.state.body_q.numpy()[0, 0])
    far = 0.3**2 / (2.0 * 0.5 * 9.81)
    # a substep at the first speed; and a substep's friction, μg dt², a few times
    assert slid[-1] == pytest.approx(far, abs=0.3 * 5e-4)
    assert max(slid) - slid[-1] < 5.0 * 0.5 * 9.81 * 5e-4**2


def test_a_shaft_full_of_balls_comes_to_rest(device):
    """Thirty layers, more than an iteration a contact can tell of: what is not solved in a substep must not add up."""
    builder = new_builder(0.5)
    add_walls(builder, 6.003 * R)
    for place in np.ndindex(30, 3, 3):
        body = builder.add_body(xform=wp.transform(wp.vec3(*(2.0005 * R * (np.array(place[::-1]) + 0.5)))))
        builder.add_shape_sphere(body, radius=R, cfg=material(0.5))
    add_far_magnet(builder)
    simulation = warpmag.Simulation(builder, device=device)
    step(simulation, 0.3)
    speeds = np.linalg.norm(simulation.state.body_qd.numpy()[:, :3], axis=1)
    assert np.sqrt(np.mean(speeds**2)) < 5e-3  # m/s: what gravity gives in a substep


def test_a_chain_of_magnets_lies_still(device):
    """Five permanent balls that hold on to each other press each other far harder than their weight does."""
    builder = new_builder(0.5)
    for k in range(5):
        body = builder.add_body(xform=wp.transform((2.0 * R * k, 0.0, R)))
        builder.add_shape_sphere(body, radius=R, cfg=material(0.5))
        warpmag.add_permanent(builder, body=body, magnetization=(8e5, 0.0, 1e5))
    simulation = warpmag.Simulation(builder, device=device)
    before = step(simulation, 0.2)
    assert np.abs(step(simulation, 0.5) - before).max() < 1e-3 * R


@pytest.mark.parametrize("hinged", [False, True])
@pytest.mark.parametrize("mu", [0.0, 0.5])
def test_bodies_that_were_put_into_each_other_come_apart_slowly(mu, hinged, device):
    """Two boxes, one of them heavier, that share half of their space: no faster than they are pushed out.

    A hinge of another body far away has joints and contacts solved together.
    """
    builder = new_builder(mu, ground=False)
    for x, half in ((0.0, R), (1.2 * R, 1.3 * R)):
        body = builder.add_body(xform=wp.transform((x, 0.1 * R, 0.2 * R)))
        builder.add_shape_box(body, hx=half, hy=half, hz=half, cfg=material(mu))
    warpmag.add_inducible(builder, body=0)
    if hinged:
        place = wp.transform((100.0 * R, 0.0, 0.0))
        link = builder.add_link(xform=place)
        builder.add_shape_sphere(link, radius=R, cfg=material(mu))
        builder.add_articulation([builder.add_joint_revolute(-1, link, parent_xform=place)])
    simulation = warpmag.Simulation(builder, device=device)
    masses = simulation.model.body_mass.numpy()[:2].astype(float)
    simulation.step()
    simulation.step()
    fastest = np.abs(simulation.state.body_qd.numpy()[:, :3]).max()
    step(simulation, 0.03)
    qd = simulation.state.body_qd.numpy()[:2, :3].astype(float)
    apart = simulation.state.body_q.numpy()[1, 0] - simulation.state.body_q.numpy()[0, 0]
    assert apart > 2.3 * R and fastest < 1.01 * RECOVERY_SPEED
    assert np.abs(masses @ qd).max() < 1e-5 * np.abs(masses[:, None] * qd).max()
