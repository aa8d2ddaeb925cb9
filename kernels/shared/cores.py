"""Cores that this process may use: its affinity, and the quota of the cgroups that it is in.

A container is often given a part of its machine by a quota alone: 2 cores' time on a machine of 64. Threads beyond it
would be stopped for the rest of each period, all at once.
"""

import math
import os
import re
from functools import cache
from pathlib import Path


def cores() -> int:
    """Cores that this process may use, at least 1; a part of a core counts as one.

    The affinity is that of the calling thread now. The quota is that of the first call: reading it takes longer than
    many a launch.
    """
    allowed = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, min(allowed, math.ceil(min(_own_quota(), allowed))))


@cache
def _own_quota() -> float:
    return cpu_quota(Path("/"))


def cpu_quota(root: Path) -> float:
    """Cores' worth of time that the cgroups of this process, and those around them, allow; infinite without a limit.

    Args:
        root: Folder of the file system, whose ``proc/self/cgroup`` and ``proc/self/mountinfo`` are read.
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
            # a container may see its own group, or none but its own, as the top
            inside = group[len(mounted) :] if (group + "/").startswith(mounted.rstrip("/") + "/") else ""
            parts = [part for part in inside.split("/") if part not in ("", "..")]
            for count in range(len(parts) + 1):
                quota = min(quota, _limit(root.joinpath(folder.lstrip("/"), *parts[:count])))
    return quota


def _mounts(mounts, unified: bool):
    """Group and folder at the top of each mounted hierarchy of cgroups, unified (version 2) or of the CPU's (1)."""
    for line in mounts:
        # 36 35 98:0 /group /folder rw,noatime master:1 - cgroup cgroup rw,cpu,cpuacct
        own, _, kind = line.partition(" - ")
        fields, kinds = own.split(), kind.split()
        if len(fields) < 5 or len(kinds) < 3:
            continue
        if kinds[0] == "cgroup2" if unified else kinds[0] == "cgroup" and "cpu" in kinds[2].split(","):
            yield tuple(re.sub(r"\\(\d{3})", lambda code: chr(int(code[1], 8)), name) for name in fields[3:5])


def _limit(folder: Path) -> float:
    """Quota over period of a cgroup, of version 2 or 1."""
    try:
        if (folder / "cpu.max").exists():
            quota, period = (folder / "cpu.max").read_text().split()
        else:
            quota, period = ((folder / f"cpu.cfs_{name}_us").read_text() for name in ("quota", "period"))
        return float(quota) / float(period) if quota != "max" and float(quota) > 0.0 else math.inf
    except (OSError, ValueError, ZeroDivisionError):
        return math.inf
