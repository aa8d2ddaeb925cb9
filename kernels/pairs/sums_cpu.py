"""All-pairs sums on a CPU: the kernel that calls ``sums_cpu.h``."""

from functools import cache

from warpmag.kernels.pairs.pair_terms import Quantity
from warpmag.kernels.pairs.work_list import arrays_type, tile_size
from warpmag.kernels.shared.native import native_options
from warpmag.kernels.shared.passes import passes_kernel


@cache
def pair_loop_kernel(dtype, quantity: Quantity):
    """Kernel of one pass that sums a quantity over all tiles; see ``evaluate``."""
    return passes_kernel(
        f"warpmag::cpu::sum_tiles<warpmag::Quantity({quantity:d})>(arrays, threads, team.data);",
        arrays_type(dtype),
        native_options("pairs/sums_cpu.h", dtype=dtype, TILE_SIZE=tile_size(dtype)),
    )
