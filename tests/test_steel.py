"""Measured magnetization curves: tables, their interpolation, and what balls of such materials do.

The independent reference interpolates with SciPy's PCHIP and finds each ball's field inside by bisection.
"""

import math
import os

import newton
import numpy as np
import pytest
import warp as wp
from scipy.interpolate import CubicHermiteSpline, PchipInterpolator
from scipy.optimize import brentq

import warpmag
from bench.reference import oracle
from bench.systems import moment_system
from warpmag import MagnetizationCurve
from warpmag.declarations.materials import MATERIALS
from warpmag.declarations.measured import MEASURED_CURVES
from warpmag.engine.magnets.attributes import marked_shapes
from warpmag.errors import InputError
from warpmag.kernels.material import curves as kernel_curves
from warpmag.kernels.shared.native import native_options

MU0 = 4e-7 * math.pi
NAMES = list(MEASURED_CURVES)


def points_of(name):
    """Points H [A/m] and B [T] as they were published, shape [points]."""
    return np.array([point for row in MEASURED_CURVES[name][1:] for point in row]).T


def reference(name):
    """M and dM/dH [A/m, 1] of fields inside, by SciPy through the points and their mirror images; and Ms [A/m]."""
    h, b = points_of(name)
    m = np.maximum.accumulate(b / MU0 - h)
    a = (m[-1] - m[-2]) / (1.0 / h[-2] - 1.0 / h[-1])  # M = Ms − a/H through the last two
    x, y = np.r_[-h[:0:-1], h], np.r_[-m[:0:-1], m]
    slope = PchipInterpolator(x, y).derivative()(x)
    slope[[0, -1]] = a / h[-1] ** 2
    cubic, saturation = CubicHermiteSpline(x, y, slope), m[-1] + a / h[-1]

    def law(x):
        inside, beyond = np.minimum(x, h[-1]), np.maximum(x, h[-1])
        m = np.where(x > h[-1], saturation - a / beyond, cubic(inside))
        return m, np.where(x > h[-1], a / beyond**2, cubic.derivative()(inside))

    return law, saturation


def ball_in(law, field):
    """Field inside and magnetization [A/m] of a ball in a uniform field: the root of H' + M(H')/3 = H."""
    inside = brentq(lambda x: x + float(law(x)[0]) / 3.0 - field, 0.0, field, xtol=1e-13 * field, rtol=1e-15)
    return inside, float(law(inside)[0]) if inside > 0.1 * field else 3.0 * (field - inside)


@pytest.mark.parametrize("name", NAMES)
def test_curve_between_and_beyond_the_points(name):
    curve, (law, saturation) = MATERIALS[name].curve, reference(name)
    h, b = points_of(name)
    fields = np.r_[0.0, np.geomspace(1e-2, 1e8, 4000)]
    m, slope = law(fields)
    assert curve.saturation == pytest.approx(saturation, rel=1e-12)
    np.testing.assert_allclose(curve.magnetization(fields), m, rtol=1e-11)  # rounding of B/μ0 − H
    np.testing.assert_allclose(MU0 * (curve.magnetization(h) + h), b, rtol=1e-3 if name == "430-stainless" else 1e-12)
    assert (np.diff(curve.magnetization(fields)) >= 0.0).all() and (curve.magnetization(fields) <= saturation).all()
    assert curve.susceptibility == pytest.approx(slope.max(), rel=1e-3)  # of 4,000 places
    assert curve.susceptibility >= slope.max() * (1.0 - 1e-12)


@pytest.mark.parametrize("fields", [-1.0, math.nan, [math.inf], "1", None, 1j, [[1.0], [1.0, 2.0]], {1.0}])
def test_magnetization_of_no_fields(fields):
    """A negative field gave the cubic of the first two points, continued."""
    with pytest.raises(InputError, match=f"^{NAMES[0]}: fields must be "):
        MATERIALS[NAMES[0]].curve.magnetization(fields)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("name", NAMES)
