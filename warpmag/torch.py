"""Calls on arrays for PyTorch: ``h_field``, ``wrench`` and ``solve_induction`` of tensors, with gradients.

The functions are those of ``warpmag`` with tensors in place of arrays. Device and type are those of ``positions``,
``float32`` or ``float64``; other tensors are converted. Kernels read and write the tensors' memory on the current
stream. Each call records its gradient (``docs/howto/gradients.md``). There are no second derivatives.

Example:
    >>> import torch
    >>> import warpmag.torch
    >>> positions = torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.0, 0.1]], requires_grad=True)
    >>> moments = torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, 1.0]])
    >>> forces, _ = warpmag.torch.wrench(positions, moments)
    >>> forces[0, 2].backward()
    >>> round(float(positions.grad[0, 2]), 2)  # the attraction of aligned moments grows by 4 F/r
    0.24
"""

# pyright: reportAttributeAccessIssue=false
# pyright takes ``import torch`` and ``import jax`` here for the modules of these names in this folder

import math
from contextlib import nullcontext
from dataclasses import dataclass

import torch  # pyright: ignore[reportMissingImports]
import warp as wp

from warpmag.errors import InputError
from warpmag.moments import fields, induction
from warpmag.moments.arrays import real_array, shape_message
from warpmag.moments.induction import permanent_dipoles
from warpmag.moments.tape import paused_tape

_DTYPES = {torch.float32: ("float32", wp.float32, wp.vec3), torch.float64: ("float64", wp.float64, wp.vec3d)}
"""By type of tensors: type of a call, and Warp's types of scalars and vectors."""


def h_field(positions, moments, targets=None, *, radii=None, target_radii=None, method="auto", rtol=None):
    """Return the field H [A/m] of moments, shape [t, 3]; see :func:`warpmag.h_field`.

    Has gradients with respect to ``positions``, ``moments`` and ``targets``.
    """
    tensors = {"positions": positions, "moments": moments, "targets": targets}
    tensors |= {"radii": radii, "target_radii": target_radii}

    def call(dtype, **arrays):
        return [fields.h_field(method=method, rtol=rtol, dtype=dtype, **arrays)]

    (field,) = _recorded(call, tensors, {"target_radii": "targets"}, "moments")
    return field


def wrench(positions, moments, *, radii=None, external_field=None, method="auto", rtol=None):
    """Return forces [N] and torques [N·m], shape [n, 3] each; see :func:`warpmag.wrench`.

    Has gradients with respect to ``positions``, ``moments`` and ``external_field``.
    """
    tensors = {"positions": positions, "moments": moments, "radii": radii, "external_field": external_field}

    def call(dtype, **arrays):
        return fields.wrench(method=method, rtol=rtol, dtype=dtype, **arrays)

    return _recorded(call, tensors, {}, "moments")


@dataclass(frozen=True)
class InductionTensors:
    """Magnetic equilibrium of n balls, returned by :func:`solve_induction`.

    Attributes:
        magnetizations: M [A/m], shape [n, 3].
        h_field: Field H at the balls [A/m], without the ball's own, shape [n, 3].
        error, evaluations, converged: As in :class:`warpmag.InductionResult`.
    """

    magnetizations: torch.Tensor
    h_field: torch.Tensor
    error: float
    evaluations: int
    converged: bool
    _inputs: dict

    def wrench(self):
        """Return forces [N] and torques [N·m] on the balls by Kelvin's law, shape [n, 3] each."""
        x, count = self._inputs["positions"], len(self.magnetizations)
        radii = _filled("radii", self._inputs["radii"], x, count)
        moments = (4.0 / 3.0 * math.pi) * radii[:, None] ** 3 * self.magnetizations
        external_field = _filled("external_field", self._inputs["external_field"], x, count)
        dipoles = [torch.as_tensor(part, dtype=x.dtype, device=x.device) for part in self._inputs["permanent"]]
        forces, torques = wrench(
            torch.cat([x, dipoles[0]]),
            torch.cat([moments, dipoles[1]]),
            radii=torch.cat([radii.detach(), x.new_zeros(len(dipoles[0]))]),
            external_field=torch.cat([external_field, torch.zeros_like(dipoles[0])]),
        )
        return forces[:count], torques[:count]


def solve_induction(
    positions, radii, *, saturation=None, susceptibility=math.inf, curve="tanh", curve_points=None,
    external_field=None, permanent=None, method="auto", rtol=1e-3, max_evaluations=1000, initial=None,
) -> InductionTensors:  # fmt: skip
    """Return the magnetic equilibrium of inducible balls; see :func:`warpmag.solve_induction`.

    Has gradients with respect to all arguments that are numbers, except ``initial``, ``rtol`` and ``max_evaluations``.
    They have a relative error of about ``rtol``.
    """
    dipoles, dipole_moments = permanent_dipoles(permanent)
    tensors = {"positions": positions, "radii": radii, "saturation": saturation, "susceptibility": susceptibility}
    tensors |= {"external_field": external_field, "dipoles": dipoles, "dipole_moments": dipole_moments}
    if saturation is None:  # of measured curves
        del tensors["susceptibility"]
    tensors["curve_fields"], tensors["curve_magnetizations"] = induction.pair_of("curve_points", curve_points)
    solved = []

    def call(dtype, dipoles, dipole_moments, curve_fields=None, curve_magnetizations=None, **arrays):
        points = None if curve_fields is None else (curve_fields, curve_magnetizations)
        result = induction.solve_induction(
            permanent=(dipoles, dipole_moments), curve=curve, curve_points=points, method=method, rtol=rtol,
            max_evaluations=max_evaluations, initial=initial, dtype=dtype, **arrays,
        )  # fmt: skip
        solved.append(result)
        return [result.magnetizations, result.h_field]

    owners = {"dipole_moments": "dipoles", "curve_magnetizations": "curve_fields"}
    m, h = _recorded(call, tensors, owners, "radii")
    inputs = {
        "positions": positions,
        "radii": radii,
        "external_field": external_field,
        "permanent": (dipoles, dipole_moments),
    }
    return InductionTensors(m, h, solved[0].error, solved[0].evaluations, solved[0].converged, inputs)


