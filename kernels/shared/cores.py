"""Number of cores that this process may use, from its affinity and the CPU quota of its cgroups.

A container is often limited by a quota alone, for example to 2 cores' time on a machine of 64 cores. If more threads
run, they use up the quota early, and the system stops all of them for the rest of each period.
"""

import math
import os
import re
from functools import cache
from pathlib import Path


def cores() -> int:
    """Number of cores that this process may use, at least 1; a fraction of a core counts as one.

    The affinity of the calling thread is read at each call. The quota is read at the first call only, since reading it
    takes longer than many launches.
    """
    allowed = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, min(allowed, math.ceil(min(_own_quota(), allowed))))


@cache
def _own_quota() -> float:
    return cpu_quota(Path("/"))


def cpu_quota(root: Path) -> float:
    """CPU time per real time that the cgroups of this process and their parents allow; infinite without a limit.

    ``proc/self/cgroup`` and ``proc/self/mountinfo`` below ``root`` are read.
    """
    try:
        groups = (root / "proc/self/cgroup").read_text().splitlines()
        mounts = (root / "proc/self/mountinfo").read_text().splitlines()
    except (OSError, UnicodeDecodeError):
        return math.inf
    quota = math.inf
    for _, controllers, group in (line.split(":", 2) for line in groups if line.count(":") >= 2):
        if controllers and "cpu" not in controllers.split(","):
            continue
        for mounted, folder in _mounts(mounts, unified=not controllers):
            # a container may see its own group as the root of the hierarchy
            inside = group[len(mounted) :] if (group + "/").startswith(mounted.rstrip("/") + "/") else ""
            parts = [part for part in inside.split("/") if part not in ("", "..")]
            for count in range(len(parts) + 1):
                quota = min(quota, _limit(root.joinpath(folder.lstrip("/"), *parts[:count])))
    return quota


def _mounts(mounts, unified: bool):
    """Yield the group and the mount folder of each cgroup hierarchy: unified (version 2) or of the CPU (version 1)."""
    for line in mounts:
        # 36 35 98:0 /group /folder rw,noatime master:1 - cgroup cgroup rw,cpu,cpuacct
        mount, _, kind = line.partition(" - ")
        fields, kinds = mount.split(), kind.split()
        if len(fields) < 5 or len(kinds) < 3:
            continue
        if kinds[0] == "cgroup2" if unified else kinds[0] == "cgroup" and "cpu" in kinds[2].split(","):
            yield tuple(re.sub(r"\\(\d{3})", lambda code: chr(int(code[1], 8)), name) for name in fields[3:5])


def _limit(folder: Path) -> float:
    """Quota divided by period of a cgroup of version 1 or 2; infinite without a limit."""
    try:
        if (folder / "cpu.max").exists():
            quota, period = (folder / "cpu.max").read_text().split()
        else:
            quota, period = ((folder / f"cpu.cfs_{name}_us").read_text() for name in ("quota", "period"))
        return float(quota) / float(period) if quota != "max" and float(quota) > 0.0 else math.inf
    except (OSError, ValueError, ZeroDivisionError):
        return math.inf