def test_kernels_follow_the_table(name, dtype, device):
    """Ratio, slope, inverse and area of the kernels, against the reference; and the inverse undoes the curve."""
    curve, (law, saturation), kind = MATERIALS[name].curve, reference(name), getattr(wp, dtype)
    inside = np.r_[np.geomspace(1e-3, 3e6, 400), curve.fields[1:]]
    m, slope = law(inside)
    k = 3.0 / (1.0 + 3.0 / curve.susceptibility)
    s, c = k * (inside + m / 3.0) / saturation, m / saturation

    @wp.kernel(module="unique", enable_backward=False, module_options=native_options("material/curves.h", dtype=kind))
    def evaluate(tables: wp.array2d[kind], s: wp.array[kind], c: wp.array[kind], out: wp.array2d[wp.float64]):
        i = wp.tid()
        curve, k = wp.static(kernel_curves.FIRST_TABLE), kind(3.0)  # the rows of a table contain k
        out[0, i] = wp.float64(kernel_curves.curve_ratio(s[i], k, curve, tables))
        out[1, i] = wp.float64(kernel_curves.curve_slope(s[i], k, curve, tables))
        out[2, i] = wp.float64(kernel_curves.inverse_curve_ratio(c[i], k, curve, tables))
        out[3, i] = kernel_curves.curve_area(s[i], k, curve, tables)

    tables = kernel_curves.curve_tables([curve], kind, device)
    given = [wp.array(x, dtype=kind, device=device) for x in (s, c)]
    out = wp.zeros((4, len(s)), dtype=wp.float64, device=device)
    wp.launch(evaluate, dim=len(s), inputs=[tables, *given, out], device=device)
    ratio, steep, inverse, area = out.numpy()
    rounding = {"float32": 3e-7, "float64": 1e-14}[dtype]
    assert np.abs(ratio * s / c - 1.0).max() < 10.0 * rounding
    # c' is what is left of two numbers near 1, and jumps in its own slope at the points
    assert np.abs(steep - slope / (1.0 + slope / 3.0) / k).max() < 3e3 * rounding
    known = (c < 0.9999) & (slope > 1e-3)  # where saturated, rounding decides the field
    assert np.abs(inverse * c / s - 1.0)[known].max() < 1e2 * rounding / (1.0 - 0.9999)
    assert np.abs(inverse * ratio - 1.0)[known & (c < 0.9)].max() < 1e2 * rounding
    # ∫c ds by Simpson's rule, a piece for each pair of neighbours
    order = np.argsort(inside)
    fine = np.unique(
        np.concatenate(
            [
                [0.0],
                *(np.linspace(a, b, 41) for a, b in zip(np.r_[0.0, inside[order][:-1]], inside[order], strict=True)),
            ]
        )
    )
    value, derivative = law(fine)
    along = value * (1.0 + derivative / 3.0)
    middle, grown = law(0.5 * (fine[1:] + fine[:-1]))
    part = np.diff(fine) / 6.0 * (along[1:] + along[:-1] + 4.0 * middle * (1.0 + grown / 3.0))
    total = np.interp(inside, fine, np.r_[0.0, np.cumsum(part)]) * k / saturation**2
    assert np.abs(area / total - 1.0).max() < max(1e2 * rounding, 1e-6)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_balls_of_several_materials(dtype, device):
    """Each curve among others, alone in its world, against the scalar root M = f(H − M/3)."""
    curves = [*NAMES, "tanh", "langevin", "clamped", "frohlich"]
    fields = np.geomspace(30.0, 3e6, 7)
    each = [curves[i % len(curves)] for i in range(len(curves) * len(fields))]
    h0 = np.repeat(fields, len(curves))
    system = moment_system(
        radii=np.full(len(each), 0.005), worlds=np.arange(len(each)), saturation=1.7e6, susceptibility=300.0,
        curve=[MATERIALS[curve].curve if curve in NAMES else curve for curve in each], dtype=dtype, device=device,
        external_field=np.outer(h0, [0.6, 0.0, -0.8]),
    )  # fmt: skip
    system.solve()
    magnetizations = system.magnetizations().numpy() @ [0.6, 0.0, -0.8]
    laws = {name: reference(name)[0] for name in NAMES}
    for curve, field, m in zip(each, h0, magnetizations, strict=True):
        if curve in NAMES:
            exact = ball_in(laws[curve], field)[1]
        else:
            exact = oracle.magnetization(np.array([[field, 0.0, 0.0]]), 1.7e6, 300.0, curve)[0][0, 0]
        # Langevin's coth x - 1/x loses a digit just above where its series ends
        rounding = {"float32": 6e-6 if curve == "langevin" else 3e-6, "float64": 1e-12}[dtype]
        assert m == pytest.approx(exact, rel=rounding)


