"""Worlds that are copies of the first one: they are prepared once, with the results of worlds prepared one by one."""

import newton
import numpy as np
import pytest
import warp as wp
from small_builders import new_builder

import warpmag
from warpmag.engine.magnets import magnetics as magnetics_module
from warpmag.engine.magnets.equal_worlds import EqualWorlds, equal_worlds
from warpmag.engine.magnets.grouping import find_magnets
from warpmag.errors import InputError
from warpmag.kernels.shared.copies import put_copies, repeat_rows
from warpmag.moments.system import MomentSystem


def at(*position):
    return wp.transform(position, wp.quat_identity())


def make_world(*, saturation=1.5e6, with_coil=False):
    """A plate and a static beam of iron, a disc magnet, a kinematic ball, two balls on one body, and a coil."""
    builder = new_builder()
    plate = builder.add_body(xform=at(0.0, 0.0, 0.0))
    builder.add_shape_box(plate, hx=0.03, hy=0.03, hz=0.0015)
    warpmag.add_inducible(builder, body=plate, saturation=saturation)
    beam = builder.add_shape_box(-1, xform=at(0.0, 0.06, 0.0), hx=0.02, hy=0.004, hz=0.004)
    warpmag.add_inducible(builder, shape=beam)
    disc = builder.add_body(xform=at(0.0, 0.0, 0.012))
    builder.add_shape_cylinder(disc, radius=0.01, half_height=0.0025)
    warpmag.add_permanent(builder, body=disc, magnetization=(0.0, 0.0, 9e5))
    guided = builder.add_body(xform=at(0.05, 0.0, 0.0), is_kinematic=True)
    builder.add_shape_sphere(guided, radius=0.005)
    warpmag.add_inducible(builder, body=guided)
    pair = builder.add_body(xform=at(-0.05, 0.0, 0.0))
    for x in (-0.006, 0.006):
        builder.add_shape_sphere(pair, xform=at(x, 0.0, 0.0), radius=0.005)
    warpmag.add_inducible(builder, body=pair)
    if with_coil:
        warpmag.add_coil(builder, body=disc, radius=0.02, ampere_turns=100.0)
    return builder


def make_model(device, *worlds):
    builder = new_builder()
    for world in worlds:
        builder.add_world(world)
    return builder.finalize(device=device)


def results(model, **options):
    """Return forces, moments, evaluations, energies and fields after two steps with the plates in different places."""
    magnetics, state = warpmag.Magnetics(model, **options), model.state()
    poses = state.body_q.numpy()
    count = model.body_count // model.world_count
    for height in (-0.03, -0.002):  # at a distance few moments stand for the plates
        poses[::count, 2] = height * np.arange(1, model.world_count + 1)
        state.body_q.assign(poses)
        state.clear_forces()
        magnetics.apply(state)
    magnetics.reset(worlds=[False, True, False])
    magnetics.set_external_field(np.outer(np.arange(3), (0.0, 0.0, 1e3)))
    magnetics.apply(state)
    energies = magnetics.energy() if options["contact_model"] == "dipole" else np.zeros(0)
    probed = [magnetics.b_field([[0.0, 0.0, 0.03]], worlds=world) for world in range(3)]
    loads = [(body.label, body.world, body.moments) for body in magnetics.workload().bodies]
    numbers = state.body_f, magnetics.evaluations, magnetics.error, magnetics.external_field
    return [array.numpy() for array in numbers], energies, probed, magnetics.shape_moments(), sorted(loads)


@pytest.mark.parametrize(
    ("contact_model", "with_coil"), [("dipole", False), ("multipole", True)], ids=["few moments", "contacts, coils"]
)
def test_copies_have_the_results_of_worlds_prepared_one_by_one(contact_model, with_coil, device, monkeypatch):
    model = make_model(device, *[make_world(with_coil=with_coil)] * 3)
    of_copies = results(model, contact_model=contact_model)
    monkeypatch.setattr(magnetics_module, "equal_worlds", lambda _, magnets: EqualWorlds(magnets, 1, 0, 0))
    for copied, single in zip(of_copies, results(model, contact_model=contact_model), strict=True):
        if isinstance(copied, list) and isinstance(copied[0], np.ndarray):
            assert all(np.array_equal(a, b) for a, b in zip(copied, single, strict=True))
        else:
            assert np.array_equal(copied, single)


def test_only_worlds_that_differ_in_nothing_are_copies(device):
    equal, other = make_world(), make_world(saturation=1e6)
    for worlds, copies in (([equal] * 3, 3), ([equal, equal, other], 1), ([equal], 1)):
        model = make_model(device, *worlds)
        magnets, _ = find_magnets(model)
        worlds_of_model = equal_worlds(model, magnets)
        assert (worlds_of_model.copies, len(worlds_of_model.magnets)) == (copies, len(magnets) // copies)
        assert worlds_of_model.bodies().tolist() == [magnet.body for magnet in magnets]
        assert worlds_of_model.world_numbers().tolist() == [magnet.world for magnet in magnets]
    model = make_model(device, *[equal] * 2)
    flags = model.body_flags.numpy()
    flags[-1] |= int(newton.BodyFlags.KINEMATIC)  # moves by itself in the first world only
    model.body_flags.assign(flags)
    assert equal_worlds(model, find_magnets(model)[0]).copies == 1


def test_rows_are_copied_on_the_host_and_on_the_device(device):
    rows, step = [[0, 1, -1], [2, 3, 4]], [10, 0, 1]
    expected = [[0, 1, -1], [2, 3, 4], [10, 1, -1], [12, 3, 5]]
    assert put_copies(rows, wp.vec3i, device, 2, step).numpy().tolist() == expected
    assert repeat_rows([[0, 1], [2, 3]], 2, [10, 0]).tolist() == [[0, 1], [2, 3], [10, 1], [12, 3]]
    assert put_copies([1.5, -2.5], wp.float64, device, 2).numpy().tolist() == [1.5, -2.5] * 2
    assert put_copies([True, False], wp.bool, device, 2).numpy().tolist() == [True, False] * 2
    assert put_copies([0], wp.int32, device, 0, 1).numpy().tolist() == []


def test_copies_of_a_system_are_counted(device):
    for name, value, message in (("copies", 0, "at least 1"), ("copies", 1.5, "whole"), ("body_step", -1, "negative")):
        with pytest.raises(InputError, match=f"^{name}: must.*{message}"):
            MomentSystem(radii=[1.0], device=device, **{name: value})
    system = MomentSystem(radii=[1.0, 2.0], worlds=[0, 1], bodies=[3, 4], copies=2, body_step=10, device=device)
    assert system.worlds.tolist() == [0, 1, 2, 3] and system.bodies.numpy().tolist() == [3, 4, 13, 14]
    assert system.world_ranges == [(0, 1, 1), (1, 2, 2), (2, 3, 3), (3, 4, 4)]
