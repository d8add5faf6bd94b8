"""Every module of the library and the app is reached from the quick tests, and every other file is in the wheel."""

from __future__ import annotations

import ast
import tomllib
from pathlib import Path

from tools.fixtures.imports import modules as modules_of
from tools.fixtures.imports import nodes

ROOT = Path(__file__).parents[1]
# Modules that pyproject.toml names; tests run them as `lpn` and as `lpn explore`.
ENTRY_POINTS = {"lpn.__main__", "explorer.cli", "lpn.flight.locate.source"}


def modules() -> dict[str, Path]:
    """All modules of the library, the app, the tools, and the tests, by name."""
    tops = ("lpn", "explorer", "tools", "tests")
    return {name: file for top in tops for name, file in modules_of(ROOT, top).items()}


def imports(name: str, file: Path, known: dict[str, Path]) -> set[str]:
    """The modules that a module imports, anywhere in it, and the packages that hold them."""
    found = set()
    for node in nodes(file):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            package = name.split(".") if file.name == "__init__.py" else name.split(".")[:-1]
            base = (
                [*package[: len(package) - node.level + 1], *filter(None, [node.module])]
                if node.level
                else [node.module or ""]
            )
            found |= {".".join(base), *(".".join([*base, alias.name]) for alias in node.names)}
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and node.value in known:
            found.add(node.value)  # imported by its name, such as a command
    found |= {".".join(one.split(".")[:end]) for one in found for end in range(1, one.count(".") + 1)}
    return found & known.keys()


def quick(file: Path) -> bool:
    """Return True if a test file has a test that is not slow."""
    return "\npytestmark = pytest.mark.slow\n" not in file.read_text()


# Rooms whose modules are found by their folder, or by entry points.
FOUND = (
    *("lpn.datasets.layouts.", "lpn.models.adapters.methods.", "lpn.sources.kinds.", "lpn.cli."),
    *("lpn.flight.commands.", "explorer.screen.panels."),
)


def test_every_module_is_reached_by_the_quick_tests() -> None:
    known = modules()
    waiting = {name for name, file in known.items() if name.split(".")[0] == "tests" and quick(file)}
    waiting |= ENTRY_POINTS | {name for name in known if name.startswith(FOUND)}
    reached: set[str] = set()
    while waiting:
        name = waiting.pop()
        reached.add(name)
        waiting |= imports(name, known[name], known) - reached
    assert not {name for name in known if name.split(".")[0] in ("lpn", "explorer")} - reached


def test_the_wheel_holds_every_template_style_sheet_and_script() -> None:
    patterns = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["package-data"]
    for package in ("lpn", "explorer"):
        packed = {file for pattern in patterns[package] for file in (ROOT / package).glob(pattern)}
        files = {file for file in (ROOT / package).rglob("*") if file.is_file() and "__pycache__" not in file.parts}
        assert not {file for file in files - packed if file.suffix != ".py"}


def test_the_wheel_holds_every_folder_of_the_assets_and_no_link() -> None:
    patterns = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["package-data"]
    folders = {folder for folder in (ROOT / "assets").iterdir() if folder.is_dir() and folder.name != "__pycache__"}
    packed = {
        name.removeprefix("lpn.assets."): found for name, found in patterns.items() if name.startswith("lpn.assets.")
    }
    assert packed == {folder.name: ["**/*"] for folder in folders}  # setup.py makes a package of each
    assert not [path for folder in folders for path in folder.rglob("*") if path.is_symlink() or path.name[0] == "."]
