"""How long work reports its progress."""

from __future__ import annotations

from collections.abc import Callable

# Receives the stage, such as "frames", and the numbers of finished and of all its steps; may raise an exception to stop the work.
Progress = Callable[[str, int, int], None]
