"""Arguments of the array functions: each call is right against the oracle, or an ``InputError`` of one line.

``test_arguments_wild.py`` draws more of them.
"""

import math
import warnings
from fractions import Fraction

import numpy as np
import pytest

import warpmag
from bench.reference import oracle
from warpmag.declarations.magnets import Magnet, MagneticSettings

MS = 1.7e6
X = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.012], [0.02, 0.0, 0.0]])
M = np.array([[0.0, 0.1, 0.2], [0.3, -0.1, 0.2], [0.1, 0.0, -0.2]])
CALLS = {
    "h_field": {"positions": X, "moments": M},
    "wrench": {"positions": X, "moments": M},
    "solve_induction": {"positions": X, "radii": 0.005, "saturation": MS, "external_field": (0.0, 0.0, 1e5)},
}


class Unreadable:
    """Neither an array nor anything that can be shown."""

    def __array__(self, *_, **__):
        raise KeyError("no array")

    def __repr__(self):
        raise RuntimeError("nothing to see")


def call(name, device, /, **arguments):
    """Results of a call as one list of arrays, forces of the equilibrium among them."""
    arguments = {**CALLS[name], "device": device, **arguments}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", warpmag.errors.ConvergenceWarning)
        result = getattr(warpmag, name)(**arguments)
        if name == "h_field":
            return [result]
        if name == "wrench":
            return list(result)
        return [result.magnetizations, result.h_field, *result.wrench()]


def refused(name, device, match, /, **arguments):
    with pytest.raises(warpmag.InputError, match=match) as caught:
        call(name, device, **arguments)
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 300


# argument, value that is no numbers, message
NO_NUMBERS = {
    "complex": (X * (1 + 1j), "must be real numbers"),
    "bools": (X > 0.0, "must be real numbers"),
    "strings": ([["0", "0", "1"]] * 3, "must be real numbers"),
    "None": ([[None, 0, 1]] * 3, "must be real numbers"),
    "bools among objects": (np.array([[True, 0, 1]] * 3, object), "must be real numbers"),
    "dates": (np.zeros((3, 3), "datetime64[s]"), "must be real numbers"),
    "an object": (Unreadable(), "no array of numbers"),
    "ragged": ([[0.0, 0.0], [0.0]], "no array of numbers"),
    "masked": (np.ma.masked_array(X, X > 0.0), "has masked entries"),
    "an int beyond float64": ([[10**400, 0, 0]] * 3, "beyond the largest float64"),
    "empty": ([], r"shape must be .*, got \[0\]"),
    "0-d": (np.array(1.0), r"shape must be .*, got \[\]"),
    "a dimension more": (X[None], r"shape must be .*, got \[1, 3, 3\]"),
    "NaN": (np.where(X > 0.015, np.nan, X), r"contains NaN \(row 2\)"),
    "infinite": (np.where(X > 0.015, -np.inf, X), r"not finite in float32 \(row 2\)"),
}


@pytest.mark.parametrize("which", NO_NUMBERS)
@pytest.mark.parametrize(
    ("name", "argument"),
    [
        ("h_field", "positions"),
        ("h_field", "moments"),
        ("h_field", "targets"),
        ("wrench", "external_field"),
        ("solve_induction", "positions"),
        ("solve_induction", "initial"),
    ],
)
def test_no_vectors(name, argument, which, device):
    value, message = NO_NUMBERS[which]
    refused(name, device, f"^{argument}: {message}", **{argument: value})


NO_SCALARS = [True, None, "1", b"1", 1j, [0.1, 0.2], np.zeros((3, 1)), np.datetime64("2020"), {}, Unreadable(), np.nan]


@pytest.mark.parametrize("value", NO_SCALARS, ids=lambda value: type(value).__name__)
@pytest.mark.parametrize("argument", ["radii", "saturation", "susceptibility"])
def test_no_scalars(argument, value, device):
    refused("solve_induction", device, f"^{argument}: ", **{argument: value})


