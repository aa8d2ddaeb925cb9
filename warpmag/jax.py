"""Calls on arrays for JAX: ``h_field``, ``wrench`` and ``solve_induction`` of JAX arrays, with gradients.

The functions are those of ``warpmag`` with JAX arrays in place of arrays. The type is that of ``positions``,
``float32`` or ``float64``; other arrays are converted. The functions may be part of ``jax.jit``, ``jax.grad`` and
``jax.vmap``. Kernels read and write the memory of JAX's arrays on JAX's stream (``wp.jax_callable``). With ``device``,
the Warp device that computes, arrays are copied through the host (``jax.pure_callback``). Gradients
(``docs/howto/gradients.md``) are of reverse mode; there are no second derivatives.

Example:
    >>> import jax
    >>> import jax.numpy as jnp
    >>> import warpmag.jax
    >>> moments = jnp.array([[0.0, 0.0, 1.0], [0.0, 0.0, 1.0]])
    >>> def force(distance):
    ...     positions = jnp.array([[0.0, 0.0, 0.0], [0.0, 0.0, 1.0]]) * distance
    ...     return warpmag.jax.wrench(positions, moments)[0][0, 2]
    >>> round(float(jax.grad(force)(0.1)), 2)  # the attraction of aligned moments falls by 4 F/r
    -0.24
"""

# pyright: reportAttributeAccessIssue=false
# pyright takes ``import torch`` and ``import jax`` here for the modules of these names in this folder

import inspect
import math
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any

import jax  # pyright: ignore[reportMissingImports]
import jax.numpy as jnp  # pyright: ignore[reportMissingImports]
import numpy as np
import warp as wp
from jax.custom_derivatives import SymbolicZero  # pyright: ignore[reportMissingImports]

from warpmag.declarations.checks import short_repr
from warpmag.errors import InputError
from warpmag.moments import fields, induction
from warpmag.moments.arrays import DTYPES, dtype_name, real_array, resolve_device, shape_message, vec3_type
from warpmag.moments.tape import paused_tape

_POSITIONAL = inspect.Parameter.POSITIONAL_OR_KEYWORD
_SCALARS = ("radii", "target_radii", "saturation", "susceptibility", "curve_fields", "curve_magnetizations")
"""Arguments of one number for each ball or point of a curve; the others are vectors."""
_PLACES = ("positions", "targets", "dipoles", "curve_fields")
"""Arguments whose number of entries other arguments follow."""


def h_field(positions, moments, targets=None, *, radii=None, target_radii=None, method="auto", rtol=None, device=None):
    """Return the field H [A/m] of moments, shape [t, 3]; see :func:`warpmag.h_field`.

    Has gradients with respect to ``positions``, ``moments`` and ``targets``. Computes on the arrays' device, or
    on ``device``.
    """
    arrays = {"positions": positions, "moments": moments, "targets": targets}
    arrays |= {"radii": radii, "target_radii": target_radii}
    call = _call("h_field", {"method": method, "rtol": rtol}, device)
    (field,) = _differentiable(call, _read(arrays, {"target_radii": "targets"}, "moments"))
    return field


def wrench(positions, moments, *, radii=None, external_field=None, method="auto", rtol=None, device=None):
    """Return forces [N] and torques [N·m], shape [n, 3] each; see :func:`warpmag.wrench`.

    Has gradients with respect to ``positions``, ``moments`` and ``external_field``. Computes on the arrays' device,
    or on ``device``.
    """
    arrays = {"positions": positions, "moments": moments, "radii": radii, "external_field": external_field}
    call = _call("wrench", {"method": method, "rtol": rtol}, device)
    return _differentiable(call, _read(arrays, {}, "moments"))


@partial(
    jax.tree_util.register_dataclass, data_fields=["magnetizations", "h_field", "_arrays"], meta_fields=["_device"]
)
@dataclass(frozen=True)
class InductionArrays:
    """Magnetic equilibrium of n balls, returned by :func:`solve_induction`; a tree of JAX.

    Attributes:
        magnetizations: M [A/m], shape [n, 3].
        h_field: Field H at the balls [A/m], without the ball's own, shape [n, 3].
    """

    magnetizations: Any
    h_field: Any
    _arrays: dict
    _device: Any

    def wrench(self):
        """Return forces [N] and torques [N·m] on the balls by Kelvin's law, shape [n, 3] each."""
        arrays, count = self._arrays, len(self.magnetizations)
        radii, dipoles = arrays["radii"], arrays["dipoles"]
        moments = (4.0 / 3.0 * math.pi) * radii[:, None] ** 3 * self.magnetizations
        field = arrays.get("external_field", jnp.zeros_like(moments))
        forces, torques = wrench(
            jnp.concatenate([arrays["positions"], dipoles]),
            jnp.concatenate([moments, arrays["dipole_moments"]]),
            radii=jnp.concatenate([jax.lax.stop_gradient(radii), jnp.zeros_like(dipoles[:, 0])]),
            external_field=jnp.concatenate([field, jnp.zeros_like(dipoles)]),
            device=self._device,
        )
        return forces[:count], torques[:count]


