"""Numba: a parallel loop on all cores, and a CUDA kernel."""

import math

import numba
import numpy as np
from numba import cuda

from bench.peers import Evaluation

_BLOCK = 256


@numba.njit(parallel=True, fastmath=True)
def _field(x, y, z, mx, my, mz, h):
    third = np.float32(3.0)
    for i in numba.prange(x.size):
        hx = hy = hz = np.float32(0.0)
        for j in range(x.size):
            rx, ry, rz = x[i] - x[j], y[i] - y[j], z[i] - z[j]
            d2 = rx * rx + ry * ry + rz * rz
            inv = np.float32(1.0) / np.sqrt(d2) if d2 > np.float32(0.0) else np.float32(0.0)
            inv2 = inv * inv
            inv3 = inv2 * inv
            w = third * inv2 * (rx * mx[j] + ry * my[j] + rz * mz[j])
            hx += inv3 * (w * rx - mx[j])
            hy += inv3 * (w * ry - my[j])
            hz += inv3 * (w * rz - mz[j])
        h[i, 0], h[i, 1], h[i, 2] = hx, hy, hz


@cuda.jit(fastmath=True)
def _field_cuda(x, m, h):
    staged = cuda.shared.array((_BLOCK, 6), numba.float32)
    lane, i = cuda.threadIdx.x, cuda.grid(1)
    n = x.shape[0]
    tx = ty = tz = hx = hy = hz = numba.float32(0.0)
    if i < n:
        tx, ty, tz = x[i, 0], x[i, 1], x[i, 2]
    for begin in range(0, n, _BLOCK):
        j = begin + lane
        if j < n:
            for c in range(3):
                staged[lane, c] = x[j, c]
                staged[lane, 3 + c] = m[j, c]
        cuda.syncthreads()
        for k in range(min(_BLOCK, n - begin)):
            rx, ry, rz = tx - staged[k, 0], ty - staged[k, 1], tz - staged[k, 2]
            mx, my, mz = staged[k, 3], staged[k, 4], staged[k, 5]
            d2 = rx * rx + ry * ry + rz * rz
            if d2 > numba.float32(0.0):
                inv = numba.float32(1.0) / math.sqrt(d2)
                inv2 = inv * inv
                inv3 = inv2 * inv
                w = numba.float32(3.0) * inv2 * (rx * mx + ry * my + rz * mz)
                hx += inv3 * (w * rx - mx)
                hy += inv3 * (w * ry - my)
                hz += inv3 * (w * rz - mz)
        cuda.syncthreads()
    if i < n:
        h[i, 0], h[i, 1], h[i, 2] = hx, hy, hz


def numba_cpu(positions, moments, device) -> Evaluation:
    """One target per iteration; fastmath lets LLVM vectorize over the sources."""
    components = [np.ascontiguousarray(c) for c in (*positions.T, *moments.T)]
    h = np.empty_like(positions)
    return Evaluation(lambda: _field(*components, h), lambda: None, lambda: h / np.float32(4.0 * np.pi))


def numba_cuda(positions, moments, device) -> Evaluation:
    """One thread per target; sources are staged in shared memory one block at a time."""
    x, m = (cuda.to_device(a) for a in (positions, moments))
    h = cuda.device_array_like(x)
    kernel = _field_cuda[-(-len(positions) // _BLOCK), _BLOCK]
    return Evaluation(lambda: kernel(x, m, h), cuda.synchronize, lambda: h.copy_to_host() / np.float32(4.0 * np.pi))
