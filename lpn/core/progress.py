"""The callbacks by which long work reports its progress; each may raise an exception to stop the work."""

from __future__ import annotations

from collections.abc import Callable

# Receives the numbers of things that are done, and of all.
CountProgress = Callable[[int, int], None]
# Receives the stage, such as "frames", and the numbers of finished and of all its steps.
Progress = Callable[[str, int, int], None]