def solve_induction(
    positions, radii, *, saturation=None, susceptibility=math.inf, curve="tanh", curve_points=None,
    external_field=None, permanent=None, method="auto", rtol=1e-3, max_evaluations=1000, device=None,
) -> InductionArrays:  # fmt: skip
    """Return the magnetic equilibrium of inducible balls; see :func:`warpmag.solve_induction`.

    Has gradients with respect to all arrays, with a relative error of about ``rtol``. Computes on the arrays' device,
    or on ``device``.
    """
    dipoles, dipole_moments = induction.permanent_dipoles(permanent)
    arrays = {"positions": positions, "radii": radii, "saturation": saturation, "susceptibility": susceptibility}
    arrays |= {"external_field": external_field, "dipoles": dipoles, "dipole_moments": dipole_moments}
    if saturation is None:  # of measured curves
        del arrays["susceptibility"]
    arrays["curve_fields"], arrays["curve_magnetizations"] = induction.pair_of("curve_points", curve_points)
    arrays = _read(arrays, {"dipole_moments": "dipoles", "curve_magnetizations": "curve_fields"}, "radii")
    curve = tuple(curve) if isinstance(curve, list) else curve
    options = {"curve": curve, "method": method, "rtol": rtol, "max_evaluations": max_evaluations}
    m, h = _differentiable(_call("solve_induction", options, device), arrays)
    return InductionArrays(m, h, arrays, device)


def _read(arrays: dict, owners: dict[str, str], needed: str) -> dict:
    """Return the given arrays with all their dimensions, of the type of ``positions``.

    ``owners`` names the positions that an argument belongs to, if they are not ``positions``. The arguments
    ``positions`` and ``needed`` must not be None.
    """
    required = "positions", needed
    given = {name: _real(name, value) for name, value in arrays.items() if value is not None or name in required}
    dtype = given["positions"].dtype
    if dtype not in (jnp.float32, jnp.float64):
        raise InputError(f"positions: must be float32 or float64, got {dtype}")
    for name, value in given.items():
        owner = owners.get(name, "positions")
        if owner not in given:
            raise InputError(f"{name}: only with {owner}")
        given[name] = _expanded(name, value.astype(dtype), None if name in _PLACES else len(given[owner]))
    return given


def _real(name: str, value) -> Any:
    """Return an array of JAX; raise :class:`InputError` unless it has real numbers."""
    if not isinstance(value, jax.Array):
        value = jnp.asarray(real_array(name, value, single=True))
    if value.dtype == bool or jnp.iscomplexobj(value):
        raise InputError(f"{name}: must be real numbers, got {value.dtype}")
    return value


def _expanded(name: str, value, count: int | None):
    """Return ``count`` numbers or vectors, or those of one for all; None for ``count`` takes any number.

    An array of another shape raises :class:`InputError`.
    """
    ndim = 1 if name in _SCALARS else 2
    if count is not None and value.shape in ((), (3,)[: ndim - 1]):
        value = jnp.broadcast_to(value, (count, 3)[:ndim])
    if value.ndim != ndim or value.shape != ((len(value) if count is None else count), 3)[:ndim]:
        expected = f"[{'n' if count is None else count}{', 3' * (ndim - 1)}]"
        raise InputError(shape_message(name, expected, value))
    return value


