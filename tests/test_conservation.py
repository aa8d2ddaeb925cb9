"""Balls that attract each other without contact: energy, momentum and the order of the time step."""

import itertools

import numpy as np
import pytest

from bench.reference.fall import RADIUS, fall


@pytest.fixture(scope="module")
def falls(device):
    """Two balls, the step halved twice."""
    return [fall(2, dt, device) for dt in (2e-4, 1e-4, 5e-5)]


def test_energy_and_momentum(falls):
    assert falls[-1].drift < 1e-4
    assert all(entry.momentum < 1e-6 for entry in falls)
    distance = np.linalg.norm(falls[-1].positions[1] - falls[-1].positions[0])
    assert 2.9 * RADIUS < distance < 3.2 * RADIUS  # they fell, and did not touch


def test_order_of_convergence(falls):
    """Energy errs by dt², positions by dt: halved steps leave a quarter and a half, up to the next order."""
    drifts = [entry.drift for entry in falls]
    assert 3.6 < drifts[0] / drifts[1] < 4.4 and 3.6 < drifts[1] / drifts[2] < 4.4
    moved = [np.linalg.norm(a.positions - b.positions) for a, b in itertools.pairwise(falls)]
    assert 1.9 < moved[0] / moved[1] < 2.1


def test_three_balls(device):
    result = fall(3, 1e-4, device)
    assert result.drift < 1e-4 and result.momentum < 1e-6


def test_the_papers_force_is_no_gradient(device):
    """Eq. 4 makes energy: forces of soft balls are up to eight times those that their free energy has."""
    assert fall(2, 1e-4, device, force="zeeman").drift > 0.5
