"""The workflow of CI runs the Makefile's targets, on the Pythons that pyproject.toml promises."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Any

import yaml

ROOT = Path(__file__).parents[1]
JOBS: dict[str, Any] = yaml.safe_load((ROOT / ".github/workflows/ci.yml").read_text("utf-8"))["jobs"]
CLASSIFIER = "Programming Language :: Python :: 3."


def test_each_command_is_a_target_of_the_makefile() -> None:
    targets = re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text("utf-8"), re.MULTILINE)
    commands = {step["run"] for job in JOBS.values() for step in job["steps"] if "run" in step}
    assert {"make check", "make test", "make keep", "make wheel"} <= commands
    assert commands <= {f"make {target}" for target in targets}


def test_each_promised_python_is_tested() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    promised = [line.split()[-1] for line in project["classifiers"] if line.startswith(CLASSIFIER)]
    assert JOBS["test"]["strategy"]["matrix"]["python"] == promised
    assert project["requires-python"] == f">={promised[0]}"
    used = {
        step["with"]["python-version"]
        for job in JOBS.values()
        for step in job["steps"]
        if step.get("uses", "").startswith("actions/setup-python")
    }
    assert used == {promised[0], "${{ matrix.python }}"}