@pytest.mark.parametrize("contact_model", ["dipole", "multipole"])
def test_many_curves_are_each_one_of_its_own(contact_model, device):
    """A pile of one material is the same whether its curve is said once or for each; and one of two is in between."""
    rng = np.random.default_rng(3)
    x = 0.0101 * (np.array(list(np.ndindex(4, 4, 3))) + 0.02 * rng.normal(size=(48, 3)))
    given = {"external_field": (0.0, 3e5, 1e5), "contact_model": contact_model, "rtol": 1e-5, "device": device}
    steel = {"curve": "1010-steel"}
    once = warpmag.solve_induction(x, 0.005, **steel, **given)
    mixed = warpmag.solve_induction(x, 0.005, curve=["1010-steel"] * 48, **given)
    assert np.array_equal(once.magnetizations, mixed.magnetizations)
    curves = ["1010-steel" if i % 3 else "tanh" for i in range(48)]
    both = warpmag.solve_induction(x, 0.005, curve=curves, saturation=1.7e6, **given)
    assert both.converged
    tanh = np.array(curves) == "tanh"
    law, _ = reference("1010-steel")
    for balls, curve in ((tanh, "tanh"), (~tanh, None)):
        h, m = np.asarray(both.h_field, float)[balls], np.asarray(both.magnetizations, float)[balls]
        norm = np.linalg.norm(h, axis=1)
        if curve is None:
            exact = np.array([ball_in(law, size)[1] for size in norm])
        else:
            exact = np.linalg.norm(oracle.magnetization(h, 1.7e6, math.inf, curve)[0], axis=1)
        np.testing.assert_allclose(np.linalg.norm(m, axis=1), exact, rtol=1e-5)
    assert (
        np.linalg.norm(both.magnetizations[~tanh], axis=1).max()
        > np.linalg.norm(both.magnetizations[tanh], axis=1).max()
    )


def steel_oracle(name):
    """The reference as a reduced curve of the oracle, with its saturation and susceptibility."""
    law, saturation = reference(name)
    susceptibility = MATERIALS[name].curve.susceptibility
    k = oracle.curve_slope(susceptibility)

    def reduced(s):
        flat = np.ravel(s)
        inside = np.array([ball_in(law, size * saturation / k)[0] if size > 0.0 else 0.0 for size in flat])
        m, slope = law(inside)
        return (m / saturation).reshape(s.shape), (slope / (1.0 + slope / 3.0) / k).reshape(s.shape)

    return {"curve": reduced, "saturation": saturation, "susceptibility": susceptibility}


@pytest.mark.parametrize("dynamics", ["theta", "theta-euler", "llg"])
def test_a_pile_of_steel_against_newton(dynamics, device):
    x = 0.0101 * np.array(list(np.ndindex(3, 2, 2)))
    # LLG's explicit steps settle in weak fields alone where a curve has a knee, as on the clamped one
    h0 = (0.3 if dynamics == "llg" else 1.0) * np.array([2e5, 3e5, -1e5])
    exact = oracle.equilibrium(x, 0.005, h0, **steel_oracle("M-19"))
    result = warpmag.solve_induction(
        x, 0.005, curve="M-19", external_field=h0, dynamics=dynamics, rtol=1e-6, dtype="float64", device=device,
        max_evaluations=5000,
    )  # fmt: skip
    assert exact.residual < 1e-10 and result.converged
    # explicit dynamics stop at a residual, which is the error over the slowest mode's rate: 1/3 at most here
    error = np.linalg.norm(result.magnetizations - exact.magnetizations) / np.linalg.norm(exact.magnetizations)
    assert error < (1e-6 if dynamics == "theta" else 1e-5)


