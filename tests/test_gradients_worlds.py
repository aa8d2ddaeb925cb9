"""Gradients of systems of several worlds: those of each world alone, also in a captured graph."""

import numpy as np
import pytest
import warp as wp

from bench.systems import moment_system, solve_cold

COUNTS = ((5, 2), (1, 0), (0, 3), (40, 0))
"""Inducible and permanent moments of each world. The first world's magnets are one body."""


def make_system(worlds, device, rtol=1e-11, dtype="float64"):
    """System of some of the worlds of ``COUNTS``, and the cotangents of its forces and torques, NumPy."""
    positions, moments, permanent, world_of, bodies, seeds = [], [], [], [], [], []
    for number, w in enumerate(worlds):
        rng, (inducible, magnets) = np.random.default_rng(w), COUNTS[w]
        n = inducible + magnets
        grid = np.stack(np.meshgrid(*[np.arange(4.0)] * 3), -1).reshape(-1, 3)[:n]
        positions.append(0.0105 * grid + 2e-4 * rng.normal(size=(n, 3)))
        moments.append(rng.normal(size=(n, 3)))
        permanent.append(np.arange(n) >= inducible)
        world_of.append(np.full(n, number))
        bodies.append(100 * number + np.minimum(np.arange(n), inducible if w == 0 else n))
        seeds.append(rng.normal(size=(2, n, 3)))
    system = moment_system(
        radii=np.full(sum(map(len, positions)), 0.005), worlds=np.concatenate(world_of),
        permanent=np.concatenate(permanent), bodies=np.concatenate(bodies), saturation=1.7e6,
        external_field=(2e5, 0.0, 6e5), rtol=rtol, dtype=dtype, device=device,
    )  # fmt: skip
    system.positions.assign(np.concatenate(positions))
    system.moments.assign(np.concatenate(moments))
    seeds = [wp.array(part, dtype=system.h.dtype, device=device) for part in np.concatenate(seeds, axis=1)]
    return system, seeds


def differentiate(system, seeds):
    """Compute the gradients of forces and torques through the solve."""
    system.gradients.load(system.positions, system.moments, system.h, system.external_field)
    sums = system.gradients.wrench(*seeds)
    system.gradients.solve(sums.by_moments, seeds[0])


def results(system):
    gradients = system.gradients
    return [array.numpy().copy() for array in (gradients.by_positions, gradients.by_moments, gradients.by_field)]


def test_worlds_are_independent(device):
    system, seeds = make_system(range(len(COUNTS)), device)
    solve_cold(system)
    first_world = (system.worlds == 0)[:, None]  # worlds of very different cotangents do not mix
    seeds[0].assign(np.where(first_world, 1e-6, 1.0) * seeds[0].numpy())
    differentiate(system, seeds)
    system.gradients.check()
    together, begin = results(system), 0
    for w, counts in enumerate(COUNTS):
        rows = slice(begin, begin + sum(counts))
        begin += sum(counts)
        alone, own_seeds = make_system([w], device)
        for own, seed in zip(own_seeds, seeds, strict=True):
            own.assign(seed.numpy()[rows])
        solve_cold(alone)
        differentiate(alone, own_seeds)
        for expected, values in zip(results(alone), together, strict=True):
            # solves and linear solves end at a relative error of 1e-11
            assert np.linalg.norm(values[rows] - expected) <= 1e-9 * np.linalg.norm(expected), w


def test_a_warm_start_needs_few_evaluations(device):
    system, seeds = make_system([3], device, rtol=1e-3, dtype="float32")
    solve_cold(system)
    differentiate(system, seeds)
    cold, first = results(system), int(system.gradients.evaluations()[0])
    system.gradients.solve(system.gradients.wrench(*seeds).by_moments, seeds[0], warm=True)
    # one evaluation scales the last solution and finds it converged
    assert int(system.gradients.evaluations()[0]) == 1 < first
    for expected, values in zip(cold, results(system), strict=True):
        assert np.linalg.norm(values - expected) < 1e-2 * np.linalg.norm(expected)


@pytest.mark.cuda
def test_a_graph_captures_gradients(device):
    if not wp.get_device(device).is_cuda:
        pytest.skip("the emulated device has no graphs")
    system, seeds = make_system(range(len(COUNTS)), device)
    solve_cold(system)
    differentiate(system, seeds)
    expected = results(system)
    with wp.ScopedCapture(device) as capture:
        solve_cold(system)
        differentiate(system, seeds)
        system.gradients.check()
    for array in (system.gradients.by_positions, system.gradients.by_moments, system.gradients.by_field):
        array.zero_()
    for _ in range(2):
        wp.capture_launch(capture.graph)
    for before, after in zip(expected, results(system), strict=True):
        assert np.linalg.norm(after - before) <= 1e-9 * np.linalg.norm(before)
