"""Iron balls in the non-uniform field of coils, maps and boxes: exact series, what must be kept, and where it fades."""

import math

import numpy as np
import pytest

from bench.reference import ball_in_field, oracle
from bench.systems import moment_system
from warpmag.declarations.coils import Coil, FieldMap
from warpmag.kernels.applied.solids import SolidMagnet
from warpmag.kernels.applied.sources import AppliedSource, SourceKind
from warpmag.kernels.near_contact import contact_table
from warpmag.moments.probe import FieldProbe
from warpmag.shapes import polyhedra

A, R = 0.02, 0.005  # m, radius of coils and of balls
LINEAR = 1e15
"""Saturation [A/m] of a ball that is linear to rounding."""
DIPOLE = np.array([[0.01, -0.02, 0.05]]), np.array([[0.2, -0.5, 0.9]])  # m, A·m²
TURN = np.array([0.2, -0.4, 0.1, 0.5]) / np.linalg.norm([0.2, -0.4, 0.1, 0.5])


def source_of(record):
    return AppliedSource(
        SourceKind[record.kind.upper()], record.parameters, record.table, world=0, body=7, movable=True
    )


def dipole_map(cells=24, side=0.05):
    """A map of a dipole's field above the origin."""
    axis = side * (np.arange(cells + 1) / cells - 0.5)
    places = np.stack(np.meshgrid(axis, axis, axis - 0.01, indexing="ij"), axis=-1)
    values = oracle.h_field(*DIPOLE, places.reshape(-1, 3)).reshape(places.shape)
    return source_of(FieldMap(tuple(places[0, 0, 0]), (side / cells,) * 3, values).record())


def box(half, device, **settings):
    """What a ball and a box of 1e4 A/m along z feel of each other: forces, and the box's torque, shape [9], float64."""
    body = polyhedra.box_moments(half)
    n = len(body.volumes)
    solid = SolidMagnet(1, n, body.volumes[0], 0, body.reach, polyhedra.box(half), body, True)
    system = moment_system(
        radii=np.append(R, body.depths), permanent=np.arange(n + 1) > 0, bodies=np.append(0, np.ones(n, int)),
        saturation=LINEAR, solids=[solid], dtype="float64", rtol=1e-10, device=device, **settings,
    )  # fmt: skip

    def wrenches(place):
        system.positions.assign(np.concatenate([[place], body.positions]))
        moments = np.zeros((n + 1, 3))
        moments[1:, 2] = 1e4 * body.volumes
        system.moments.assign(moments)
        system.solve()
        system.apply_forces()
        forces, torques = system.forces.numpy(), system.torques.numpy()
        turn = torques[1:].sum(axis=0) + np.cross(body.positions, forces[1:]).sum(axis=0)
        return np.concatenate([forces[0], forces[1:].sum(axis=0), turn])

    return wrenches


def ball_in(source, device, *, susceptibility=math.inf, size=R, dtype="float64", model="multipole", **where):
    """What a ball and a source feel of each other: forces, and the source's torque about its frame, shape [9]."""
    system = moment_system(
        radii=[size], saturation=LINEAR, susceptibility=susceptibility, contact_model=model, sources=[source],
        dtype=dtype, rtol=1e-10 if dtype == "float64" else 1e-5, device=device,
    )  # fmt: skip
    strength = where.get("strength", 100.0 if source.kind != SourceKind.FIELD_MAP else 1.0)
    system.sources.strengths.assign([[strength, 0.0, 0.0]])
    system.sources.frames.assign([where.get("frame", (0, 0, 0, 0, 0, 0, 1))])

    def wrenches(place):
        system.positions.assign([place])
        system.solve()
        system.apply_forces()
        return np.concatenate([system.forces.numpy()[0], system.source_interaction.wrenches.numpy()[0, :6]])

    return wrenches


SOURCES = {
    "loop": source_of(Coil(radius=A).record()),
    "solenoid": source_of(Coil("solenoid", radius=A, length=0.03).record()),
    "map": dipole_map(),
}


def field_of(source, device):
    """The field that a map is of, or that of a coil, which ``test_applied.py`` compares with closed forms."""
    if source.kind == SourceKind.FIELD_MAP:
        return lambda x: oracle.h_field(*DIPOLE, x)
    system = moment_system(radii=[1e-9], permanent=[True], sources=[source], dtype="float64", device=device)
    system.sources.strengths.assign([[100.0, 0.0, 0.0]])
    system.positions.assign([[1e3, 0.0, 0.0]])

    def field(x):
        probe = FieldProbe(system, len(x))
        probe.points.assign(x)
        probe.measure()
        return probe.h.numpy()

    return field


