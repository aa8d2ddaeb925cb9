"""Few moments of permanent boxes and cylinders at a distance, and the distances at which they replace closed forms."""

import newton
import numpy as np
import pytest
import warp as wp
from permanent_bodies import (
    ALONG,
    ASKEW,
    BALL,
    CUBE,
    DISC,
    ORIGIN,
    SIDE,
    UPRIGHT,
    add,
    gradient_of,
    magnets,
    model_of,
    reference,
)

import warpmag
from bench.reference import oracle

SWITCHES = {
    "ball over a face": ((*CUBE,), BALL, (0.001, 0.002, 1.0), SIDE / 2),
    "ball off a corner": ((*CUBE,), BALL, (1.0, 1.0, 1.0), SIDE / 2),
    "ball off a rim": ((*DISC, *ORIGIN, ASKEW), ("ball", (0.001,)), (1.0, 0.0, 0.5), SIDE / 2),
    "ball over a disc": (("cylinder", (0.01, 0.0015), *ORIGIN, ASKEW), ("ball", (0.001,)), (0.0, 0.0, 1.0), 0.0025),
    "cubes": ((*CUBE,), CUBE, (0.0, 0.0, 1.0), SIDE),
    "cubes off their edges": ((*CUBE,), CUBE, (1.0, 1.0, 0.0), SIDE),
    "plates": (("box", (0.01, 0.01, 0.001)), ("box", (0.01, 0.01, 0.001)), (0.0, 0.3, 1.0), 0.002),
    "discs": ((*DISC,), DISC, (0.5, 0.0, 1.0), SIDE / 2),
}


@pytest.mark.parametrize(("reach", "jump"), [(1, 1e-3), (2, 6e-3)], ids=["closed form", "moments"])
@pytest.mark.parametrize("name", SWITCHES)
def test_fewer_moments_take_over_without_a_jump(name, reach, jump, device):
    """The force jumps by less than 1e-3 where moments replace the closed form, by 3e-3 of each body where few do.

    ``reach`` is the column of the table of sizes.
    """
    body, (kind, size), way, start = SWITCHES[name]
    way = np.array(way) / np.abs(way).max()

    def forces(distance):
        magnetics, state = model_of(device, body, (kind, size, tuple(distance * way), UPRIGHT, ASKEW))
        result = []
        for _ in range(2):
            state.clear_forces()
            magnetics.apply(state)
            result.append(state.body_f.numpy()[1, :3].astype(float))
            sizes = magnetics.system.sources.solid_arrays.size
            reachless = sizes.numpy()
            reachless[:, reach] = np.nan  # no target is nearer than NaN
            sizes.assign(reachless)
        return result

    inside, outside = start, 10.0 * SIDE
    for _ in range(9):
        middle = 0.5 * (inside + outside)
        near, far = forces(middle)
        inside, outside = (middle, outside) if (near != far).any() else (inside, middle)
    near, far = forces(inside)
    assert (near != far).any()
    np.testing.assert_allclose(far, near, atol=jump * np.linalg.norm(near))


@pytest.mark.parametrize("part", [CUBE, DISC, ("box", (0.012, 0.008, 0.001)), ("cylinder", (0.003, 0.02))])
def test_few_moments_act_far_away(part, device):
    """Force and torque of at most 8 moments on a permanent ball, from the far reach on: within 5e-3 and 3e-3."""
    rng, moment = np.random.default_rng(1), 4.0 / 3.0 * np.pi * BALL[1][0] ** 3 * np.array(ALONG)
    for distance in max(part[1]) * np.array([6.8, 9.0, 20.0]):
        way = rng.normal(size=3)
        place = distance * way / np.linalg.norm(way)
        magnetics, wrenches = magnets(device, (*part, (0.0, 0.0, 0.0), UPRIGHT, ASKEW), (*BALL, tuple(place)))
        assert len(magnetics.magnets[0].lattice.volumes) <= 8
        magnet = reference(*part, magnetization=ASKEW)
        force = oracle.MU0 * gradient_of(magnet, place, step=1e-3 * distance).T @ moment
        torque = oracle.MU0 * np.cross(moment, magnet.getH(place))
        np.testing.assert_allclose(wrenches[1, :3], force, atol=5e-3 * np.linalg.norm(force))
        np.testing.assert_allclose(wrenches[1, 3:], torque, atol=3e-3 * np.linalg.norm(torque))
        np.testing.assert_allclose(wrenches[0, :3], -wrenches[1, :3], atol=1e-5 * np.linalg.norm(force))


def test_coils_and_recoil_keep_all_moments(device):
    """The field of a coil varies over a magnet beside it, and a magnet's field over one with recoil permeability."""

    def moments(*, coil=False, recoil_permeability=1.0):
        builder = newton.ModelBuilder()
        warpmag.register_attributes(builder)
        add(builder, *DISC)
        body = builder.add_body(xform=wp.transform((0.0, 0.0, 0.02), wp.quat_identity()))
        builder.add_shape_box(body, hx=SIDE, hy=SIDE, hz=SIDE)
        magnet = {"magnetization": ALONG, "recoil_permeability": recoil_permeability, "moment_spacing": SIDE}
        warpmag.add_permanent(builder, body=body, **magnet)
        if coil:
            warpmag.add_coil(builder, body=body, radius=0.02, ampere_turns=1.0)
        magnetics = warpmag.Magnetics(builder.finalize(device=device))
        return next(len(magnet.lattice.volumes) for magnet in magnetics.magnets if magnet.body == 0)

    assert moments() == 8
    assert moments(coil=True) > 100
    assert moments(recoil_permeability=1.05) > 100
