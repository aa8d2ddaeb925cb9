"""Peers of warpmag: the field of n dipoles at each other, as users of other libraries would write it.

A peer is a function of its name in a module of this folder, ``peer(positions, moments, device)``. It takes float32
NumPy arrays of shape [n, 3] and the name of a Warp device. It moves the arrays where the library needs them, and
returns an :class:`Evaluation`. Peers for point charges take charges of shape [n] in place of moments. ``compare``
reports a peer whose library is not installed as failed.
"""

import importlib
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Evaluation:
    """A field evaluation that is ready to run."""

    run: Callable[[], object]  # starts one evaluation
    wait: Callable[[], object]  # waits for all evaluations that were started
    result: Callable[[], np.ndarray]  # field [A/m] of the last evaluation, shape [n, 3]
    kept: object = None  # lives as long as this object: a captured graph does not hold the arrays that it uses


def evaluation_of(compute, *, wait=lambda value: None, result=np.asarray) -> Evaluation:
    """Evaluation of a function that returns its result; ``wait`` and ``result`` take the last one."""
    last = []

    def run():
        last[:] = [compute()]

    return Evaluation(run, lambda: wait(last[0]), lambda: result(last[0]))


@dataclass(frozen=True)
class Peer:
    """A function of a module of this folder."""

    name: str
    module: str
    summary: str  # library and method
    devices: tuple[str, ...]  # devices that it runs on, ``cpu``, ``cuda`` or both
    charges: bool = False  # true if it sums the field of point charges, shape [n]; only ``many`` runs such peers

    def prepare(self, positions, moments, device) -> Evaluation:
        """Call the function; raises an error if its library is not installed."""
        return getattr(importlib.import_module(f"bench.peers.{self.module}"), self.name)(positions, moments, device)


PEERS = (
    Peer("warpmag", "with_warp", "warpmag: native loop and overlap pass, captured in a graph", ("cpu", "cuda")),
    Peer("h_field", "with_warp", "warpmag.h_field of points, the whole call", ("cpu",)),
    Peer("warp_plain", "with_warp", "Warp: one thread per target, the textbook loop, in a graph", ("cpu", "cuda")),
    Peer("warp_tile", "with_warp", "Warp: its tile n-body example adapted to dipoles, in a graph", ("cuda",)),
    Peer("torch", "with_torch", "PyTorch: broadcast over blocks of targets, torch.compile", ("cpu", "cuda")),
    Peer("jax", "with_jax", "JAX: broadcast over blocks of targets, jit", ("cpu", "cuda")),
    Peer("numba_cpu", "with_numba", "Numba: parallel, fastmath loop", ("cpu",)),
    Peer("numba_cuda", "with_numba", "Numba CUDA: sources staged in shared memory", ("cuda",)),
    Peer("pykeops", "with_arrays", "KeOps: symbolic matrix, reduced without being stored", ("cpu", "cuda")),
    Peer("magpylib", "with_arrays", "magpylib: its dipole formula over all pairs, float64", ("cpu",)),
    Peer("fmm3d", "with_arrays", "FMM3D: fast multipole method, eps 1e-3, float64", ("cpu",)),
    Peer("jaxfmm", "with_jax", "jaxFMM: fast multipole method, error 2e-3, tree kept", ("cpu", "cuda"), charges=True),
    Peer("jzfmm", "with_jax", "jz-FMM: fast multipole method, order 5", ("cuda",), charges=True),
)
