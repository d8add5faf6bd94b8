"""Shared steps of slow measures: a folder for resuming, kept rows, and the commands of lpn."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from lpn.core.errors import DataError
from lpn.core.files import write_json

_ROOT = Path(__file__).parents[2]
_SOURCES = ("lpn", "explorer", "tools")


@contextmanager
def resumable(name: str) -> Iterator[Path]:
    """Yield a folder of a measure, whose `cache` is the user's cache meanwhile; it is removed when the measure is complete.

    A killed measure leaves it, and goes on there unless a Python file of the project has changed.
    """
    folder, sources = _ROOT / "runs" / "keep" / name, _digest_of_sources()
    mark = folder / "sources"
    if not mark.is_file() or mark.read_text() != sources:
        shutil.rmtree(folder, ignore_errors=True)
        (folder / "cache").mkdir(parents=True)
        mark.write_text(sources)
    before = os.environ.get("LPN_CACHE")
    os.environ["LPN_CACHE"] = str(folder / "cache")
    try:
        yield folder
    finally:
        if before is None:
            del os.environ["LPN_CACHE"]
        else:
            os.environ["LPN_CACHE"] = before
    shutil.rmtree(folder)


def keep_row(file: Path, key: str, measure: Callable[[], Any]) -> Any:
    """Return a row of a JSON file; one that it lacks is measured and added."""
    rows: dict[str, Any] = json.loads(file.read_bytes()) if file.is_file() else {}
    if key not in rows:
        rows[key] = measure()
        write_json(file, rows)
        print(f"{key}: {rows[key]}", file=sys.stderr, flush=True)
    return rows[key]


def run_lpn(*arguments: object) -> None:
    """Run a command of lpn in a process of its own.

    Raises:
        DataError: if it fails; the message has its last line.
    """
    command = [sys.executable, "-m", "lpn", *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        last = (done.stderr.strip() or done.stdout.strip()).splitlines()[-1:]
        raise DataError(f"lpn {arguments[0]} ended with status {done.returncode}: {' '.join(last)}")


def _digest_of_sources() -> str:
    digest = hashlib.sha256()
    for file in sorted(file for package in _SOURCES for file in (_ROOT / package).rglob("*.py")):
        digest.update(file.read_bytes())
    return digest.hexdigest()[:12]
