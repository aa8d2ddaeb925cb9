"""Times of the parts of a solve and of the forces, measured on the device."""

import time
from collections.abc import Callable
from functools import partial

import numpy as np
import warp as wp

from warpmag.moments.system import MomentSystem

_REPEATS, _LAUNCHES = 7, 10
"""Number of measurements of a part, and of launches in each. The median of the measurements is the result."""


def part_times(system: MomentSystem) -> dict[str, float]:
    """Return the time of each part of the last solve and its forces [s], by name.

    Each part is launched again on its own, on a GPU in a graph, so that launches by Python do not count. Waits for the
    device, and leaves the results.
    """
    h = wp.clone(system.h)
    times = {name: count * _seconds(launch, system.device) for name, (launch, count) in system.parts().items()}
    wp.copy(system.h, h)
    return times


def _seconds(launch: Callable[[], None], device: wp.Device) -> float:
    """Return the median time of a launch [s]."""
    launch()  # compiles kernels and records launches
    again, laps = launch, []
    if device.is_cuda:
        with wp.ScopedCapture(device) as capture:
            launch()
        again = partial(wp.capture_launch, capture.graph)
    for _ in range(_REPEATS):
        wp.synchronize_device(device)
        began = time.perf_counter()
        for _ in range(_LAUNCHES):
            again()
        wp.synchronize_device(device)
        laps.append((time.perf_counter() - began) / _LAUNCHES)
    return float(np.median(laps))
