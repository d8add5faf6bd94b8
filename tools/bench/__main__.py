"""Run all benchmarks, in one table: `python -m tools.bench [NAME ...]`.

Names are query, search, evaluate, describe, page, and train; without one, all are run, each in a process of its own.
"""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import asdict
from importlib import import_module

from tools.bench.figures import Figure, show

NAMES = ("query", "search", "evaluate", "describe", "page", "train")


def measured(name: str) -> list[Figure]:
    """Run one benchmark in a process, and return its figures."""
    print(f"Measuring {name} ...", file=sys.stderr, flush=True)
    done = subprocess.run([sys.executable, "-m", "tools.bench", "--json", name], stdout=subprocess.PIPE, text=True)
    if done.returncode:
        print(f"bench.{name} failed; its figures are missing below.", file=sys.stderr)
        return []
    return [Figure(**values) for values in json.loads(done.stdout.splitlines()[-1])]


def main(arguments: list[str]) -> None:
    if arguments[:1] == ["--json"]:
        found = import_module(f"tools.bench.{arguments[1]}").figures()
        print(json.dumps([asdict(figure) for figure in found]))
        return
    if unknown := set(arguments) - set(NAMES):
        raise SystemExit(f"There is no bench {', '.join(sorted(unknown))}; there are {', '.join(NAMES)}.")
    show("Measured", [figure for name in arguments or NAMES for figure in measured(name)])


if __name__ == "__main__":
    main(sys.argv[1:])
