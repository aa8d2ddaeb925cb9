"""magpylib-jax: gradients of the field of dipoles by JAX's automatic differentiation."""

import jax
import jax.numpy as jnp
import numpy as np
from magpylib_jax.core.kernels.dipole import dipole_hfield

from bench.peers import Evaluation, evaluation_of


def field_gradients(positions, moments, targets, cotangents) -> Evaluation:
    """Gradients of Σ v·H, in float64, by the arguments of the field of n dipoles at n targets.

    All arguments are arrays of shape [n, 3], ``cotangents`` the vectors v. The result is the gradients by positions,
    moments and targets, shape [3, n, 3].
    """
    jax.config.update("jax_enable_x64", True)
    arrays = [jnp.asarray(array, dtype=float) for array in (positions, moments, targets, cotangents)]

    def loss(x, m, t, v):
        fields = jax.vmap(lambda source, moment: dipole_hfield(t - source, jnp.broadcast_to(moment, t.shape)))(x, m)
        return jnp.sum(v * fields.sum(axis=0))

    gradients = jax.jit(jax.grad(loss, argnums=(0, 1, 2)))
    return evaluation_of(lambda: gradients(*arrays), wait=jax.block_until_ready, result=np.stack)
