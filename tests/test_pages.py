"""The pages of measured figures are rendered from their data."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


def pages(*arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "tools.pages", *arguments]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)


@pytest.fixture
def docs(tmp_path: Path) -> Path:
    shutil.copytree(ROOT / "docs" / "measured", tmp_path / "measured")
    for file in (ROOT / "docs").glob("*.*"):
        if file.suffix in (".md", ".png", ".jpg"):
            shutil.copy(file, tmp_path)
    return tmp_path


def test_pages_are_what_their_data_say() -> None:
    done = pages("--check")
    assert done.returncode == 0, done.stdout + done.stderr


def test_a_figure_that_no_data_file_has_is_found(docs: Path) -> None:
    page = docs / "evaluation.md"
    page.write_text(page.read_text("utf-8").replace("60.00", "61.00", 1), "utf-8")
    template = docs / "measured" / "reproduction.md.j2"
    lines = [
        "| n = 4 | 71 |",
        "LPN gains 19.4 points.",
        "Version `1.2` and table | `n` | of {{ (1 / 2) | figure }} are none.",
    ]
    template.write_text(template.read_text("utf-8") + "\n".join(lines) + "\n", "utf-8")
    done = pages("--check", "--docs", str(docs))
    assert done.returncode == 1
    said = done.stdout.splitlines()
    assert [line.endswith(text) for line, text in zip(said[:2], lines, strict=False)] == [True, True]
    assert said[2:] == [
        f"docs/{page}.md differs from its data in docs/measured; run python -m tools.pages."
        for page in ("reproduction", "evaluation")
    ]


def test_every_set_of_figures_names_its_source() -> None:
    def made(value: dict[str, object]) -> bool:
        return {"command", "version", "machine", "date"} <= set(value)

    data = json.loads((ROOT / "docs" / "measured" / "reproduction.json").read_bytes())
    for table in data["tables"].values():
        rows = [row for row in table["rows"] if row.get("mean")]
        assert rows
        assert all(row["measured"] and all(map(made, row["measured"].values())) for row in rows)
    for page in ("evaluation", "recipes"):
        for name, figures in json.loads((ROOT / "docs" / "measured" / f"{page}.json").read_bytes()).items():
            if name in ("format", "paper") or not figures.get("runs", True):
                continue
            assert {"command", "seed", "commit", "machine", "date"} <= set(figures["source"]), name
