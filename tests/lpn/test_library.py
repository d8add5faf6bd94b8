"""The library in one screen: README's snippet runs, and every name of `lpn` can be imported."""

from __future__ import annotations

import doctest
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import cv2
import pytest

import lpn
import lpn.__main__
import lpn.core
from lpn.core.errors import LPNError
from tools.fixtures import small_worlds
from tools.fixtures.without_torch import run_without_torch

ROOT = Path(__file__).parents[2]


@pytest.fixture
def desk(tmp_path: Path) -> Path:
    """A folder with the files that docs/library.md and the docstring of `lpn` name."""
    data = small_worlds.make_dataset(tmp_path / "ROOT", train=1, test=6)
    (tmp_path / "tiles").symlink_to(data / "test" / "gallery_satellite")
    small_worlds.write(tmp_path / "query.jpg", small_worlds.place(7))
    return tmp_path


def test_readme_snippet_runs(desk: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.chdir(desk)
    snippet = (ROOT / "README.md").read_text(encoding="utf-8").partition("```python\n")[2].partition("```")[0]
    names: dict[str, Any] = {}
    exec(snippet, names)
    assert "0007/0007.png" in capsys.readouterr().out
    assert 0 <= names["figures"]["recall@1"] <= names["figures"]["recall@5"] <= 100
    assert cv2.imread("why.png") is not None


def test_the_library_s_page_runs_in_a_base_install(desk: Path) -> None:
    page = (ROOT / "docs" / "library.md").read_text("utf-8")
    code = "\n".join(re.findall(r"```python\n(.*?)```", page, re.DOTALL))
    done = run_without_torch(f"{code}\nassert 'torch' not in sys.modules", folder=desk)
    assert done.returncode == 0, done.stderr
    assert "1 0007/0007.png" in done.stdout
    assert "no model file" in done.stdout
    assert cv2.imread(str(desk / "why.png")) is not None
    assert not [name for name in lpn.__all__ if f"lpn.{name}" not in code]


def test_the_library_s_page_is_one_screen() -> None:
    assert len((ROOT / "docs" / "library.md").read_text("utf-8").splitlines()) <= 90


def test_help_of_the_library_runs_as_it_says(desk: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(desk)
    examples = doctest.DocTestParser().get_doctest(str(lpn.__doc__), {}, "lpn", None, None)
    said: list[str] = []
    outcome = doctest.DocTestRunner().run(examples, out=said.append)
    assert outcome.attempted >= 7
    assert not outcome.failed, "".join(said)
    assert (desk / "why.png").is_file()


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.pth", b"PK\x03\x04", "a.pth is truncated"),
        ("a.pth", b"version https://git-lfs.github.com/spec/v1", "a.pth is a Git LFS pointer"),
        ("a.pth", b"\x80\x02" + bytes(9) + b".", "Opening a.pth needs the package"),
        ("a.safetensors", b"\x62" + bytes(7) + b"{}", "a.safetensors is truncated"),
        ("a.safetensors", b"\x02" + bytes(7) + b"{}", "Opening a.safetensors needs the package"),
    ],
)
def test_without_torch_a_file_that_is_no_model_is_told_first(
    name: str, content: bytes, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "lpn.models.adapters.load", None)
    (tmp_path / name).write_bytes(content)
    with pytest.raises(LPNError, match=message):
        lpn.load(tmp_path / name)


def test_an_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="'lpn' has no attribute 'nothing'"):
        _ = lpn.nothing


def test_import_needs_neither_numpy_nor_torch() -> None:
    code = "import sys, lpn; assert not {'numpy', 'torch', 'cv2'} & set(sys.modules), sorted(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ([], ["explore"]),
        (["--port", "9000"], ["explore", "--port", "9000"]),
        (["models", "city-lpn"], ["models", "city-lpn"]),
        (["--help"], ["--help"]),
        (["--version"], ["--version"]),
    ],
)
def test_lpn_explorer_is_lpn_explore_unless_it_is_given_a_command(
    given: list[str], expected: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    ran: list[list[str]] = []
    monkeypatch.setattr(lpn.__main__, "run", lambda: ran.append(sys.argv[1:]))
    monkeypatch.setattr(sys, "argv", ["lpn-explorer", *given])
    lpn.__main__.run_explorer()
    assert ran == [expected]