@pytest.mark.parametrize("force", ["kelvin", "zeeman"])
def test_forces_follow_the_table(force, device):
    """Kelvin's is minus the gradient of the energy; Zeeman's takes the slope of the curve (Eq. 4)."""
    x = np.array([[0.0, 0.0, 0.0], [0.012, 0.003, 0.0], [0.004, 0.013, 0.005]])
    n, h0 = len(x), np.array([1e5, 2e5, 3e5])
    system = moment_system(
        radii=np.full(n, 0.005), curve=MATERIALS["M-19"].curve, external_field=h0, rtol=1e-11, dtype="float64",
        force=force, device=device,
    )  # fmt: skip

    def energy(places):
        system.positions.assign(places)
        system.solve()
        return system.energy()[0]

    step = 1e-7
    gradient = [(energy(x + d) - energy(x - d)) / (2.0 * step) for d in step * np.eye(3 * n).reshape(3 * n, n, 3)]
    energy(x)
    system.apply_forces()
    if force == "kelvin":
        expected = -np.reshape(gradient, (n, 3))
        tolerance = 1e-5  # of differences of an energy over 2e-7 m
    else:
        steel = steel_oracle("M-19")
        h = system.h.numpy()
        m, derivative = oracle.magnetization(h, steel["saturation"], steel["susceptibility"], steel["curve"])
        volume = 4.0 / 3.0 * np.pi * 0.005**3
        gradients = oracle.field_gradient(x, volume * m, radii=np.full(n, 0.005))
        expected = oracle.zeeman_force(np.full(n, volume), h, gradients, m, derivative)
        tolerance = 1e-9
    error = np.linalg.norm(system.forces.numpy() - expected) / np.linalg.norm(expected)
    assert error < tolerance


def test_the_default_curve_is_low_at_the_knee_of_steel(device):
    """Balls of 1010 steel in fields that bring them to the points of the table: its curve against the default."""
    h, b = points_of("1010-steel")
    knee = (h > 2e3) & (h < 6e4)
    m = (b / MU0 - h)[knee]
    applied = np.outer(h[knee] + m / 3.0, [0.0, 0.0, 1.0])

    def magnetized(**magnet):
        system = moment_system(
            radii=np.full(len(m), 0.01), worlds=np.arange(len(m)), external_field=applied, device=device, **magnet
        )
        system.solve()
        return system.magnetizations().numpy()[:, 2]

    # rounding of float32
    np.testing.assert_allclose(magnetized(curve=MATERIALS["1010-steel"].curve), m, rtol=1e-6)
    low = 1.0 - magnetized(saturation=MATERIALS["1010-steel"].saturation) / m
    assert 0.15 < low.max() < 0.23


GOOD = [0.0, 100.0, 1e3, 1e4, 1e5], [0.0, 0.5, 1.3, 1.7, 2.0]


