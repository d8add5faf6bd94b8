"""What this process may use of the machine."""

from __future__ import annotations

import os


def usable_cores() -> int:
    """Cores that this process may use: fewer than the machine has where it is confined to some, as in a container or a job."""
    confined = getattr(os, "sched_getaffinity", None)  # not on every system
    return len(confined(0)) if confined else os.cpu_count() or 1
