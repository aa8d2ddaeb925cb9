"""Permanent magnets that respond to the field by their recoil permeability: M = M_r + (μ − 1) H, H the field inside."""

import math

import newton
import numpy as np
import pytest
import warp as wp
from pxr import Gf, Sdf

import warpmag
from bench.systems import moment_system
from tests.test_materials import PERMANENT, stage_with
from warpmag.declarations.magnets import LINEAR_CURVE
from warpmag.engine.magnets.attributes import marked_shapes
from warpmag.errors import InputError
from warpmag.usd import author_magnet, read_magnets

MU0 = 4e-7 * math.pi
REMANENCE = np.array([2e5, -3e5, 9e5])
TURN = wp.quat_from_axis_angle(wp.normalize(wp.vec3(1.0, 2.0, -1.0)), 0.7)
STRAIGHT, LEAN = wp.quat_identity(), wp.quat_from_axis_angle(wp.normalize(wp.vec3(1.0, 0.5, 0.2)), 0.2)
TURNED = np.array([wp.quat_rotate(TURN, wp.vec3(*axis)) for axis in np.eye(3)]).T  # of the body, in the world


def solved(device, half, permeability, field=(0.0, 0.0, 0.0), **settings):
    """A magnet, a ball of radius ``half`` or a box, turned, in a field; its magnetics and its state."""
    builder = newton.ModelBuilder()
    warpmag.register_attributes(builder)
    body = builder.add_body(xform=wp.transform((0.1, 0.0, 0.2), TURN))
    if isinstance(half, float):
        builder.add_shape_sphere(body, radius=half)
    else:
        builder.add_shape_box(body, hx=half[0], hy=half[1], hz=half[2])
    warpmag.add_permanent(builder, body=body, magnetization=tuple(REMANENCE), recoil_permeability=permeability)
    model = builder.finalize(device=device)
    magnetics = warpmag.Magnetics(model, external_field=field, **settings)
    state = model.state()
    magnetics.apply(state)
    return magnetics, state


def mean(magnetics):
    return magnetics.shape_moments()[0] / magnetics.shape_volumes[0]


@pytest.mark.parametrize("permeability", [1.001, 1.05, 1.1, 4.0])
def test_a_sphere_by_closed_form(permeability, device):
    """In a field H0 it has M = (M_r + χ H0)/(1 + χ/3), and turns with μ0 m × H0."""
    chi, field = permeability - 1.0, np.array([1e5, 2e5, -5e4])
    magnetics, state = solved(device, 0.01, permeability, tuple(field))
    expected = (TURNED @ REMANENCE + chi * field) / (1.0 + chi / 3.0)
    # rounding of the bias M_r/χ, which χ makes less of again
    np.testing.assert_allclose(mean(magnetics), expected, atol=5e-7 * np.linalg.norm(expected))
    torque = MU0 * np.cross(magnetics.shape_moments()[0], field)
    np.testing.assert_allclose(state.body_f.numpy()[0, 3:], torque, atol=1e-5 * np.linalg.norm(torque))
    np.testing.assert_allclose(magnetics.b_field([[0.1, 0.0, 0.2]])[0], MU0 * (field + 2.0 / 3.0 * expected), rtol=1e-5)


def prism_factor(a, b, c):
    """Magnetometric demagnetizing factor along c of a prism, half sizes a, b, c (Aharoni, J. Appl. Phys. 83, 1998)."""
    r, ab, bc, ac = (math.sqrt(x) for x in (a * a + b * b + c * c, a * a + b * b, b * b + c * c, a * a + c * c))
    value = (b * b - c * c) / (2 * b * c) * math.log((r - a) / (r + a))
    value += (a * a - c * c) / (2 * a * c) * math.log((r - b) / (r + b))
    value += b / (2 * c) * math.log((ab + a) / (ab - a)) + a / (2 * c) * math.log((ab + b) / (ab - b))
    value += c / (2 * a) * math.log((bc - b) / (bc + b)) + c / (2 * b) * math.log((ac - a) / (ac + a))
    value += 2 * math.atan(a * b / (c * r)) + (a**3 + b**3 - 2 * c**3) / (3 * a * b * c)
    value += (a * a + b * b - 2 * c * c) / (3 * a * b * c) * r + c / (a * b) * (ac + bc)
    value -= (ab**3 + bc**3 + ac**3) / (3 * a * b * c)
    return value / math.pi


@pytest.mark.parametrize("half", [(0.01, 0.01, 0.01), (0.02, 0.02, 0.004), (0.004, 0.006, 0.02)])
def test_a_box_against_its_demagnetizing_factors(half, device):
    """To first order in χ its mean M is M_r/(1 + χ N); what is left is χ² times how uneven the field is, N² at most."""
    factors = np.array([prism_factor(*np.roll(half, -k - 1)) for k in range(3)])
    assert factors.sum() == pytest.approx(1.0, abs=1e-12)
    magnetics, _ = solved(device, half, 1.05, rtol=1e-5)
    expected = TURNED @ (REMANENCE / (1.0 + 0.05 * factors))
    # cells resolve the factors to 1 %
    assert np.linalg.norm(mean(magnetics) - expected) < (0.05**2 + 0.05 * 0.01) * np.linalg.norm(REMANENCE)