@pytest.mark.parametrize(
    "h,b,message",
    [
        ([0, 1e3, 500.0, 1e4], [0, 1.0, 1.2, 1.6], "H must rise from 0, but 500 A/m follows 1000 A/m"),
        ([0, 1e3, 1e3], [0, 1.0, 1.2], "H must rise"),
        ([-1e3, 0, 1e3], [-1.0, 0.0, 1.2], "H must rise"),
        ([0, 1e3, 1e4], [0, math.nan, 1.2], "flux densities must be finite, got nan at point 2"),
        ([0, math.inf, 1e4], [0, 1.0, 1.2], "fields must be finite, got inf at point 2"),
        ([0.0], [0.0], "a curve has 2 to 4096 points, got 1"),
        ([], [], "fields must be real numbers|a curve has 2"),
        ([0, 1e3], [0, 1.0, 2.0], "2 fields, but 3 values"),
        ([0, 1e3, 1e4], [0, 1.5, 1.2], "M = B/μ0 − H must not fall, but from H = 1000 to 10000 A/m it does"),
        ([0, 1e3, 1e5], [0, 1.5, 1.55], "must not fall"),
        ([0, 1e3, 1e4], [0, 1.5e4, 1.7e4], "polarization B − μ0 H is 1.7e.04 T, which no material reaches"),
        (np.array(GOOD[0]) * 1e3, GOOD[1], "must not fall"),  # kA/m said to be A/m, and the other way round
        ([0, 1.0, 10.0, 318.0], [0, 1.3, 1.9, 2.56], "polarization B − μ0 H is 2.56 T"),
        ([0, 1e3, 1.1e3], [0, 1.5, 1.9], "it would saturate at 5.9 T"),
        ([0, 1e3, 1e4], [0.1, 1.5, 1.7], "at H = 0 there is M"),
        ([0, 1e3, 1e4], [0, 1e3 * MU0, 1.7], "M must rise from the origin"),
        (["a", "b"], [0, 1.0], "fields must be real numbers"),
        ([[0, 1e3]], [[0, 1.0]], "fields must be a list of numbers"),
    ],
)
def test_bad_tables_are_refused(h, b, message):
    with pytest.raises(InputError, match=f"^plate: .*({message})"):
        MagnetizationCurve.from_bh(h, b, name="plate")


@pytest.mark.parametrize(
    "saturation,message",
    [
        (1e5, "less than the last point's M"),
        (math.nan, "finite number"),
        (1e7, "saturate at 12.6 T"),
        ("1", "one real number"),
    ],
)
def test_bad_saturations_are_refused(saturation, message):
    with pytest.raises(InputError, match=message):
        MagnetizationCurve.from_bh(*GOOD, saturation=saturation)


def test_units_and_quantities_of_a_file(tmp_path):
    h, b = (np.array(values) for values in GOOD)
    files = {
        "H [A/m], B [T]": (h, b),
        "H [kA/m], B [mT]": (h / 1e3, b * 1e3),
        "h (Oe), b (kG)": (h * 4e-3 * math.pi, b * 10.0),
        "H [A/m],J [T]": (h, b - MU0 * h),
        "H [A/m],M [kA/m]": (h, (b / MU0 - h) / 1e3),
    }
    expected = MagnetizationCurve.from_bh(h, b)
    for number, (header, columns) in enumerate(files.items()):
        path = tmp_path / f"{number}.csv"
        rows = "\n".join(f"{x!r}, {y!r}" for x, y in np.array(columns).T.tolist())
        path.write_text(f"# a plate\n{header}\n{rows}\n", encoding="utf-8")
        read = MagnetizationCurve.from_csv(path)
        np.testing.assert_allclose(read.fields, expected.fields, rtol=1e-12)
        np.testing.assert_allclose(read.magnetizations, expected.magnetizations, rtol=1e-9, atol=1e-6)


@pytest.mark.parametrize(
    "text,message",
    [
        ("0,0\n1000,1.2\n", "the first line must name the two columns"),
        ("H [A/m], B [furlong]\n0,0\n", "unknown unit furlong of B; known are T, mT, G, kG"),
        ("B [T], H [A/m]\n0,0\n", "the first column must be H"),
        ("H [A/m], B [T]\n0,0\n1000,x\n", "not a number"),
        ("H [A/m], B [T]\n0,0\n1000,1.2,3\n", "not a number|two numbers"),
        ("H [A/m], B [T]\n", "two numbers"),
        ("", "the first line"),
    ],
)
def test_bad_files_are_refused_by_name(tmp_path, text, message):
    path = tmp_path / "steel.csv"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=f"^steel.csv: .*({message})"):
        MagnetizationCurve.from_csv(path)
    with pytest.raises(InputError, match=r"^none.csv: cannot be read"):
        MagnetizationCurve.from_csv(tmp_path / "none.csv")
    os.mkfifo(tmp_path / "pipe.csv")
    with pytest.raises(InputError, match=r"^pipe.csv: cannot be read \(not a regular file\)"):
        MagnetizationCurve.from_csv(tmp_path / "pipe.csv")