# arguments of solve_induction, message
REFUSED = [
    ({"rtol": "1e-3"}, "rtol: must be one real number"),
    ({"rtol": True}, "rtol: must be one real number"),
    ({"rtol": [1e-3]}, "rtol: must be one real number"),
    ({"rtol": 1e-3 + 0j}, "rtol: must be one real number"),
    ({"rtol": math.inf}, "rtol: must be at least"),
    ({"rtol": 10**400}, "rtol: beyond the largest float"),
    ({"max_evaluations": 10.0}, "max_evaluations: must be a whole number"),
    ({"max_evaluations": True}, "max_evaluations: must be a whole number"),
    ({"max_evaluations": -1}, "max_evaluations: must be at least 1"),
    ({"max_evaluations": 2**31}, "max_evaluations: must be at least 1 and below 2³¹"),
    ({"curve": ["tanh"]}, "curve: .* is not one of"),
    ({"curve": np.array(["tanh", "tanh"])}, "curve: .* is not one of"),
    ({"dtype": ["float32"]}, "dtype: .* is not one of"),
    ({"dtype": np.float32}, "dtype: .* is not one of"),
    ({"device": ["cpu"]}, "device: no "),
    ({"device": 3.5}, "device: no 3.5"),
    ({"device": np.zeros(2)}, "device: no "),
    ({"permanent": X}, "permanent: must be "),
    ({"permanent": (X,)}, "permanent: must be "),
    ({"permanent": (X, M[:2])}, r"permanent: moments: shape must be \[3\] or \[3, 3\]"),
    ({"positions": X[:, :2]}, r"positions: shape must be \[n, 3\], got \[3, 2\]"),
    ({"positions": X * 1e25}, "positions: 2e.23 m from the origin .row 2., at most 1e.07 m in float32; use float64"),
    ({"positions": X + 1e3, "radii": 1e-7}, "positions: .* with balls of this size at most 200 m"),
    ({"radii": 0}, "radii: must be positive, got 0"),
    ({"saturation": 0}, "saturation: must be positive, got 0"),
    ({"saturation": 1e30}, "saturation: must be 1e-12 to 1e.15 in float32, got 1e.30; use float64"),
    ({"saturation": math.inf}, "saturation: must be finite"),
    ({"external_field": (0, 0, 1e30)}, "external_field, permanent, saturation: a field of 1e.30 A/m is too strong"),
    ({"external_field": (0, 0, 1e-25)}, "external_field, permanent, saturation: a field of .* A/m is too weak"),
    ({"permanent": (X + 1.0, M * 1e38)}, "external_field, permanent, saturation: a field of .* is too strong"),
]


@pytest.mark.parametrize(("arguments", "message"), REFUSED, ids=lambda case: str(case)[:40])
def test_refused(arguments, message, device):
    refused("solve_induction", device, f"^{message}", **arguments)


@pytest.mark.parametrize(
    ("name", "arguments", "message"),
    [
        ("wrench", {"positions": X * 1e25}, "positions: .* at most 1e.07 m in float32"),
        ("wrench", {"positions": X * 1e25, "dtype": "float64"}, None),
        ("wrench", {"positions": X * 1e-6}, "positions, moments: the force at row 0 .* nearest moment at 1.2e-08 m"),
        ("wrench", {"positions": X * 1e-6, "dtype": "float64"}, None),
        ("wrench", {"moments": M * 1e30}, "positions, moments: the force at row 0 is not finite, .* up to 3e.29 A·m²"),
        ("wrench", {"moments": M * 1e-25}, "moments: all below 1e-18, the largest is 3e-26, in float32; use float64"),
        ("wrench", {"moments": M * 1e-25, "dtype": "float64"}, None),
        ("wrench", {"external_field": (0, 0, 3e38), "moments": M * 1e10}, "positions, moments, external_field: the to"),
        ("h_field", {"positions": X * 1e-6}, None),
        ("h_field", {"positions": X * 1e-13}, "positions, moments: the field at row 0 is not finite"),
        ("h_field", {"positions": X * 1e7, "method": "reference"}, "positions: .* at most 50000 m in float32"),
        ("h_field", {"radii": 1e-7, "method": "reference"}, "radii: must be 1e-06 to 20000 m in float32, got 1e-07"),
        ("h_field", {"smoothing": 1e-9}, "smoothing: must be 1e-06 to 20000 m in float32, got 1e-09; use float64"),
        ("h_field", {"smoothing": 10**30}, "smoothing: must be 1e-06 to 20000 m in float32"),
        ("h_field", {"smoothing": "1"}, "smoothing: must be one real number, got '1'"),
        ("h_field", {"smoothing": math.inf}, "smoothing: must be zero or positive and finite"),
        ("h_field", {"method": 3}, "method: 3 is not one of"),
    ],
)
def test_out_of_range(name, arguments, message, device):
    """What is beyond float32 says so, and is right in float64."""
    if message is not None:
        refused(name, device, f"^{message}", **arguments)
        return
    arguments = {**CALLS[name], **arguments}
    x, m = arguments["positions"], arguments["moments"]
    h = oracle.h_field(x, m)
    expected = [h] if name == "h_field" else [oracle.kelvin_force(m, oracle.field_gradient(x, m)), oracle.torque(m, h)]
    for actual, value in zip(call(name, device, **arguments), expected, strict=True):
        assert np.abs(actual - value).max() <= 1e-5 * np.abs(value).max()