def test_energy_and_force_go_together(device):
    """Responding and fixed magnets and iron: minus the gradient of the energy is the force, and the forces balance."""
    n, rng = 5, np.random.default_rng(6)
    x = np.array([[0, 0, 0], [0.012, 0, 0], [0, 0.013, 0.002], [0.011, 0.012, 0], [0.004, 0.006, 0.013]], float)
    chi, remanence = np.array([0.05, 0.1, 50.0, 3.0, 1.0]), 1e6 * rng.normal(size=(n, 3))
    permanent = np.arange(n) == 4
    system = moment_system(
        radii=np.full(n, 0.005), permanent=permanent, saturation=1.7e6, susceptibility=chi,
        curve=[LINEAR_CURVE, LINEAR_CURVE, "tanh", "langevin", "tanh"], external_field=(1e5, 0.0, 2e5), rtol=1e-12,
        dtype="float64", device=device,
    )  # fmt: skip
    volume = 4.0 / 3.0 * math.pi * 0.005**3
    system.bias.assign(np.where(np.arange(n)[:, None] < 2, remanence / chi[:, None], 0.0))
    system.moments.assign(np.where(permanent[:, None], volume * remanence, 0.0))

    def energy(places):
        system.positions.assign(places)
        system.solve()
        return system.energy()[0]

    step = 1e-6
    gradient = [(energy(x + d) - energy(x - d)) / (2.0 * step) for d in step * np.eye(3 * n).reshape(-1, n, 3)]
    energy(x)
    system.apply_forces()
    forces = system.forces.numpy()
    # differences over 2e-6 m of balls 0.01 m apart
    assert np.linalg.norm(forces + np.reshape(gradient, (n, 3))) < 1e-6 * np.linalg.norm(forces)
    np.testing.assert_allclose(forces.sum(0), 0.0, atol=1e-12 * np.linalg.norm(forces))
    magnetizations, fields = system.magnetizations().numpy()[:2], (system.h.numpy() - system.bias.numpy())[:2]
    inside = fields - magnetizations / 3.0
    np.testing.assert_allclose(magnetizations, remanence[:2] + chi[:2, None] * inside, rtol=1e-10)
    zeeman = system.apply_forces("zeeman")
    assert zeeman is None and np.isfinite(system.forces.numpy()).all()


def test_iron_beside_a_magnet_that_responds(device):
    """Weak iron far from it is solved as well as beside a magnet that does not: the error is not of the remanence."""

    def iron(permeability):
        builder = newton.ModelBuilder()
        warpmag.register_attributes(builder)
        for k, radius in enumerate((0.01, 0.005)):
            body = builder.add_body(xform=wp.transform((0.06 * k, 0.0, 0.0), wp.quat_identity()))
            builder.add_shape_sphere(body, radius=radius)
        warpmag.add_permanent(builder, body=0, magnetization=(0.0, 0.0, 1e6), recoil_permeability=permeability)
        warpmag.add_inducible(builder, body=1)
        model = builder.finalize(device=device)
        magnetics = warpmag.Magnetics(model)
        magnetics.apply(model.state())
        return magnetics.system.magnetizations().numpy(), magnetics.system.converged.numpy().all()

    (fixed, sure), (responding, result) = iron(1.0), iron(1.05)
    assert sure and result
    # inducible moments come first: with recoil the magnet is one of them, the stronger one
    weak = responding[np.linalg.norm(responding, axis=1).argmin()]
    assert weak[2] == pytest.approx(fixed[0, 2] / (1.0 + 0.05 / 3.0), rel=1e-3)


def test_without_recoil_nothing_is_another(device):
    fixed, _ = solved(device, 0.01, 1.0, (1e5, 0.0, 0.0))
    assert fixed.system.bias is None
    assert fixed.system.evaluations.numpy().tolist() == [0]


def test_a_switched_magnet_responds_to_what_it_is_now(device):
    magnetics, state = solved(device, 0.01, 1.05)
    magnetics.set_magnetization((0.0, 4e5, 0.0), body=0)
    magnetics.apply(state)
    expected = TURNED @ [0.0, 4e5, 0.0] / (1.0 + 0.05 / 3.0)
    np.testing.assert_allclose(mean(magnetics), expected, atol=1e-6 * 4e5)


@pytest.mark.parametrize("value", [0.9, 0.0, 1.0001, 11.0, math.nan, math.inf, "1", None, True])
def test_bad_permeabilities_are_refused(value, device):
    with pytest.raises(InputError, match="recoil permeability: must be"):
        solved(device, 0.01, value)


def test_explicit_dynamics_know_no_recoil(device):
    with pytest.raises(InputError, match="dynamics: 'llg' lacks recoil permeability"):
        solved(device, 0.01, 1.05, dynamics="llg")