@pytest.mark.parametrize(
    "given,message",
    [
        ({"curve": "M-19", "saturation": 1e6}, "saturation: a measured curve has its own"),
        ({"curve": "M-19", "susceptibility": 10.0}, "susceptibility: a measured curve has its own"),
        ({"curve": "tanh"}, "saturation: must be given"),
        ({"curve": "M-20", "saturation": 1e6}, "curve: 'M-20' is not one of tanh, .*M-19"),
        ({"curve": ["tanh", "M-19"]}, "saturation: must be given"),
    ],
)
def test_arguments_that_contradict(given, message, device):
    with pytest.raises(InputError, match=message):
        warpmag.solve_induction([[0, 0, 0], [1, 0, 0]], 0.01, device=device, **given)


def builder_with(**magnet):
    builder = newton.ModelBuilder()
    warpmag.register_attributes(builder)
    for k in range(2):
        body = builder.add_body(xform=wp.transform((0.011 * k, 0.0, 0.0), wp.quat_identity()))
        builder.add_shape_sphere(body, radius=0.005)
        warpmag.add_inducible(builder, body=body, **(magnet if k else {}))
    return builder


@pytest.mark.parametrize("how", ["material", "name", "curve"])
def test_two_curves_in_one_model(how, device):
    own = MagnetizationCurve.from_bh(*GOOD, name="mine")
    given = {"material": {"material": "M-19"}, "name": {"curve": "M-19"}, "curve": {"curve": own}}[how]
    builder = newton.ModelBuilder()
    warpmag.register_attributes(builder)
    builder.add_builder(builder_with(**given))  # curves survive copies
    model = builder.finalize(device=device)
    curve = own if how == "curve" else MATERIALS["M-19"].curve
    assert [magnet.curve for magnet in marked_shapes(model).values()] == ["tanh", curve]
    magnetics = warpmag.Magnetics(model, external_field=(0.0, 0.0, 4e5))
    state = model.state()
    magnetics.apply(state)
    magnetizations = magnetics.system.magnetizations().numpy()
    expected = warpmag.solve_induction(
        [[0.0, 0, 0], [0.011, 0, 0]], 0.005, curve=["tanh", curve], saturation=[1.7e6, 1.0],
        external_field=(0.0, 0.0, 4e5), device=device,
    )  # fmt: skip
    np.testing.assert_allclose(magnetizations, expected.magnetizations, rtol=2e-3)  # each within rtol


@pytest.mark.parametrize(
    "magnet,message",
    [
        ({"material": "M-19", "saturation": 1e6}, "material: 'M-19' sets saturation"),
        ({"material": "M-19", "curve": "tanh"}, "material: 'M-19' sets curve"),
        ({"material": "iron", "curve": "M-19"}, "material: 'iron' sets curve"),
        ({"curve": "M-19", "susceptibility": 9.0}, "curve: a measured curve sets susceptibility"),
        ({"curve": "M-18"}, "curve: 'M-18' is not one of"),
    ],
)
def test_bodies_that_contradict(magnet, message):
    with pytest.raises(InputError, match=message):
        builder_with(**magnet)


def test_a_changed_number_does_not_bend_a_measured_curve(device):
    """A change of saturation beside a measured curve raises an error that names it."""
    model = builder_with(material="M-19").finalize(device=device)
    magnetics = warpmag.Magnetics(model, external_field=(0.0, 0.0, 4e5))
    saturation = model.warpmag.saturation.numpy()
    saturation[1] *= 0.5
    model.warpmag.saturation.assign(saturation)
    with pytest.raises(InputError, match="saturation was changed, but a measured curve determines it"):
        magnetics.notify_model_changed()
