"""Calls on arrays for JAX: ``h_field``, ``wrench`` and ``solve_induction`` of JAX arrays, with gradients.

The functions are those of ``warpmag`` with JAX arrays in place of arrays. The type is that of ``positions``,
``float32`` or ``float64``; other arrays are converted. The functions may be part of ``jax.jit``, ``jax.grad`` and
``jax.vmap``. JAX calls them on the host (``jax.pure_callback``): arrays of a CPU are shared, arrays of a GPU are copied
to the host and back. Gradients (``docs/howto/gradients.md``) are of reverse mode and have no gradients of their own.

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

import math
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax  # pyright: ignore[reportMissingImports]
import jax.numpy as jnp  # pyright: ignore[reportMissingImports]
import numpy as np
import warp as wp
from jax.custom_derivatives import SymbolicZero  # pyright: ignore[reportMissingImports]

from warpmag.errors import InputError
from warpmag.moments import fields, induction
from warpmag.moments.arrays import DTYPES, dtype_name, vec3_type

_SCALARS = ("radii", "target_radii", "saturation", "susceptibility")
"""Arguments of one number for each ball; the others are vectors."""


def h_field(positions, moments, targets=None, *, radii=None, target_radii=None, method="auto", rtol=None, device=None):
    """Return the field H [A/m] of moments, shape [t, 3]; see :func:`warpmag.h_field`.

    Gradients by ``positions``, ``moments`` and ``targets``. ``device`` is the Warp device that computes.
    """
    arrays = {"positions": positions, "moments": moments, "targets": targets}
    arrays |= {"radii": radii, "target_radii": target_radii}
    call = _Call("h_field", (("method", method), ("rtol", rtol)), device)
    (field,) = _differentiable(call, _read(arrays, {"target_radii": "targets"}))
    return field


def wrench(positions, moments, *, radii=None, external_field=None, method="auto", rtol=None, device=None):
    """Return forces [N] and torques [N·m], shape [n, 3] each; see :func:`warpmag.wrench`.

    Gradients by ``positions``, ``moments`` and ``external_field``. ``device`` is the Warp device that computes.
    """
    arrays = {"positions": positions, "moments": moments, "radii": radii, "external_field": external_field}
    call = _Call("wrench", (("method", method), ("rtol", rtol)), device)
    return _differentiable(call, _read(arrays, {}))


@partial(
    jax.tree_util.register_dataclass, data_fields=["magnetizations", "h_field", "_arrays"], meta_fields=["_device"]
)
@dataclass(frozen=True)
class InductionArrays:
    """Magnetic equilibrium of n balls, returned by :func:`solve_induction`; a tree of JAX.

    Attributes:
        magnetizations: M [A/m], shape [n, 3].
        h_field: Field H at the balls [A/m], without a ball's own, shape [n, 3].
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
    positions, radii, *, saturation=None, susceptibility=math.inf, curve="tanh", external_field=None, permanent=None,
    method="auto", rtol=1e-3, max_evaluations=1000, device=None,
) -> InductionArrays:  # fmt: skip
    """Return the magnetic equilibrium of inducible balls; see :func:`warpmag.solve_induction`.

    Gradients by all arrays, with a relative error of about ``rtol``. ``device`` is the Warp device that computes.
    """
    dipoles, dipole_moments = (np.zeros((0, 3)),) * 2 if permanent is None else permanent
    arrays = {"positions": positions, "radii": radii, "saturation": saturation, "susceptibility": susceptibility}
    arrays |= {"external_field": external_field, "dipoles": dipoles, "dipole_moments": dipole_moments}
    if saturation is None:  # of measured curves
        del arrays["susceptibility"]
    arrays = _read(arrays, {"dipole_moments": "dipoles"})
    curve = tuple(curve) if isinstance(curve, list) else curve
    options = ("curve", curve), ("method", method), ("rtol", rtol), ("max_evaluations", max_evaluations)
    m, h = _differentiable(_Call("solve_induction", options, device), arrays)
    return InductionArrays(m, h, arrays, device)


