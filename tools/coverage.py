"""Lines and branches of each room that the tests run: `python -m tools.coverage [--out FILE] [PYTEST'S ARGUMENTS]`.

`make coverage` measures the quick tests, and writes the committed tools/coverage.json. The argument `-m ''` adds slow tests.
Processes of tests count, unless they are killed or have another environment. pyproject.toml has the settings.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory

from coverage import Coverage
from rich.console import Console
from rich.table import Table

from lpn.core.files import write_atomic

_COUNTS = {
    "lines": "num_statements",
    "covered_lines": "covered_lines",
    "branches": "num_branches",
    "covered_branches": "covered_branches",
}
Rooms = dict[str, dict[str, float]]


def run_tests(data: Path, arguments: list[str]) -> int:
    """Run pytest in this folder, write its coverage beside `data`, and return its exit status."""
    command = [sys.executable, "-m", "coverage", "run", "-m", "pytest", *arguments]
    return subprocess.run(command, env=os.environ | {"COVERAGE_FILE": str(data)}, check=False).returncode


def by_room(data: Path) -> Rooms:
    """Return the counts of `_COUNTS` and the percentage of each room, and of all as "total".

    A room is a folder of two names such as lpn/core, with all below it, or the files of a package beside its folders.

    Raises:
        coverage.CoverageException: if nothing was recorded beside `data`.
    """
    recorded, report = Coverage(data_file=str(data)), data.with_name("report.json")
    recorded.combine([str(data.parent)])
    recorded.json_report(outfile=str(report))
    counts: dict[str, Counter[str]] = {}
    for file, found in json.loads(report.read_text("utf-8"))["files"].items():
        folders = Path(file).parts[:-1]
        for room in ("/".join(folders[:2]), "total"):
            counts.setdefault(room, Counter()).update({name: found["summary"][key] for name, key in _COUNTS.items()})
    return {room: {**found, "percent": _percent(found)} for room, found in sorted(counts.items())}


def _percent(found: Mapping[str, int]) -> float:
    """The share of lines and branches that ran; 100 of none."""
    most = found["lines"] + found["branches"]
    return round(100 * (found["covered_lines"] + found["covered_branches"]) / most, 1) if most else 100.0


def show(rooms: Rooms) -> None:
    """Print the rooms as a table, the least covered first."""
    table = Table("room", "lines", "covered", "branches", "covered", "%")
    for room, found in sorted(rooms.items(), key=lambda item: (item[0] == "total", item[1]["percent"])):
        table.add_row(room, *(f"{found[name]:,}" for name in (*_COUNTS, "percent")))
    Console().print(table)


def main(arguments: list[str]) -> None:
    """Run the tests, print the table, and write it where asked; exits as pytest does."""
    parser = argparse.ArgumentParser(prog="python -m tools.coverage", description=__doc__, allow_abbrev=False)
    parser.add_argument("--out", type=Path, help="a JSON file for the counts")
    options, given = parser.parse_known_args(arguments)
    with TemporaryDirectory() as folder:
        data = Path(folder) / "data"
        status = run_tests(data, given)
        rooms = by_room(data)
    show(rooms)
    if options.out:
        text = json.dumps({"arguments": given, "pytest": status, "rooms": rooms}, indent=1) + "\n"
        write_atomic(options.out, text.encode())
    sys.exit(status)


if __name__ == "__main__":
    main(sys.argv[1:])
