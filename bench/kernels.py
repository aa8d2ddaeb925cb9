"""Kernels of a step of bundled scenes on a GPU by their time: ``python -m bench.kernels [SCENE ...]``.

The step is launched from Python between events, so that each kernel's time includes 5 to 8 µs of its launch. The time
of the same steps in a graph stands beside it. Each scene is one JSON line.
"""

import argparse
import re
from collections import Counter
from pathlib import Path

import warp as wp

from bench.machine import line_writer
from bench.scene import time_steps
from warpmag import Simulation
from warpmag.scenes_usd import bundled

SCENES = "balls_up", "falling_magnet", "sakura_tree", "alphabets"
_SETTLING, _STEPS, _LISTED = 300, 60, 4  # steps before the measurement, in a graph, and from Python
_MOST = 25  # kernels in a line


def run_scene(name: str, device) -> dict:
    """Run a scene for some steps; return the time of a step in a graph, and its kernels."""
    simulation = Simulation(bundled()[name], device=str(device))
    for _ in range(_SETTLING):
        simulation.step()
    in_graph, _ = time_steps(simulation, _STEPS, device)
    stepper = simulation._stepper
    stepper._graph, stepper._capture = None, False
    before = len(simulation.statistics.evaluations)
    wp.timing_begin(cuda_filter=wp.TIMING_ALL)
    for _ in range(_LISTED):
        simulation.step()
    results = wp.timing_end()
    evaluations = sum(simulation.statistics.evaluations[before:]) / _LISTED
    return {"scene": name, "step_ms": 1e3 * in_graph, "evaluations": evaluations, **by_kernel(results, _LISTED)}


def by_kernel(results, steps: int) -> dict:
    """Return the launches and the time of a step, and those of each kernel, from Warp's timing results."""
    names = [re.sub(r"_[0-9a-f]{8}$", "", result.name.split()[-1].split("__locals__")[-1]) for result in results]
    counts, times = Counter(names), Counter()
    for name, result in zip(names, results, strict=True):
        times[name] += result.elapsed
    kernels = {name: [counts[name] / steps, time / steps] for name, time in times.most_common(_MOST)}
    return {"launches": len(results) / steps, "sum_ms": sum(times.values()) / steps, "kernels": kernels}


def main(arguments=None) -> None:
    """Measure scenes."""
    parser = argparse.ArgumentParser(prog="python -m bench.kernels", description=__doc__.partition(":")[0])
    parser.add_argument("scenes", nargs="*", default=SCENES, help="bundled scenes (the four of the paper)")
    parser.add_argument("--device", default="cuda:0")
    parser.add_argument("-o", "--output", type=Path, help="file that lines are appended to")
    options = parser.parse_args(arguments)
    wp.config.log_level = wp.LOG_WARNING
    device = wp.get_device(options.device)
    write = line_writer(device, options.output)
    for scene in options.scenes:
        write({"case": "kernels"} | run_scene(scene, device))


if __name__ == "__main__":
    main()
