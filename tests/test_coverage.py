"""What `python -m tools.coverage` counts: rooms, branches, and processes that tests start in other folders."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
ROOM = """
def sign(value):
    if value > 0:
        return 1
    return -1


def left_by_exit():
    import os
    os._exit(0)
"""
TESTS = """
import subprocess
import sys

from lpn.room.inner.module import sign


def test_one_branch():
    assert sign(2) == 1


def test_a_process(tmp_path):
    command = "from lpn.room.inner.module import left_by_exit; left_by_exit()"
    subprocess.run([sys.executable, "-c", command], cwd=tmp_path, check=True)


def test_that_fails():
    assert sign(3) == 2
"""


def test_lines_and_branches_are_counted_by_room_with_started_processes(tmp_path: Path) -> None:
    settings = (ROOT / "pyproject.toml").read_text("utf-8")
    (tmp_path / "pyproject.toml").write_text(settings[settings.index("[tool.coverage.run]") :], "utf-8")
    inner = tmp_path / "lpn" / "room" / "inner"
    inner.mkdir(parents=True)
    for folder in (inner, inner.parent, inner.parents[1]):
        (folder / "__init__.py").touch()
    (inner / "module.py").write_text(ROOM)
    (inner.parents[1] / "unused.py").write_text("NEVER = 1\n")
    (tmp_path / "test_room.py").write_text(TESTS)
    # The tests themselves may run under coverage, whose settings started processes would take.
    environment = {name: value for name, value in os.environ.items() if not name.startswith("COVERAGE")}
    environment["PYTHONPATH"] = os.pathsep.join(map(str, (tmp_path, ROOT)))
    command = [sys.executable, "-m", "tools.coverage", "--out", "found.json", "-p", "no:cacheprovider", "test_room.py"]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 1, done.stderr
    assert "1 failed, 2 passed" in done.stdout
    found = json.loads((tmp_path / "found.json").read_text("utf-8"))
    assert (found["arguments"], found["pytest"]) == (["-p", "no:cacheprovider", "test_room.py"], 1)
    room = {"lines": 7, "covered_lines": 6, "branches": 2, "covered_branches": 1, "percent": 77.8}
    package = {"lines": 1, "covered_lines": 0, "branches": 0, "covered_branches": 0, "percent": 0.0}
    total = {"lines": 8, "covered_lines": 6, "branches": 2, "covered_branches": 1, "percent": 70.0}
    assert found["rooms"] == {"lpn": package, "lpn/room": room, "total": total}
    assert sorted(path.name for path in tmp_path.iterdir() if path.is_file()) == [
        "found.json",
        "pyproject.toml",
        "test_room.py",
    ]
