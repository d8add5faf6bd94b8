"""The callbacks by which long work reports its progress; each may raise an exception to stop the work."""

from __future__ import annotations

from collections.abc import Callable

# Receives the number of finished items, and the total number.
CountProgress = Callable[[int, int], None]
# Receives the stage, such as "frames", the number of its finished steps, and the number of its steps.
Progress = Callable[[str, int, int], None]
