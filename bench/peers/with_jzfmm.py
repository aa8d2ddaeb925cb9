"""jz-FMM, fast multipole method in JAX and CUDA: field of point charges, its usual order 5, tree made each time."""

import os

os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")  # or it takes most of the GPU's memory from its peers

import jax
import numpy as np
from jzfmm.config import FMMConfig, PlummerKernel
from jzfmm.fmm import fast_multipole_method
from jztree.data import PosMass

from bench.peers import Evaluation


def prepare(positions, charges, device):
    """See ``bench.peers``; charges are of shape [n]."""
    where = jax.devices("gpu" if device.startswith("cuda") else "cpu")[0]
    x, q = (jax.device_put(a, where) for a in (positions, charges))
    config = FMMConfig(kernel=PlummerKernel(softening=1e-6 * float(np.ptp(positions))))
    last = []

    def run():
        last[:] = [fast_multipole_method.jit(PosMass(pos=x, mass=q), config).force()]

    # masses attract: their force is minus the field of charges, over the strength 1 of the law
    return Evaluation(run, lambda: last[0].block_until_ready(), lambda: -np.asarray(last[0]) / (4.0 * np.pi))
