"""``warpmag.torch``: values are those of the calls on arrays, and gradients pass ``torch.autograd.gradcheck``."""

import numpy as np
import pytest
import warp as wp
from wrong_calls import WRONG

torch = pytest.importorskip("torch", reason="PyTorch is not installed")

import warpmag  # noqa: E402
import warpmag.torch  # noqa: E402


def tensors(device, *shapes, scale=1.0):
    rng = np.random.default_rng(11)
    torch_device = "cpu" if device == "emulated" else device
    return [
        torch.tensor(scale * rng.normal(size=shape), dtype=torch.float64, device=torch_device, requires_grad=True)
        for shape in shapes
    ]


def gradcheck(function, arguments):
    return torch.autograd.gradcheck(function, arguments, eps=1e-5, rtol=1e-5, atol=1e-9, fast_mode=False)


def test_field(device):
    x, m, targets = tensors(device, (4, 3), (4, 3), (3, 3))
    field = warpmag.torch.h_field(x, m, targets, radii=0.1)
    expected = warpmag.h_field(
        x.detach().cpu().numpy(), m.detach().cpu().numpy(), targets.detach().cpu().numpy(), dtype="float64"
    )
    assert np.allclose(field.detach().cpu().numpy(), expected, rtol=1e-12, atol=0.0)
    assert gradcheck(warpmag.torch.h_field, (x, m, targets))


def test_wrench(device):
    x, m, field = tensors(device, (4, 3), (4, 3), (1, 3))

    def scaled(x, m, field):  # newtons would be too small for the absolute tolerance
        forces, torques = warpmag.torch.wrench(x, m, external_field=field[0])
        return 1e6 * forces, 1e6 * torques

    assert gradcheck(scaled, (x, m, field))


def test_equilibrium(device):
    (noise, field, dipoles, dipole_moments) = tensors(device, (4, 3), (1, 3), (2, 3), (2, 3), scale=0.1)
    lattice = torch.tensor(np.stack(np.meshgrid([0, 1], [0, 1], [0]), -1).reshape(-1, 3)).to(noise)
    radii = torch.tensor([0.3, 0.25, 0.3, 0.35], dtype=torch.float64, device=noise.device, requires_grad=True)
    saturation, susceptibility = (
        torch.tensor(v, dtype=torch.float64, device=noise.device, requires_grad=True) for v in (2.0, 30.0)
    )

    def solve(noise, radii, saturation, susceptibility, field, dipoles, dipole_moments):
        result = warpmag.torch.solve_induction(
            lattice + noise, radii, saturation=saturation, susceptibility=susceptibility, rtol=1e-12,
            external_field=20.0 * field[0], permanent=(dipoles + 2.0, dipole_moments),
        )  # fmt: skip
        return result.magnetizations, result.h_field, 1e6 * result.wrench()[0]

    arguments = (noise, radii, saturation, susceptibility, field, dipoles, dipole_moments)
    assert gradcheck(solve, arguments)
    result = warpmag.solve_induction(
        (lattice + noise).detach().cpu().numpy(), radii.detach().cpu().numpy(), saturation=2.0, susceptibility=30.0,
        external_field=20.0 * field[0].detach().cpu().numpy(), rtol=1e-12, dtype="float64",
        permanent=((dipoles + 2.0).detach().cpu().numpy(), dipole_moments.detach().cpu().numpy()),
    )  # fmt: skip
    for value, expected in zip(
        solve(*arguments), (result.magnetizations, result.h_field, 1e6 * result.wrench()[0]), strict=True
    ):
        assert np.allclose(value.detach().cpu().numpy(), expected, rtol=1e-9, atol=1e-9)


def test_measured_curves_and_precision(device):
    x = torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.0, 0.012]], requires_grad=True)
    result = warpmag.torch.solve_induction(x, 0.005, curve="1010-steel", external_field=(0.0, 0.0, 1e5))
    assert result.magnetizations.dtype == torch.float32 and result.converged
    result.wrench()[0][0, 2].backward()
    assert x.grad[1, 2] < 0.0  # the attraction decreases with the distance


def test_points_of_a_curve(device):
    x, points = tensors(device, (2, 3), (2, 3))
    offset = torch.tensor([[0.5, 1.0, 3.0], [2.0, 4.0, 5.0]], dtype=x.dtype, device=x.device)

    def solve(points):
        fields, magnetizations = offset + 0.1 * points
        return warpmag.torch.solve_induction(
            x.detach() + torch.arange(2.0, device=x.device)[:, None], 0.2, curve_points=(fields, magnetizations),
            external_field=(0.0, 0.0, 3.0), rtol=1e-12,
        ).magnetizations  # fmt: skip

    assert gradcheck(solve, (points,))


def test_what_has_no_gradient_raises(device):
    x, m = tensors(device, (3, 3), (3, 3))
    radii = torch.full((3,), 0.1, dtype=torch.float64, requires_grad=True)
    with pytest.raises(warpmag.InputError, match="radii: requires a gradient"):
        warpmag.torch.h_field(x, m, radii=radii)
    with pytest.raises(warpmag.InputError, match="positions: must be a tensor"):
        warpmag.torch.h_field(x.detach().half(), m)


@pytest.mark.parametrize("case", WRONG)
def test_wrong_arguments_are_one_line(case, device):
    call, message = WRONG[case]
    x, m = tensors(device, (3, 3), (3, 3))
    with pytest.raises(warpmag.InputError, match=f"^{message}$"):
        call(warpmag.torch.h_field, x, m)


def test_no_places_at_all(device):
    """Tensors of no vectors have other strides than arrays where NumPy made them."""
    x, m = tensors(device, (3, 3), (3, 3))
    nowhere = torch.tensor(np.zeros((0, 3)), device=x.device, requires_grad=True)
    assert nowhere.stride() == (0, 0)
    warpmag.torch.h_field(x, m, nowhere).sum().backward()
    assert x.grad.eq(0.0).all() and m.grad.eq(0.0).all()
    warpmag.torch.wrench(nowhere, nowhere)[0].sum().backward()


def test_on_a_tape_of_warp(device):
    """Warp's active tape neither records the call nor gets in its way."""
    x, m = tensors(device, (4, 3), (4, 3))
    expected, _ = warpmag.torch.wrench(x, m)
    with wp.Tape() as tape:
        force, _ = warpmag.torch.wrench(x, m)
        (gradient,) = torch.autograd.grad(force[0, 0], x)
    assert torch.equal(force, expected) and torch.isfinite(gradient).all()
    assert not tape.launches
