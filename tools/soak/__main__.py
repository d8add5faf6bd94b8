"""`python -m tools.soak --minutes 10 --clients 20 --pages 2 --seed 0`."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import tyro
from rich.console import Console

from lpn.core.demo import DEMO
from lpn.core.errors import InputError, LPNError
from lpn.core.files import check_writable, write_atomic
from tools.soak.run import Soak


@dataclass
class Arguments:
    """Drive the real explorer with many clients at once, and check every answer against a direct computation.

    The exit status is 1 after a wrong answer, an error, a client that waited much longer than the others, or leaked memory,
    threads, or file handles.
    """

    minutes: float = 10.0
    """Duration with all clients."""
    clients: int = 20
    """Number of clients over websockets."""
    pages: int = 2
    """Number of pages in headless Chromium."""
    seed: int = 0
    """Seed of all clients' acts."""
    alone: float = 60.0
    """Seconds with a single client before, as a reference for times."""
    data: Path | None = None
    """Data set; by default the demo."""
    model: Path | None = None
    """Trained LPN; by default that of the demo."""
    out: Path | None = None
    """JSON file for all figures."""

    def run(self) -> int:
        """Run the soak and return the exit status."""
        if (self.data is None) != (self.model is None):
            raise InputError("Either --data or --model is given alone; give both, or neither for the demo.")
        if self.minutes <= 0 or self.clients < 1 or self.pages < 0 or self.alone < 0:
            raise InputError("Expected minutes above 0, at least one client, and no negative number.")
        if self.out is not None:
            check_writable(self.out)
        console = Console()
        chosen = [] if self.data is None else ["--data", str(self.data), "--model", str(self.model)]
        soak = Soak(
            self.data or DEMO,
            self.model or DEMO / "lpn.onnx",
            chosen,
            self.clients,
            self.pages,
            self.seed,
            self.alone,
            60 * self.minutes,
            lambda text: print(text, file=sys.stderr, flush=True),
        )
        figures = soak.run()
        figures.show(console)
        if self.out is not None:
            write_atomic(self.out, figures.json())
        return 1 if figures.failures() else 0


def main() -> int:
    """Run the command line."""
    try:
        return tyro.cli(Arguments, prog="python -m tools.soak").run()
    except LPNError as error:
        print(error, file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("Stopped.", file=sys.stderr)
        return 130


if __name__ == "__main__":
    sys.exit(main())
