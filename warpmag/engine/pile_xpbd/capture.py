"""Makes what Newton launches in a substep fit into conditional nodes of a CUDA graph.

The body of such a node may hold kernels, copies and further conditional nodes, but nothing that allocates memory.
Newton allocates in two places: solvers make temporary arrays, and collision adds up counts with Warp's ``array_scan``,
which takes its scratch memory from the device's pool. While a step is launched or captured, temporary arrays therefore
come from a :class:`Workspace`, and integer scans are done by a kernel that needs no scratch.
"""

import contextlib
from collections import defaultdict
from collections.abc import Iterator

import warp as wp

from warpmag.kernels.shared.scan import launch_scan


class Workspace:
    """Memory for temporary arrays that is reused: an allocator for Warp.

    The first run of a step finds out what is needed; while a graph is captured, nothing new is allocated.
    """

    def __init__(self, device):
        """Serve arrays on ``device``, a CUDA device."""
        self._device = device
        self._blocks: list[wp.array] = []
        self._free: dict[int, list[int]] = defaultdict(list)

    def allocate(self, size_in_bytes: int) -> int:
        """Return a block of memory."""
        if self._free[size_in_bytes]:
            return self._free[size_in_bytes].pop()
        if self._device.is_capturing:
            raise RuntimeError(f"{size_in_bytes} bytes are wanted that the step did not need when it ran")
        with wp.ScopedAllocator(self._device, None):
            block = wp.empty(size_in_bytes, dtype=wp.uint8, device=self._device)
        self._blocks.append(block)
        assert block.ptr is not None
        return block.ptr

    def deallocate(self, ptr: int, size_in_bytes: int) -> None:
        """Take a block back."""
        self._free[size_in_bytes].append(ptr)


@contextlib.contextmanager
def without_allocations(device, workspace: Workspace | None) -> Iterator[None]:
    """Take the memory of temporary arrays on a CUDA device from ``workspace``, and scan without scratch memory."""
    if not device.is_cuda:
        yield
        return
    original = wp.utils.array_scan

    def scan(values, sums, inclusive=True):
        plain = values.dtype is wp.int32 and values.is_contiguous and sums.is_contiguous
        (launch_scan if plain and values.device.is_cuda else original)(values, sums, inclusive)

    wp.utils.array_scan = scan
    try:
        with wp.ScopedAllocator(device, workspace):
            yield
    finally:
        wp.utils.array_scan = original
