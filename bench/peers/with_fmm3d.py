"""FMM3D, fast multipole method: H = −∇ψ of the dipoles' potential ψ = m·r/4πr³, in float64."""

import fmm3dpy
import numpy as np

from bench.peers import Evaluation

_EPS = 1e-3
"""Relative precision asked for."""


def prepare(positions, moments, device):
    """See ``bench.peers``."""
    sources, dipoles = (np.asfortranarray(a.T, dtype=float) for a in (positions, moments))
    last = []

    def run():
        last[:] = [fmm3dpy.lfmm3d(eps=_EPS, sources=sources, dipvec=dipoles, pg=2).grad]

    return Evaluation(run, lambda: None, lambda: -last[0].T)
