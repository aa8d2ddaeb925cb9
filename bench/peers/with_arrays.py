"""KeOps, magpylib and FMM3D: each function imports its own library, since they are installed separately."""

from typing import Any

import numpy as np

from bench.peers import Evaluation, evaluation_of

_PAIRS = 1 << 20  # pairs of one block of magpylib
_EPS = 1e-3  # relative precision of FMM3D


def pykeops(positions, moments, device) -> Evaluation:
    """KeOps: the matrix of pairs as a formula, reduced without being stored."""
    from pykeops.numpy import LazyTensor  # noqa: PLC0415

    backend = "GPU" if device.startswith("cuda") else "CPU"
    r: Any = LazyTensor(positions[:, None, :]) - LazyTensor(positions[None, :, :])
    m = LazyTensor(moments[None, :, :])
    d2 = (r * r).sum(-1)
    # a moment counts as infinitely far from itself: step(x) is 1 from 0 on
    inv = (d2 + (-d2).step() * np.float32(1e30)).rsqrt()
    inv3 = inv * inv * inv
    field = inv3 * (np.float32(3.0) * inv * inv * (r * m).sum(-1) * r - m)
    return evaluation_of(
        lambda: field.sum(axis=1, backend=backend), result=lambda total: total / np.float32(4.0 * np.pi)
    )


def magpylib(positions, moments, device) -> Evaluation:
    """Vectorized dipole formula of magpylib over blocks of pairs, in float64."""
    from magpylib.core import dipole_Hfield  # noqa: PLC0415

    x, m = positions.astype(float), moments.astype(float)
    n = len(x)
    block = max(1, _PAIRS // n)
    h = np.empty((n, 3))

    def run():
        for begin in range(0, n, block):
            at = np.arange(begin, min(begin + block, n))
            r = x[at][:, None] - x
            r[np.arange(at.size), at] = 1e30  # infinitely far from itself
            pairs = dipole_Hfield(observers=r.reshape(-1, 3), moments=np.tile(m, (at.size, 1)))
            h[at] = pairs.reshape(at.size, n, 3).sum(1)

    return Evaluation(run, lambda: None, lambda: h)


def fmm3d(positions, moments, device) -> Evaluation:
    """Fast multipole method of FMM3D: H = −∇ψ of the dipoles' potential ψ = m·r/4πr³, in float64."""
    import fmm3dpy  # noqa: PLC0415

    sources, dipoles = (np.asfortranarray(a.T, dtype=float) for a in (positions, moments))
    return evaluation_of(
        lambda: fmm3dpy.lfmm3d(eps=_EPS, sources=sources, dipvec=dipoles, pg=2).grad, result=lambda grad: -grad.T
    )
