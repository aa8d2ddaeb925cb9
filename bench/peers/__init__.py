"""Other ways to the same sum: the field of n dipoles at each other, as one would write it with each library.

Every module has one function ``prepare(positions, moments, device)``, which takes float32 NumPy arrays of shape [n, 3]
and the name of a Warp device, puts them where the library wants them and returns an :class:`Evaluation`. A module whose
library is not installed fails to import; ``compare`` skips it.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Evaluation:
    """A field evaluation that is ready to run.

    Attributes:
        run: Starts one evaluation.
        wait: Returns when all that were started have ended.
        result: Field [A/m] of the last one, shape [n, 3].
        kept: What has to live as long as this does: a captured graph does not hold the arrays that it works on.
    """

    run: Callable[[], object]
    wait: Callable[[], object]
    result: Callable[[], np.ndarray]
    kept: object = None


@dataclass(frozen=True)
class Peer:
    """A module of this folder.

    Attributes:
        name: Module name.
        summary: What it is.
        devices: Where it runs, ``cpu``, ``cuda`` or both.
        charges: Whether it sums the field of point charges, shape [n], and knows no dipoles; ``many`` alone runs it.
    """

    name: str
    summary: str
    devices: tuple[str, ...]
    charges: bool = False


PEERS = (
    Peer("with_warpmag", "warpmag: native loop and overlap pass, captured in a graph", ("cpu", "cuda")),
    Peer("with_h_field", "warpmag.h_field of points, the whole call", ("cpu",)),
    Peer("with_warp_plain", "Warp: one thread a target, the textbook loop, in a graph", ("cpu", "cuda")),
    Peer("with_warp_tile", "Warp: its tile n-body example turned to dipoles, in a graph", ("cuda",)),
    Peer("with_torch", "PyTorch: broadcast over blocks of targets, torch.compile", ("cpu", "cuda")),
    Peer("with_jax", "JAX: broadcast over blocks of targets, jit", ("cpu", "cuda")),
    Peer("with_numba_cpu", "Numba: parallel, fastmath loop", ("cpu",)),
    Peer("with_numba_cuda", "Numba CUDA: sources staged in shared memory", ("cuda",)),
    Peer("with_cupy", "CuPy: broadcast over blocks of targets", ("cuda",)),
    Peer("with_pykeops", "KeOps: symbolic matrix, reduced without being stored", ("cpu", "cuda")),
    Peer("with_magpylib", "magpylib: its dipole formula over all pairs, float64", ("cpu",)),
    Peer("with_fmm3d", "FMM3D: fast multipole method, eps 1e-3, float64", ("cpu",)),
    Peer("with_jaxfmm", "jaxFMM: fast multipole method, error 2e-3, tree kept", ("cpu", "cuda"), charges=True),
    Peer("with_jzfmm", "jz-FMM: fast multipole method, order 5", ("cuda",), charges=True),
)
