"""Box magnets, sampled as they come, against the closed form of their force."""

import numpy as np
import pytest

from bench import accuracy
from bench.reference import magnet_pairs

CUBE, M = (0.01, 0.01, 0.01), 1e6  # half extents in m, A/m


def test_reference_is_the_dipoles_far_away():
    """Two cubes of side 1 at distance 50: the first correction of a cube is of fourth order, (1/50)⁴."""
    volume, distance = 8.0 * 0.01**3, 1.0
    dipoles = -6.0 * magnet_pairs.MU0 / (4.0 * np.pi) * (volume * M) ** 2 / distance**4
    np.testing.assert_allclose(magnet_pairs.box_force(CUBE, CUBE, (0, 0, distance), M, M)[2], dipoles, rtol=1e-4)


@pytest.mark.parametrize("name", magnet_pairs.PAIRS)
def test_force_of_boxes(name, device):
    """Within 2e-3 from contact on, which Gauss points leave there: what ``python -m bench.accuracy boxes`` prints."""
    for row in accuracy.boxes(device, [name]):
        assert row["error"] < 2e-3, row
