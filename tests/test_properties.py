"""Symmetries that hold for any arrangement: hypothesis draws sizes, scales and what is done to them.

All in double precision. Sums of n terms that may cancel are known to n roundings of their largest terms; ``close``
compares with a thousand roundings of the largest value of the whole set.
"""

import numpy as np
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import warpmag

MS = 1.7e6
SEEDS = st.integers(0, 2**32 - 1)
COUNTS = st.integers(1, 40)
ANY = settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
DOUBLE = {"dtype": "float64"}


def close(computed, expected, rtol=2e-13):
    computed, expected = np.asarray(computed), np.asarray(expected)
    return np.abs(computed - expected).max(initial=0.0) <= rtol * np.abs(expected).max(initial=0.0)


def draw(seed, count):
    """Positions [m] of balls that touch and overlap here and there, radii [m] and moments [A·m²]."""
    rng = np.random.default_rng(seed)
    x = rng.uniform(-1.0, 1.0, (count, 3)) * 0.01 * np.cbrt(count)
    return x, rng.uniform(0.002, 0.006, count), rng.normal(size=(count, 3))


def rotation(seed):
    q, r = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    q *= np.sign(np.diag(r))
    q[:, 0] *= np.linalg.det(q)
    return q


def induced(x, radii, field, device, **arguments):
    return warpmag.solve_induction(
        x, radii, saturation=MS, external_field=field, rtol=1e-11, device=device, **DOUBLE, **arguments
    )


@ANY
@given(SEEDS, COUNTS, SEEDS)
def test_rotation(device, seed, count, turn):
    x, radii, m = draw(seed, count)
    q = rotation(turn)
    h = warpmag.h_field(x, m, radii=radii, device=device, **DOUBLE)
    assert close(warpmag.h_field(x @ q.T, m @ q.T, radii=radii, device=device, **DOUBLE), h @ q.T, 1e-10)
    for turned, straight in zip(
        warpmag.wrench(x @ q.T, m @ q.T, radii=radii, device=device, **DOUBLE),
        warpmag.wrench(x, m, radii=radii, device=device, **DOUBLE),
        strict=True,
    ):
        assert close(turned, straight @ q.T, 1e-10)  # x − y of turned positions is known to 1e-16 of x


@ANY
@given(SEEDS, COUNTS, st.tuples(*[st.integers(-1024, 1024)] * 3))
def test_translation(device, seed, count, steps):
    x, radii, m = draw(seed, count)
    x = np.round(x * 2**30) / 2**30  # so that the shifted positions are exact
    shift = np.array(steps) / 64.0
    h = warpmag.h_field(x, m, radii=radii, device=device, **DOUBLE)
    assert close(warpmag.h_field(x + shift, m, radii=radii, device=device, **DOUBLE), h)


@ANY
@given(SEEDS, COUNTS, st.integers(-20, 20))
def test_scaling(device, seed, count, power):
    """Lengths by s and moments by s³ leave the field as it is, and forces grow by s²."""
    x, radii, m = draw(seed, count)
    s = 2.0**power
    there, here = (s * x, s**3 * m), (x, m)
    big, own = {"radii": s * radii, "device": device, **DOUBLE}, {"radii": radii, "device": device, **DOUBLE}
    assert close(warpmag.h_field(*there, **big), warpmag.h_field(*here, **own))
    assert close(warpmag.wrench(*there, **big)[0], s**2 * warpmag.wrench(*here, **own)[0])


@ANY
@given(SEEDS, COUNTS, st.floats(-1e3, 1e3))
def test_superposition(device, seed, count, factor):
    x, radii, m = draw(seed, count)
    other = draw(seed ^ 1, count)[2]
    both, first, two = (
        warpmag.h_field(x, moments, radii=radii, device=device, **DOUBLE) for moments in (m + factor * other, m, other)
    )
    size = np.abs(first).max(initial=0.0) + abs(factor) * np.abs(two).max(initial=0.0)
    assert np.abs(both - first - factor * two).max(initial=0.0) <= 1e-12 * size


@ANY
@given(SEEDS, COUNTS)
def test_order_does_not_matter(device, seed, count):
    x, radii, m = draw(seed, count)
    order = np.random.default_rng(seed).permutation(count)
    options = {"device": device, **DOUBLE}
    h = warpmag.h_field(x, m, radii=radii, **options)
    assert close(warpmag.h_field(x[order], m[order], radii=radii[order], **options), h[order])
    solved = induced(x, radii, (3e5, 0.0, 1e5), device).magnetizations
    assert close(induced(x[order], radii[order], (3e5, 0.0, 1e5), device).magnetizations, solved[order], 1e-8)


@ANY
@given(SEEDS, COUNTS)
def test_action_is_reaction(device, seed, count):
    x, radii, m = draw(seed, count)
    force, torque = warpmag.wrench(x, m, radii=radii, device=device, **DOUBLE)
    assert np.linalg.norm(force.sum(axis=0)) <= 1e-13 * count * np.abs(force).sum()
    whole = torque + np.cross(x, force)
    assert np.linalg.norm(whole.sum(axis=0)) <= 1e-13 * count * np.abs(whole).sum()


@ANY
@given(SEEDS, COUNTS, SEEDS, st.floats(1e3, 1e7))
def test_induction_turns_and_mirrors_with_the_field(device, seed, count, turn, strength):
    x, radii, _ = draw(seed, count)
    q = rotation(turn)
    field = strength * np.array([0.48, 0.6, 0.64])
    result = induced(x, radii, field, device)
    assert result.converged
    # the solve ends at a residual of 1e-11, which the inverse Jacobian may amplify in overlapping clumps
    assert close(induced(x @ q.T, radii, q @ field, device).magnetizations, result.magnetizations @ q.T, 1e-7)
    assert close(induced(x, radii, -field, device).magnetizations, -result.magnetizations, 1e-7)


@ANY
@given(SEEDS, COUNTS, st.integers(-20, 20))
def test_induction_knows_no_length(device, seed, count, power):
    x, radii, _ = draw(seed, count)
    s = 2.0**power
    result = induced(x, radii, (0.0, 2e5, 0.0), device)
    assert close(induced(s * x, s * radii, (0.0, 2e5, 0.0), device).magnetizations, result.magnetizations, 1e-9)
