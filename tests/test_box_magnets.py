"""Box magnets, sampled as they come, against the closed form of their force."""

import newton
import numpy as np
import pytest
import warp as wp

import warpmag
from bench.reference import cuboids

M = 1e6  # A/m
CUBE, PLATE, BAR = (0.01, 0.01, 0.01), (0.01, 0.01, 0.002), (0.003, 0.003, 0.01)  # half extents, m


def sampled(half1, half2, offset, device):
    """Force on the second of two boxes [N], and all moments."""
    builder = newton.ModelBuilder()
    warpmag.register_attributes(builder)
    for half, place in ((half1, (0.0, 0.0, 0.0)), (half2, offset)):
        body = builder.add_body(xform=wp.transform(wp.vec3(*place), wp.quat_identity()))
        builder.add_shape_box(body, hx=half[0], hy=half[1], hz=half[2])
        warpmag.add_permanent(builder, body, magnetization=(0.0, 0.0, M))
    model = builder.finalize(device=device)
    magnetics, state = warpmag.Magnetics(model), model.state()
    state.clear_forces()
    magnetics.apply(state)
    return state.body_f.numpy()[1, :3], magnetics.system.count


def test_reference_is_the_dipoles_far_away():
    """Two cubes of side 1 at distance 50: the first correction of a cube is of fourth order, (1/50)⁴."""
    volume, distance = 8.0 * 0.01**3, 1.0
    dipoles = -6.0 * cuboids.MU0 / (4.0 * np.pi) * (volume * M) ** 2 / distance**4
    np.testing.assert_allclose(cuboids.force(CUBE, CUBE, (0, 0, distance), M, M)[2], dipoles, rtol=1e-4)


@pytest.mark.parametrize("gap, error", [(0.2, 0.03), (0.5, 0.01)])
@pytest.mark.parametrize(
    "half1, half2, axis, aside",
    [(CUBE, CUBE, 2, 0.0), (CUBE, CUBE, 0, 0.0), (PLATE, PLATE, 2, 0.0), (BAR, BAR, 2, 0.0), (CUBE, PLATE, 2, 0.3)],
    ids=["cubes in line", "cubes side by side", "plates", "bars", "cube and plate off axis"],
)
def test_force_of_boxes(half1, half2, axis, aside, gap, error, device):
    side = 2.0 * max(half1)
    offset = np.zeros(3)
    offset[0] = aside * side
    offset[axis] = half1[axis] + half2[axis] + gap * side
    exact = cuboids.force(half1, half2, offset, M, M)
    found, moments = sampled(half1, half2, offset, device)
    miss = np.linalg.norm(found - exact) / np.linalg.norm(exact)
    print(f"gap {gap} side: {100.0 * miss:.3f} % with {moments} moments")
    assert miss < error
