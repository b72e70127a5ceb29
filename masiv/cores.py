"""Cores that this process may use. Light: no torch, no taichi."""

from __future__ import annotations

import math
import os
from contextlib import suppress
from pathlib import Path

CONTROL_GROUPS = Path("/sys/fs/cgroup")
"""Where Linux mounts the limits of containers."""


def available_cores(control_groups: Path = CONTROL_GROUPS) -> int:
    """Cores that the scheduler may give this process: those of its affinity (``taskset``, a job of SLURM), and no more
    than a container's share of time. At least 1.

    control_groups: folder of that limit (cgroup v2, or v1 with its controller ``cpu``).
    """
    affinity = getattr(os, "sched_getaffinity", None)  # Linux
    cores = len(affinity(0)) if affinity else os.cpu_count() or 1
    share = float(cores)
    with suppress(OSError, ValueError):  # no such file, or "max": no limit
        quota, period = (control_groups / "cpu.max").read_text().split()
        share = int(quota) / int(period)
    with suppress(OSError, ValueError):
        quota = int((control_groups / "cpu/cpu.cfs_quota_us").read_text())
        if quota > 0:  # -1: no limit
            share = min(share, quota / int((control_groups / "cpu/cpu.cfs_period_us").read_text()))
    return max(1, min(cores, math.ceil(share)))
