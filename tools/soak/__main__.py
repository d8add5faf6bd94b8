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
    """Drives the real explorer with many clients at once, and checks every answer against a direct computation.

    Ends with status 1 when an answer was wrong, anything failed, a client waited much longer than the others, or memory,
    threads, or file handles stayed.
    """

    minutes: float = 10.0
    """For which all clients are there."""
    clients: int = 20
    """That speak over a websocket as a page does."""
    pages: int = 2
    """In headless Chromium, each a browser of its own."""
    seed: int = 0
    """Decides what every client does."""
    alone: float = 60.0
    """Seconds before that for which one client is alone, to compare times with."""
    data: Path | None = None
    """Data set; by default the demo."""
    model: Path | None = None
    """Trained LPN; by default the demo's."""
    out: Path | None = None
    """JSON file for all figures."""

    def run(self) -> int:
        """Exit status."""
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
