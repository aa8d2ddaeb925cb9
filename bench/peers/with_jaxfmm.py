"""jaxFMM, fast multipole method in JAX: field of point charges, tuned by itself to a relative error; tree kept."""

import os

os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")  # or it takes most of the GPU's memory from its peers

import jax
import jaxfmm
import numpy as np

from bench.peers import Evaluation

_ERROR = 2e-3
"""Relative error asked for; in float32 it accepts none below 1.5e-3."""


def prepare(positions, charges, device):
    """See ``bench.peers``; charges are of shape [n]."""
    where = jax.devices("gpu" if device.startswith("cuda") else "cpu")[0]
    x, q = (jax.device_put(a, where) for a in (positions, charges))
    evaluate = jaxfmm.plan(x, err_tol=_ERROR, field=True, verbose=False)
    last = []

    def run():
        last[:] = [evaluate(q)]

    return Evaluation(run, lambda: last[0].block_until_ready(), lambda: np.asarray(last[0]))