def _read(arrays: dict, owners: dict[str, str]) -> dict:
    """Return the given arrays with all their dimensions, of the type of ``positions``.

    ``owners`` names the positions that an argument belongs to, if they are not ``positions``.
    """
    positions = jnp.asarray(arrays["positions"])
    if positions.dtype not in (jnp.float32, jnp.float64):
        raise InputError(f"positions: must be float32 or float64, got {positions.dtype}")
    given = {name: jnp.asarray(value, positions.dtype) for name, value in arrays.items() if value is not None}
    for name, value in given.items():
        ndim, count = 1 if name in _SCALARS else 2, len(given[owners.get(name, "positions")])
        if value.ndim < ndim:
            given[name] = jnp.broadcast_to(value, (count, 3)[:ndim])
    return given


@dataclass(frozen=True)
class _Call:
    """A call on arrays by the name of its function, with options that are no arrays."""

    function: str
    options: tuple
    device: Any

    def shapes(self, arrays: dict) -> list:
        """Return shape and type of the results."""
        like = arrays.get("targets", arrays["positions"])
        return [jax.ShapeDtypeStruct(like.shape, like.dtype)] * (1 if self.function == "h_field" else 2)

    def results(self, arrays: dict) -> list[np.ndarray]:
        """Return the results of NumPy arrays."""
        return [result.numpy() for result in self._evaluate(self._upload(arrays, ()))]

    def gradients(self, arrays: dict, needed: dict, cotangents: list, initial) -> dict:
        """Return the gradients by the arrays that ``needed`` names; a solve starts from the solution ``initial``."""
        inputs = self._upload(arrays, needed)
        more = {"initial": np.asarray(initial)} if self.function == "solve_induction" else {}
        with wp.Tape() as tape:
            results = self._evaluate(inputs, **more)
        for result, cotangent in zip(results, cotangents, strict=True):
            result.grad.assign(np.asarray(cotangent))
        tape.backward()
        return {name: inputs[name].grad.numpy() for name in needed}

    def _upload(self, arrays: dict, needed) -> dict[str, wp.array]:
        def upload(name, value):
            value = np.asarray(value)
            dtype = DTYPES[value.dtype.name]
            dtype = dtype if name in _SCALARS else vec3_type(dtype)
            return wp.array(value, dtype=dtype, device=self.device, copy=False, requires_grad=name in needed)

        return {name: upload(name, value) for name, value in arrays.items()}

    def _evaluate(self, arrays: dict[str, wp.array], **more) -> list[wp.array]:
        dtype = dtype_name(arrays["positions"].dtype._wp_scalar_type_)
        options = {**dict(self.options), **more, "dtype": dtype, "device": self.device}
        if self.function == "h_field":
            return [fields.h_field(**arrays, **options)]
        if self.function == "wrench":
            return list(fields.wrench(**arrays, **options))
        arrays = dict(arrays)
        permanent = arrays.pop("dipoles"), arrays.pop("dipole_moments")
        result = induction.solve_induction(permanent=permanent, **arrays, **options)
        return [result.magnetizations, result.h_field]


@partial(jax.custom_vjp, nondiff_argnums=(0,))
def _differentiable(call: _Call, arrays: dict):
    """Return the results of a call as JAX arrays."""
    return jax.pure_callback(call.results, call.shapes(arrays), arrays, vmap_method="sequential")


def _forward(call: _Call, primals: dict):
    arrays = {name: primal.value for name, primal in primals.items()}
    needed = {name: None for name, primal in primals.items() if primal.perturbed}
    results = _differentiable(call, arrays)
    return results, (arrays, needed, results)


def _backward(call: _Call, residuals, cotangents):
    arrays, needed, results = residuals
    shapes = {name: jax.ShapeDtypeStruct(arrays[name].shape, arrays[name].dtype) for name in needed}
    seeds = [jnp.zeros(c.shape, c.dtype) if isinstance(c, SymbolicZero) else c for c in cotangents]
    # names are static: the keys of a tree without leaves
    gradients = jax.pure_callback(
        lambda arrays, seeds, initial: call.gradients(arrays, needed, seeds, initial),
        shapes, arrays, seeds, results[0], vmap_method="sequential",
    )  # fmt: skip
    return ({name: gradients.get(name) for name in arrays},)


_differentiable.defvjp(_forward, _backward, symbolic_zeros=True)
