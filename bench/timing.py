"""Times of kernel launches on a device."""

import time

import numpy as np
import warp as wp


def measure(work, device, *, seconds: float = 1.0, repeats: int = 5, chained: int = 10) -> float:
    """Median time [s] of ``work``, a function that only launches kernels.

    On a GPU the work is captured ``chained`` times in one graph between two events. This spreads the launch of a graph,
    5 µs, over all repetitions, as in a simulation, where a step is part of a longer graph.
    """
    work()
    if device.is_cpu:
        began = time.perf_counter()
        work()
        count = max(1, round(seconds / repeats / (time.perf_counter() - began)))
        laps = []
        for _ in range(repeats):
            began = time.perf_counter()
            for _ in range(count):
                work()
            laps.append((time.perf_counter() - began) / count)
        return float(np.median(laps))
    with wp.ScopedCapture(device) as capture:
        for _ in range(chained):
            work()
    laps = []
    for _ in range(4 * repeats):
        first, last = (wp.Event(device, enable_timing=True) for _ in range(2))
        wp.record_event(first)
        wp.capture_launch(capture.graph)
        wp.record_event(last)
        laps.append(1e-3 * wp.get_event_elapsed_time(first, last) / chained)
    return float(np.median(laps))