@pytest.mark.parametrize("name", SOURCES)
@pytest.mark.parametrize(("size", "place"), [(R, (0.011, 0.0, 0.004)), (0.008, (0.005, 0.003, -0.012))])
def test_force_in_a_nonuniform_field(name, size, place, device):
    """A radius or more away from wires within 0.5 % of the exact series; dipoles lack up to 26 %."""
    source, field = SOURCES[name], field_of(SOURCES[name], device)
    for susceptibility in (math.inf, 1.0):
        actual = ball_in(source, device, size=size, susceptibility=susceptibility)(place)[:3]
        exact = ball_in_field.force_in_field(field, np.array(place), size, susceptibility, order=12)
        # degrees above 4, and for maps the third power of the spacing
        assert np.linalg.norm(actual - exact) < 5e-3 * np.linalg.norm(exact)
    dipole = ball_in(source, device, size=size, model="dipole", susceptibility=1.0)(place)[:3]
    assert np.linalg.norm(dipole - exact) > 0.01 * np.linalg.norm(exact)


@pytest.mark.parametrize(("dtype", "tolerance"), [("float64", 1e-12), ("float32", 2e-6)])
def test_the_coil_feels_the_opposite(dtype, tolerance, device):
    """Momentum and angular momentum about the coil, which is turned."""
    frame = (0.003, -0.002, 0.001, *TURN)
    place = np.array([0.008, 0.004, 0.009])
    result = ball_in(SOURCES["loop"], device, dtype=dtype, frame=frame)(place)
    np.testing.assert_allclose(result[3:6], -result[:3], atol=tolerance * np.abs(result[:3]).max())
    arm = place - frame[:3]
    np.testing.assert_allclose(result[6:], -np.cross(arm, result[:3]), atol=tolerance * np.abs(result[:3]).max() * 0.02)


@pytest.mark.parametrize("which", ["loop", "box"])
@pytest.mark.parametrize("distance", [2.0, 9.0])
def test_what_is_added_has_an_energy(which, distance, device):
    """Near a source, and where it fades: the force has no curl, and the source feels the opposite."""
    size = R if which == "box" else 0.002

    def forces(model):
        if which == "box":
            return box((0.01, 0.006, 0.008), device, contact_model=model)
        return ball_in(SOURCES["loop"], device, size=size, model=model)

    middle = np.array([0.006, 0.004, (0.008 if which == "box" else 0.0) + distance * size])
    step, added = 1e-4 * size, [forces(model) for model in ("multipole", "dipole")]
    slopes = np.zeros((3, 3))
    for axis, unit in enumerate(np.eye(3)):
        ends = [added[0](middle + s * step * unit) - added[1](middle + s * step * unit) for s in (1.0, -1.0)]
        slopes[:, axis] = (ends[0] - ends[1])[:3] / (2.0 * step)
        np.testing.assert_allclose(ends[0][3:6], -ends[0][:3], atol=1e-9 * np.abs(added[0](middle)).max())
    # (step/size)² of the differences; what higher degrees leave in the tensors
    np.testing.assert_allclose(slopes, slopes.T, atol=1e-4 * np.abs(slopes).max())


def test_far_away_nothing_is_added(device):
    z = 1.00001 * contact_table.MAGNET_REACH[1] * 0.002
    result, dipole = (
        ball_in(SOURCES["loop"], device, size=0.002, model=model)((0.0, 0.003, z)) for model in ("multipole", "dipole")
    )
    np.testing.assert_array_equal(result, dipole)


@pytest.mark.parametrize("touched", [(0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.3, 1.0, -0.2)])
@pytest.mark.parametrize("half", [0.02, 0.05])
def test_faces_of_a_box(half, touched, device):
    """Degrees 2 to 4 are all there is at a face, of a box eight or twenty times as wide as the ball's radius."""
    place = half * np.array(touched) + 1.0001 * R * np.trunc(touched)
    exact = ball_in_field.force_in_field(
        lambda x: ball_in_field.box_field(x, np.full(3, half), 1e4), place, R, order=16
    )
    actual = box((half,) * 3, device, contact_model="multipole")(place)[:3]
    np.testing.assert_allclose(actual, exact, atol=1e-3 * np.linalg.norm(exact))