_SCALARS = ("radii", "target_radii", "saturation", "susceptibility", "curve_fields", "curve_magnetizations")
"""Arguments of one number for each ball or point of a curve; the others are vectors."""
_PLACES = ("positions", "targets", "dipoles", "curve_fields")
"""Arguments whose number of entries other arguments follow."""


def _filled(name: str, value, like, count: int | None):
    """Return a tensor of ``count`` numbers or vectors, or of one for all, of the type and device of ``like``.

    A value of another shape, or of no real numbers, raises :class:`InputError`; None for ``count`` takes any number.
    """
    if not isinstance(value, torch.Tensor):
        value = torch.tensor(real_array(name, 0.0 if value is None else value).copy())
    if value.dtype is torch.bool or value.is_complex():
        raise InputError(f"{name}: must be real numbers, got {value.dtype}")
    tensor = value.to(device=like.device, dtype=like.dtype)
    ndim = 1 if name in _SCALARS else 2
    if count is not None and (tensor.ndim == 0 or tuple(tensor.shape) == (3,)[: ndim - 1]):
        tensor = tensor.expand(*(count, 3)[:ndim])
    if tensor.ndim != ndim or tuple(tensor.shape) != ((len(tensor) if count is None else count), 3)[:ndim]:
        expected = f"[{'n' if count is None else count}{', 3' * (ndim - 1)}]"
        raise InputError(shape_message(name, expected, tensor))
    return tensor


def _contiguous(tensor: torch.Tensor) -> torch.Tensor:
    """Return a contiguous tensor; Warp requires the usual strides of an empty one, too, which may have others."""
    return tensor.contiguous() if tensor.numel() else tensor.new_empty(tensor.shape)


def _recorded(call, tensors: dict, owners: dict[str, str], needed: str):
    """Return the results of a call on tensors by name, with gradients.

    ``owners`` names the positions that an argument belongs to, if they are not ``positions``. The argument ``needed``
    must not be None.
    """
    positions = tensors["positions"]
    if not isinstance(positions, torch.Tensor) or positions.dtype not in _DTYPES:
        raise InputError("positions: must be a tensor of float32 or float64")
    if tensors[needed] is None:
        raise InputError(f"{needed}: must be real numbers, got None")
    given = {name: value for name, value in tensors.items() if value is not None}
    for name in given:
        owner = owners.get(name, "positions")
        if owner not in given:
            raise InputError(f"{name}: only with {owner}")
        given[name] = _filled(name, given[name], positions, None if name in _PLACES else len(given[owner]))
    return _Call.apply(call, tuple(given), *given.values())


class _Call(torch.autograd.Function):
    """A call on Warp arrays that records its gradient on a tape of its own, also while another tape is active."""

    @staticmethod
    def forward(ctx, call, names, *tensors):
        """Return the results as tensors that share the memory of the call's results."""
        dtype, scalar, vector = _DTYPES[tensors[0].dtype]
        needed = ctx.needs_input_grad[2:]
        with _stream(tensors[0]), paused_tape(), wp.Tape() as ctx.tape:
            ctx.arrays = [
                wp.from_torch(_contiguous(tensor.detach()), scalar if name in _SCALARS else vector, requires_grad=grad)
                for name, tensor, grad in zip(names, tensors, needed, strict=True)
            ]
            ctx.results = call(dtype, **dict(zip(names, ctx.arrays, strict=True)))
        return tuple(wp.to_torch(result, requires_grad=False) for result in ctx.results)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, *cotangents):
        """Return the gradients of the tensors that require one."""
        with _stream(cotangents[0]), paused_tape():
            leaves = [array if array.requires_grad and array.size else None for array in ctx.arrays]
            for array in leaves:
                if array is not None:
                    array.grad.zero_()
            for result, cotangent in zip(ctx.results, cotangents, strict=True):
                if result.size:  # an array without entries has no gradient
                    wp.copy(result.grad, wp.from_torch(_contiguous(cotangent), result.dtype))
            ctx.tape.backward()
        gradients = [None if array is None else wp.to_torch(array.grad).clone() for array in leaves]
        return None, None, *gradients


def _stream(tensor: torch.Tensor):
    """Return a context in which Warp launches on PyTorch's current stream of a tensor's device."""
    if not tensor.is_cuda:
        return nullcontext()
    return wp.ScopedStream(wp.stream_from_torch(torch.cuda.current_stream(tensor.device)))
