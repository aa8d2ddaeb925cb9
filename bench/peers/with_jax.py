"""JAX, and two fast multipole methods on it that sum the field of point charges."""

import os

os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")  # else it takes most of the GPU's memory from its peers

import jax as library
import jax.numpy as jnp
import numpy as np

from bench.peers import Evaluation, evaluation_of

_BLOCK = 1024
_ERROR = 2e-3
"""Relative error that jaxFMM is tuned for; in float32 it accepts none below 1.5e-3."""


@library.jit
def _field(x, m):
    def at(target):
        r = target - x
        d2 = jnp.sum(r * r, axis=1)
        inv = library.lax.rsqrt(jnp.where(d2 > 0.0, d2, jnp.inf))
        rm = jnp.sum(r * m, axis=1)
        return jnp.sum((3.0 * rm * inv**5)[:, None] * r - (inv**3)[:, None] * m, axis=0) / (4.0 * jnp.pi)

    return library.lax.map(at, x, batch_size=_BLOCK)


def jax(positions, moments, device) -> Evaluation:
    """Broadcast over a block of targets, fused by XLA."""
    x, m = _arrays(device, positions, moments)
    return evaluation_of(lambda: _field(x, m), wait=lambda field: field.block_until_ready())


def jaxfmm(positions, charges, device) -> Evaluation:
    """jaxFMM, which tunes itself to a relative error; the tree is kept."""
    import jaxfmm as fmm  # noqa: PLC0415 - installed by itself

    x, q = _arrays(device, positions, charges)
    evaluate = fmm.plan(x, err_tol=_ERROR, field=True, verbose=False)
    return evaluation_of(lambda: evaluate(q), wait=lambda field: field.block_until_ready())


def jzfmm(positions, charges, device) -> Evaluation:
    """jz-FMM on CUDA, of its default order 5; the tree is built each time."""
    from jzfmm.config import FMMConfig, PlummerKernel  # noqa: PLC0415 - installed by itself
    from jzfmm.fmm import fast_multipole_method  # noqa: PLC0415
    from jztree.data import PosMass  # noqa: PLC0415

    x, q = _arrays(device, positions, charges)
    config = FMMConfig(kernel=PlummerKernel(softening=1e-6 * float(np.ptp(positions))))
    return evaluation_of(
        lambda: fast_multipole_method.jit(PosMass(pos=x, mass=q), config).force(),
        wait=lambda force: force.block_until_ready(),
        # masses attract: the field of charges is minus the force, for a law of strength 1
        result=lambda force: -np.asarray(force) / (4.0 * np.pi),
    )


def _arrays(device: str, *arrays):
    target = library.devices("gpu" if device.startswith("cuda") else "cpu")[0]
    return [library.device_put(array, target) for array in arrays]