GUISES = {
    "lists": lambda a: a.tolist(),
    "tuples": lambda a: tuple(map(tuple, a.tolist())),
    "Fortran": np.asfortranarray,
    "big-endian": lambda a: a.astype(">f8"),
    "strided": lambda a: np.repeat(a, 3, axis=0)[::3],
    "reversed": lambda a: a[::-1].copy()[::-1],
    "read-only": lambda a: np.broadcast_to(a, a.shape),
    "longdouble": lambda a: a.astype(np.longdouble),
    "fractions": lambda a: np.array([[Fraction(v) for v in row] for row in a.tolist()], object),
    "nothing masked": np.ma.masked_array,
}


@pytest.mark.parametrize("guise", GUISES)
@pytest.mark.parametrize("name", CALLS)
def test_guises_of_the_same_numbers(name, guise, device):
    """However numbers come, the result is the same, bit by bit."""
    arguments = {
        key: GUISES[guise](np.asarray(value, float)) if np.ndim(value) == 2 else value
        for key, value in CALLS[name].items()
    }
    for actual, expected in zip(call(name, device, **arguments), call(name, device), strict=True):
        assert np.array_equal(actual, expected)


@pytest.mark.parametrize("integer", [int, np.int64, np.uint32, np.array, lambda n: np.full(3, n), lambda n: [n] * 3])
def test_integers_are_numbers(integer, device):
    x = np.array([[0, 0, 0], [0, 0, 3], [4, 0, 0]])
    given = {
        "positions": x,
        "external_field": (0, 0, 100_000),
        "initial": (0, 0, 1),
        "permanent": ([[9, 9, 9]], [[1, 2, 3]]),
    }
    result = call("solve_induction", device, radii=integer(1), saturation=integer(1_700_000), **given)
    given = {key: np.asarray(value, float) for key, value in given.items() if key != "permanent"}
    given["permanent"] = (np.full((1, 3), 9.0), np.array([[1.0, 2.0, 3.0]]))
    for entry, other in zip(result, call("solve_induction", device, radii=1.0, saturation=1.7e6, **given), strict=True):
        assert np.array_equal(entry, other)


def test_half_precision_is_read_as_it_is(device):
    x = X.astype(np.float16)
    assert np.array_equal(
        call("h_field", device, positions=x)[0], call("h_field", device, positions=x.astype(float))[0]
    )


def warp_vectors(values, device, dtype=None):
    import warp as wp  # noqa: PLC0415 - as the device fixture does

    return wp.array(values, dtype=dtype or wp.vec3, device=device)


def test_warp_arrays(device):
    """Strided and indexed arrays, and those of another precision, work. NaN, other types and shapes raise errors."""
    import warp as wp  # noqa: PLC0415

    expected = call("wrench", device)
    every = warp_vectors(np.repeat(X, 2, axis=0), device)
    chosen = every[wp.array([0, 2, 4], dtype=int, device=device)]
    for x in (warp_vectors(X, device), every[::2], chosen, warp_vectors(X, device, wp.vec3d)):
        actual = call("wrench", device, positions=x, moments=warp_vectors(M, device))
        for entry, other in zip(actual, expected, strict=True):
            assert isinstance(entry, wp.array) and np.array_equal(entry.numpy(), other)
    for value, message in (
        (warp_vectors(X * np.nan, device), r"contains NaN \(row 0\)"),
        (warp_vectors(np.where(X > 0.015, np.inf, X), device), r"not finite in float32 \(row 2\)"),
        (warp_vectors(X * 1e45, device, wp.vec3d), "not finite in float32"),
        (warp_vectors(X * 1e25, device), "2e.23 m from the origin"),
        (wp.array(X, dtype=float, device=device), r"shape must be \[n\] of vec3f, got \[3, 3\] of float32"),
        (wp.zeros(3, dtype=wp.vec2, device=device), "cannot convert vec2f to vec3f"),
        (wp.zeros(3, dtype=wp.quat, device=device), "cannot convert quatf to vec3f"),
        (wp.zeros(3, dtype=float, device=device), "cannot convert float32 to vec3f"),
    ):
        refused("wrench", device, f"^positions: {message}", positions=value)
    for value in (warp_vectors(X, device), wp.full(3, math.nan, dtype=float, device=device)):
        refused("h_field", device, "^radii: ", radii=value)


