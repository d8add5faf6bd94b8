"""The rules of docs/architecture.md, read from the imports: which package may import which, and where viser's privates are."""

from __future__ import annotations

import ast
from collections import defaultdict
from pathlib import Path

import pytest

from tools.fixtures.imports import EXPLORER, LPN, imports, mermaid, modules, room

ROOT = Path(__file__).parents[1]
FLOORS = {"lpn": LPN, "explorer": EXPLORER}


@pytest.mark.parametrize("package", FLOORS)
def test_imports_run_one_way(package: str) -> None:
    floor = {name: number for number, names in enumerate(FLOORS[package]) for name in names}
    wrong = [
        f"{found.file}:{found.line}: {found.importer} imports {found.imported}"
        for found in imports(ROOT, package)
        if (above := room(found.importer)) != (below := room(found.imported))
        and above in floor  # the package's own __init__ and __main__ may name any room
        and floor[above] <= floor.get(below, -1)
    ]
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize("package", FLOORS)
def test_every_room_has_a_floor(package: str) -> None:
    rooms = {room(name) for name in modules(ROOT, package)} - {"", "__main__"}
    assert rooms == {name for names in FLOORS[package] for name in names}


def test_no_room_of_lpn_imports_the_explorer() -> None:
    wrong = [
        f"{found.file}:{found.line}: {found.importer} imports {found.imported}"
        for found in imports(ROOT, "lpn", "explorer")
        if found.importer.split(".")[0] == "lpn" and found.imported.split(".")[0] == "explorer"
    ]
    assert not wrong, "\n".join(wrong)


def test_tools_and_tests_import_each_other_through_fixtures_only() -> None:
    wrong = [
        f"{found.file}:{found.line}: {found.importer} imports {found.imported}"
        for found in imports(ROOT, "tests", "tools")
        if found.importer.split(".")[0] != found.imported.split(".")[0] and room(found.imported) not in ("", "fixtures")
    ]
    assert not wrong, "\n".join(wrong)


def test_private_attributes_of_viser_are_touched_in_viser_compat_only() -> None:
    wrong = []
    for name, path in modules(ROOT, "explorer").items():
        if name == "explorer.server.viser_compat":
            continue
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            where = f"{path.relative_to(ROOT)}:{getattr(node, 'lineno', 0)}"
            if isinstance(node, ast.Attribute) and _private(node.attr) and not _own(node.value):
                wrong.append(f"{where}: {ast.unparse(node)}")
            elif isinstance(node, ast.Constant) and isinstance(node.value, str) and node.value in _SPELT:
                wrong.append(f"{where}: {node.value!r}")
            elif isinstance(node, ast.Import | ast.ImportFrom):
                names = [alias.name for alias in node.names]
                paths = [f"{node.module}.{name}" for name in names] if isinstance(node, ast.ImportFrom) else names
                wrong += [f"{where}: {path}" for path in paths if path.startswith("viser") and "._" in path]
    assert not wrong, "\n".join(wrong)


# Private attributes that `getattr` could name.
_SPELT = ("_impl", "_websock_connection", "_websock_server")


def _private(name: str) -> bool:
    return name.startswith("_") and not name.startswith("__")


def _own(value: ast.expr) -> bool:
    return isinstance(value, ast.Name) and value.id in ("self", "cls")


def test_no_two_classes_have_one_name() -> None:
    found = defaultdict(list)
    for package in ("lpn", "explorer", "tools"):
        for name, path in modules(ROOT, package).items():
            for node in ast.walk(ast.parse(path.read_text("utf-8"))):
                if isinstance(node, ast.ClassDef) and not _private(node.name):
                    found[node.name].append(name)
    assert not {name: places for name, places in found.items() if len(places) > 1}


@pytest.mark.parametrize("package", FLOORS)
def test_the_drawn_graph_is_that_of_the_code(package: str) -> None:
    page = (ROOT / "docs" / "architecture.md").read_text("utf-8")
    assert mermaid(ROOT, package, FLOORS[package]) in page, "Draw it again: python -m tools.fixtures.imports"