FLOAT = Sdf.ValueTypeNames.Float
ALONG = {"magnetization": (Sdf.ValueTypeNames.Vector3f, Gf.Vec3f(0.0, 0.0, 1e6))}


def test_on_a_stage():
    stage = stage_with("", **PERMANENT, **ALONG, recoilPermeability=(FLOAT, 1.05))
    magnet = read_magnets(stage).magnets["/Ball"]
    assert magnet.recoil_permeability == 1.05 and magnet.recoils
    author_magnet(stage.GetPrimAtPath("/Ball"), magnet)
    assert read_magnets(stage).magnets["/Ball"] == magnet
    for value in (0.5, math.inf):
        with pytest.raises(InputError, match=r"^/Ball: .*recoil ?[pP]ermeability: must be"):
            read_magnets(stage_with("", **PERMANENT, **ALONG, recoilPermeability=(FLOAT, value)))


def test_models_keep_it(device):
    magnetics, _ = solved(device, 0.01, 1.05)
    (magnet,) = marked_shapes(magnetics._model).values()
    assert magnet.recoil_permeability == pytest.approx(1.05, rel=1e-7)


def test_a_changed_permeability_is_refused(device):
    magnetics, _ = solved(device, 0.01, 1.05)
    magnetics._model.warpmag.recoil_permeability.assign([1.1])
    with pytest.raises(InputError, match="recoil_permeability was changed"):
        magnetics.notify_model_changed()


def pair(device, permeability, place, turn=STRAIGHT, iron=None):
    """Magnetics and state of two cubes of 10 mm, the second at a place, or an iron ball there."""
    builder = newton.ModelBuilder()
    warpmag.register_attributes(builder)
    for where, rotation in (((0.0, 0.0, 0.0), STRAIGHT), (place, turn)):
        body = builder.add_body(xform=wp.transform(where, rotation))
        if iron is not None and body:
            builder.add_shape_sphere(body, radius=iron)
            warpmag.add_inducible(builder, body=body)
            continue
        builder.add_shape_box(body, hx=0.005, hy=0.005, hz=0.005)
        settings = {"recoil_permeability": permeability, "moment_spacing": 0.002}
        warpmag.add_permanent(builder, body=body, magnetization=(0.0, 0.0, 1e6), **settings)
    model = builder.finalize(device=device)
    magnetics, state = warpmag.Magnetics(model, rtol=1e-5), model.state()
    magnetics.apply(state)
    return magnetics, state


def pushes(*arguments, **settings):
    """Forces and torques of such a pair, shape [2, 6]."""
    return pair(*arguments, **settings)[1].body_f.numpy().astype(float)


@pytest.mark.filterwarnings("ignore::warpmag.ConvergenceWarning")  # rounding of the bias M_r/χ exceeds this rtol
@pytest.mark.parametrize("place", [(0.0, 0.0, 0.01), (0.003, 0.0, 0.0101), (0.0104, 0.0, 0.004)])
def test_magnets_that_hardly_yield_pull_as_those_that_do_not(place, device):
    """0.5 %: μ − 1 of 1e-3 takes 7e-4 of the force; moments alone leave 2 % of it where faces touch."""
    fixed, yielding = (pushes(device, permeability, place)[1, :3] for permeability in (1.0, 1.001))
    assert np.linalg.norm(yielding - fixed) < 5e-3 * np.linalg.norm(fixed)


@pytest.mark.parametrize("place", [(0.0, 0.0, 0.008), (0.006, 0.006, 0.001)])
def test_iron_at_a_magnet_that_hardly_yields(place, device):
    """At a face and an edge, as at a magnet that does not: 1 %, since iron makes the magnet yield more."""
    fixed, yielding = (pushes(device, permeability, place, iron=0.003)[1, :3] for permeability in (1.0, 1.001))
    assert np.linalg.norm(yielding - fixed) < 1e-2 * np.linalg.norm(fixed)


@pytest.mark.parametrize("iron", [None, 0.003])
def test_magnets_that_yield_keep_momentum(iron, device):
    """Of forces on two bodies nothing is left, nor of their torques about the origin: rounding of float32."""
    place = np.array([0.002, 0.001, 0.0085 if iron else 0.0115])
    first, second = pushes(device, 1.3, place, LEAN, iron=iron)
    size = np.linalg.norm(second[:3])
    assert size > 0.1
    assert np.linalg.norm(first[:3] + second[:3]) < 1e-4 * size
    turning = first[3:] + second[3:] + np.cross(place, second[:3])
    assert np.linalg.norm(turning) < 1e-4 * 0.01 * size


def test_force_of_magnets_that_yield_is_the_slope_of_their_energy(device):
    """1 % half a millimetre apart, where float32 leaves 3e-3 of the slope; with one field counted twice it is 18 %."""
    step = 5e-5
    below, above = (pair(device, 1.05, (0.0, 0.0, 0.0105 + sign * step))[0].energy()[0] for sign in (-1, 1))
    force = pushes(device, 1.05, (0.0, 0.0, 0.0105))[1, 2]
    assert (below - above) / (2.0 * step) == pytest.approx(force, rel=1e-2)