@dataclass(frozen=True)
class _Call:
    """A call on arrays by the name of its function, with options that are no arrays."""

    function: str
    options: tuple
    device: Any

    def results(self, arrays: dict[str, wp.array], **more) -> list[wp.array]:
        """Return the results of Warp arrays."""
        dtype = dtype_name(arrays["positions"].dtype._wp_scalar_type_)
        options = {**dict(self.options), **more, "dtype": dtype}
        if self.function == "h_field":
            return [fields.h_field(**arrays, **options)]
        if self.function == "wrench":
            return list(fields.wrench(**arrays, **options))
        arrays = dict(arrays)
        permanent = [arrays.pop(name, np.zeros((0, 3))) for name in ("dipoles", "dipole_moments")]
        if "curve_fields" in arrays:
            options["curve_points"] = arrays.pop("curve_fields"), arrays.pop("curve_magnetizations")
        result = induction.solve_induction(permanent=permanent, **arrays, **options)
        return [result.magnetizations, result.h_field]

    def gradients(self, arrays: dict[str, wp.array], needed: tuple[str, ...]) -> list:
        """Return the gradients by the arrays that ``needed`` names; ``_backward`` has the other arrays."""
        more = {"initial": arrays.pop("result_0")} if self.function == "solve_induction" else {}
        cotangents = [arrays.pop(name) for name in ("cotangent_0", "cotangent_1") if name in arrays]
        for name in needed:
            arrays[name].requires_grad = True
        with wp.Tape() as tape:
            results = self.results(arrays, **more)
        for result, cotangent in zip(results, cotangents, strict=True):
            wp.copy(result.grad, cotangent)
        tape.backward()
        return [arrays[name].grad for name in needed]

    def run(self, needed: tuple[str, ...] | None, arrays: dict[str, wp.array]) -> list[wp.array]:
        """Return gradients by ``needed``, or results if that is None."""
        with paused_tape():
            return self.results(arrays) if needed is None else self.gradients(arrays, needed)

    def launch(self, needed: tuple[str, ...] | None, arrays: dict, counts: dict[str, int]) -> list:
        """Return the JAX arrays of :meth:`run`; ``counts`` are their lengths by name."""
        dtype = arrays["positions"].dtype
        shapes = [jax.ShapeDtypeStruct((n, 3)[: 1 if name in _SCALARS else 2], dtype) for name, n in counts.items()]
        if not all(len(array) for array in arrays.values()):
            return [jnp.zeros(shape.shape, dtype) for shape in shapes]
        if self.device is None:
            shared = _shared_function(self, needed, tuple(arrays), tuple(counts), dtype.name)
            results = shared(*arrays.values(), output_dims={f"{name}_out": n for name, n in counts.items()})
            return list(results)

        def through_host(values):
            inputs = {
                name: wp.array(np.asarray(value), dtype=_kind(name, dtype.name), device=self.device, copy=False)
                for name, value in values.items()
            }
            return [result.numpy() for result in self.run(needed, inputs)]

        return jax.pure_callback(through_host, shapes, arrays, vmap_method="sequential")


def _call(function: str, options: dict, device) -> _Call:
    """Return a call; a device or an option that JAX cannot compare raises :class:`InputError`."""
    for name, value in options.items():
        try:
            hash(value)
        except TypeError:
            raise InputError(f"{name}: must be a number or a name, got {short_repr(value)}") from None
    return _Call(function, tuple(options.items()), None if device is None else resolve_device(device))


def _kind(name: str, dtype: str) -> type:
    """Return the Warp type of the entries of an array by its name: numbers or vectors."""
    return DTYPES[dtype] if name in _SCALARS else vec3_type(DTYPES[dtype])


@lru_cache(maxsize=256)
def _shared_function(call: _Call, needed, inputs: tuple[str, ...], outputs: tuple[str, ...], dtype: str):
    """Return a function of JAX arrays that makes a call on Warp arrays of their memory."""

    def run(*arrays):
        results = call.run(needed, dict(zip(inputs, arrays, strict=False)))
        for result, out in zip(results, arrays[len(inputs) :], strict=True):
            wp.copy(out, result)

    kinds = {name: _kind(name, dtype) for name in inputs} | {f"{name}_out": _kind(name, dtype) for name in outputs}
    run.__annotations__ = {name: wp.array(dtype=kind) for name, kind in kinds.items()}
    run.__signature__ = inspect.Signature([inspect.Parameter(name, _POSITIONAL) for name in kinds])
    # calls check values on the host, which no graph can capture
    mode = wp.JaxCallableGraphMode.NONE
    return wp.jax_callable(run, num_outputs=len(outputs), graph_mode=mode, vmap_method="sequential")


def _filled(arrays: dict) -> dict:
    """Return the arrays with entries, such as no permanent dipoles where there are none."""
    return {name: array for name, array in arrays.items() if len(array) or name not in ("dipoles", "dipole_moments")}


@partial(jax.custom_vjp, nondiff_argnums=(0,))
def _differentiable(call: _Call, arrays: dict):
    """Return the results of a call as JAX arrays."""
    like = arrays.get("targets", arrays["positions"])
    counts = {f"result_{k}": len(like) for k in range(1 if call.function == "h_field" else 2)}
    return call.launch(None, _filled(arrays), counts)


def _forward(call: _Call, primals: dict):
    arrays = {name: primal.value for name, primal in primals.items()}
    needed = {name: None for name, primal in primals.items() if primal.perturbed}
    results = _differentiable(call, arrays)
    return results, (arrays, needed, results)


def _backward(call: _Call, residuals, cotangents):
    arrays, needed, results = residuals  # names are static: the keys of a tree without leaves
    inputs = _filled(arrays)
    counts = {name: len(inputs[name]) for name in needed if name in inputs}
    for k, c in enumerate(cotangents):
        inputs[f"cotangent_{k}"] = jnp.zeros(c.shape, c.dtype) if isinstance(c, SymbolicZero) else c
    if call.function == "solve_induction":
        inputs["result_0"] = results[0]  # the solve starts from its solution
    gradients = dict(zip(counts, call.launch(tuple(counts), inputs, counts), strict=True))
    zeros = {name: jnp.zeros_like(arrays[name]) for name in needed if name not in counts}
    return ({name: (gradients | zeros).get(name) for name in arrays},)


_differentiable.defvjp(_forward, _backward, symbolic_zeros=True)
