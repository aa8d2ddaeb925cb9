"""The frames of a run: steps of a simulation up to each frame, and their records."""

import time
from collections.abc import Callable
from typing import Any

import newton

from warpmag.engine.stepping.stepper import Stepper
from warpmag.kernel_loading import kernel_seconds

_AHEAD = 16
"""Steps queued on a GPU before the host writes the last frame. Launches block with about 20 queued steps."""


def _running_time() -> float:
    """Return the time [s] of a clock that stands while kernels are compiled, if the command measures that."""
    return time.perf_counter() - kernel_seconds()


def run_frames(
    simulation: Any, stepper: Stepper, frames: int, steps_at: Callable[[int], int], *, recorder: Any,
    on_frame: Callable[[int], bool | None] | None, resumed: bool, follow: Callable[[newton.State], None],
) -> bool:  # fmt: skip
    """Simulate and record frames; return True if all frames are done.

    Args:
        simulation: The simulation (``simulation.Simulation``). The time of the run is added to its statistics.
        stepper: Its stepper.
        frames: Number of frames after the first.
        steps_at: Function that returns the number of steps before a frame.
        recorder: Recorder of the frames (``recording.Recorder``); None for a run without output.
        on_frame: Called after each frame with its number; the run ends if it returns False.
        resumed: True if the first frame is recorded already.
        follow: Called with the state of each frame.
    """
    statistics = simulation.statistics
    before, began = statistics.wall_seconds, _running_time()
    try:
        for frame in range(frames + 1):
            target = steps_at(frame)
            if target <= stepper.steps and (frame or resumed):
                continue  # already recorded, or two frames of one long step would have the same time
            ahead = min(stepper.steps + _AHEAD, target)
            while stepper.steps < target:
                simulation.step()
                if recorder and stepper.steps == ahead:
                    recorder.write()
            state = simulation.state
            follow(state)
            statistics.wall_seconds = before + _running_time() - began
            if recorder:
                recorder.add_frame(simulation.time, state)
            if on_frame and on_frame(frame) is False:
                return frame == frames
        return True
    finally:
        statistics.wall_seconds = before + _running_time() - began
