"""Environment steps a second of docs/howto/isaaclab_task.md, with and without magnets, in an environment of Isaac Lab.

``python -m bench.isaaclab --environments 4096 --device cuda:0`` runs the crane with its scripted policy. Without
magnets the same bodies move and collide, and the sensor reads 0. Each of both is a process and a JSON line. A step of
an environment is 8 steps of 2.5 ms with 2 substeps each. ``sorted`` counts the environments whose balls are sorted, all
of them after 100 steps with magnets. ``made_s`` is the time until the environments exist, kernels included.
"""

# pyright: reportMissingImports=false
import argparse
import json
import re
import subprocess
import sys
import time
from pathlib import Path
from types import ModuleType
from typing import Any

import torch
import warp as wp

_PAGE = Path(__file__).parents[1] / "docs" / "howto" / "isaaclab_task.md"


class _NoMagnets:
    """Accepts the calls of ``warpmag.isaaclab.Magnets`` and changes nothing; its sensors read 0."""

    def __init__(self, environments: int, device: str):
        """Allocate the readings, shape [environments, 3]."""
        self._readings = torch.zeros(environments, 3, device=device)

    def ignore(self, *_: Any, **__: Any) -> None:
        """Do nothing."""

    add_inducible = add_coil = add_magnetometer = set_current = reset = ignore

    def readings(self, _: str) -> torch.Tensor:
        """Return zeros."""
        return self._readings


def _load_page() -> Any:
    """Return the program of the page without its last block, which runs four environments on a CPU."""
    module = sys.modules["crane"] = ModuleType("crane")
    program = "\n".join(re.findall(r"```python\n(.*?)```", _PAGE.read_text(encoding="utf-8"), re.DOTALL))
    exec(compile(program.partition("\ncfg = ")[0], str(_PAGE), "exec"), vars(module))
    return module


def run_crane(environments: int, steps: int, device: str, magnets: bool) -> dict[str, Any]:
    """Return the seconds of steps of the scripted policy, and the number of environments that sorted their balls."""
    crane, start = _load_page(), time.perf_counter()
    if not magnets:
        crane.Magnets = lambda: _NoMagnets(environments, device)
    cfg = crane.CraneCfg()
    cfg.scene.num_envs, cfg.sim.device = environments, device
    with crane.launch_simulation(cfg, {"visualizer": "none"}):
        env = crane.Crane(cfg)
        crane.run(env, 3)  # compiles kernels and captures graphs
        wp.synchronize()
        made, begin = time.perf_counter() - start, time.perf_counter()
        crane.run(env, steps)
        wp.synchronize()
        seconds, behind = time.perf_counter() - begin, env.behind_line()
        env.close()
    return {
        "magnets": magnets, "environments": environments, "device": wp.get_device(device).name, "steps": steps,
        "steps_per_s": steps * environments / seconds, "ms_per_step": 1e3 * seconds / steps, "made_s": made,
        "sorted": int((behind[:, :2].all(dim=1) & ~behind[:, 2]).sum()),
    }  # fmt: skip


def main() -> None:
    """Run with and without magnets in a process each, because Isaac Lab starts once in a process."""
    parser = argparse.ArgumentParser(prog="python -m bench.isaaclab", description=__doc__.partition("\n")[0])
    parser.add_argument("--environments", type=int, default=4)
    parser.add_argument("--steps", type=int, default=100)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--magnets", choices=("on", "off"), help="one of both, in this process")
    options = parser.parse_args()
    if options.magnets:
        line = run_crane(options.environments, options.steps, options.device, options.magnets == "on")
        print(json.dumps(line), flush=True)
        return
    for magnets in ("on", "off"):
        subprocess.run([sys.executable, "-m", "bench.isaaclab", *sys.argv[1:], "--magnets", magnets], check=True)


if __name__ == "__main__":
    main()