def test_results_are_the_callers(device):
    """Forces of one law stay what they are when another is asked for."""
    result = warpmag.solve_induction(**CALLS["solve_induction"], device=device)
    kelvin = result.wrench("kelvin")[0]
    before = kelvin.copy()
    assert not np.array_equal(result.wrench("zeeman")[0], before)
    assert np.array_equal(kelvin, before)


@pytest.mark.parametrize("force", [None, "", "x", 1, np.ones((2, 3)), ["kelvin"]])
def test_no_force_law(force, device):
    result = warpmag.solve_induction(**CALLS["solve_induction"], device=device)
    with pytest.raises(warpmag.InputError, match="^force: .* is not one of kelvin, zeeman$"):
        result.wrench(force)


def test_sources_is_a_deprecated_name(device):
    dipole = [[0.0, 0.0, 0.05]], [[0.0, 0.0, 1.0]]
    expected = call("solve_induction", device, permanent=dipole)
    with pytest.warns(DeprecationWarning, match="sources is deprecated, use permanent"):
        actual = warpmag.solve_induction(**CALLS["solve_induction"], sources=dipole, device=device)
    assert np.array_equal(actual.magnetizations, expected[0])


@pytest.mark.parametrize("gap", [-0.02, 0.05, 0.3])
def test_permanent_moment_beside_near_contacts(gap, device):
    """A far, weak permanent moment beside balls that touch, in one vector of a CPU, changes nothing."""
    x = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.01 * (1.0 + gap)]])
    arguments = {"positions": x, "contact_model": "multipole", "rtol": 1e-5}
    alone = call("solve_induction", device, **arguments)
    beside = call("solve_induction", device, permanent=([[1e3, 0.0, 0.0]], [[1.0, 0.0, 0.0]]), **arguments)
    for entry, other in zip(beside, alone, strict=True):
        assert np.abs(entry - other).max() <= 1e-4 * max(np.abs(other).max(), 1e-4)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"radii": 0.1}, r"radii: shape must be \[n\]"),
        ({"radii": ["a"]}, "radii: must be real numbers"),
        ({"worlds": [0]}, r"worlds: shape must be \[2\]"),
        ({"worlds": [0.5, 0.5]}, "worlds: must be whole numbers"),
        ({"worlds": [-1, 0]}, "worlds, permanent: moments must be ordered by world, from 0 on"),
        ({"bodies": ["a", "b"]}, "bodies: must be whole numbers"),
        ({"permanent": "no"}, r"permanent: shape must be \[2\]"),
        ({"movable": [0.5, 1.0]}, "movable: must be flags"),
        ({"saturation": [1.0, 2.0, 3.0]}, r"saturation: shape must be \[\] or \[2\]"),
        ({"saturation": math.nan}, "saturation: must be finite"),
        ({"susceptibility": -1}, "susceptibility: must be positive"),
        ({"external_field": (0.0, math.nan, 0.0)}, "external_field: must be finite"),
        ({"external_field": 1.0}, r"external_field: shape must be \[3\] or \[2, 3\]"),
        ({"dynamics": "llg", "step": "1"}, "step: must be one real number"),
        ({"max_evaluations": 1.5}, "max_evaluations: must be a whole number"),
    ],
)
def test_moment_system(arguments, message, device):
    from bench.systems import moment_system  # noqa: PLC0415 - imports Warp

    with pytest.raises(warpmag.InputError, match=f"^{message}"):
        moment_system(**{"radii": [0.1, 0.1], "device": device, **arguments})


@pytest.mark.parametrize(
    ("record", "message"),
    [
        (Magnet(saturation="1"), "saturation: must be one real number"),
        (Magnet(susceptibility=True), "susceptibility: must be one real number"),
        (Magnet(moment_spacing=None), "moment spacing: must be one real number"),
        (Magnet(kind=["permanent"]), "kind: .* is not one of"),
        (Magnet(kind="permanent", magnetization=(1.0, 2.0)), "magnetization: must be three numbers"),
        (Magnet(kind="permanent", magnetization=1.0), "magnetization: must be three numbers"),
        (Magnet(kind="permanent", magnetization=(1.0, 2.0, "3")), "magnetization: must be one real number"),
        (MagneticSettings(external_field=(1.0, 2.0, math.inf)), "external field: must be finite"),
        (MagneticSettings(rtol=None), "rtol: must be one real number"),
    ],
)
def test_records(record, message):
    with pytest.raises(warpmag.InputError, match=f"^/Ball: {message}"):
        record.check("/Ball")
