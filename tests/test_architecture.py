"""The rules of docs/architecture.md, read from the imports: which package may import which, and where viser's privates are."""

from __future__ import annotations

import ast
from collections import defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest

from tools.fixtures.imports import EXPLORER, LPN, imports, mermaid, modules, nodes, room

ROOT = Path(__file__).parents[1]
FLOORS = {"lpn": LPN, "explorer": EXPLORER}


@pytest.mark.parametrize("package", FLOORS)
def test_imports_run_one_way(package: str) -> None:
    floor = {name: number for number, names in enumerate(FLOORS[package]) for name in names}
    wrong = [
        f"{one.file}:{one.line}: {one.importer} imports {one.imported}"
        for one in imports(ROOT, package)
        if (above := room(one.importer)) != (below := room(one.imported))
        and above in floor  # the package's own __init__ and __main__ may name any room
        and floor[above] <= floor.get(below, -1)
    ]
    assert not wrong, "\n".join(wrong)


def test_no_room_of_the_model_and_its_answers_imports_those_of_flights() -> None:
    rooms = {"models", "retrieval", "explain", "tasks", "analysis", "drawing"}
    flights = {"flight.files", "flight.maps", "flight.locate", "flight.live"}
    found = list(imports(ROOT, "lpn"))
    above = defaultdict(list)
    for one in found:
        above[one.importer].append(one)
    wrong = set()
    for start in (name for name in modules(ROOT, "lpn") if room(name) in rooms):
        reached, ahead = {start}, [start]
        while ahead:  # what a room imports may import flights in its place
            for one in above[ahead.pop()]:
                if room(one.imported) in flights:
                    wrong.add(f"{one.file}:{one.line}: {one.importer} imports {one.imported}, reached from {start}")
                elif one.imported not in reached:
                    reached.add(one.imported)
                    ahead.append(one.imported)
    assert not wrong, "\n".join(sorted(wrong))


# Rooms outside lpn.flight that may import it: windows of a map in stores and in training, and the explorer's own photos.
# All else reaches flights by entry points.
REACHES_FLIGHTS = {
    "lpn.cli", "lpn.index", "lpn.training", "explorer.cli", "explorer.compute", "explorer.flight", "explorer.opening",
    "explorer.screen", "explorer.uploads", "explorer.workspace",
}  # fmt: skip


def test_flights_are_reached_from_a_short_list_of_rooms() -> None:
    found = {
        ".".join(one.importer.split(".")[:2])
        for one in imports(ROOT, "lpn", "explorer")
        if one.imported.startswith("lpn.flight") and not one.importer.startswith("lpn.flight")
    }
    assert found == REACHES_FLIGHTS


@pytest.mark.parametrize("package", FLOORS)
def test_every_room_has_a_floor(package: str) -> None:
    rooms = {room(name) for name in modules(ROOT, package)} - {"", "__main__"}
    named = {name for names in FLOORS[package] for name in names}
    assert rooms == named | (
        {"flight"} if package == "lpn" else set()
    )  # the rooms of lpn.flight have floors of their own


def test_no_room_of_lpn_imports_the_explorer() -> None:
    wrong = [
        f"{one.file}:{one.line}: {one.importer} imports {one.imported}"
        for one in imports(ROOT, "lpn", "explorer")
        if one.importer.split(".")[0] == "lpn" and one.imported.split(".")[0] == "explorer"
    ]
    assert not wrong, "\n".join(wrong)


def test_tools_and_tests_import_each_other_through_fixtures_only() -> None:
    # A tool's own tests; tests of what packs the world, and of its commands.
    allowed = {
        "world": ("tools_world", "test_assets", "test_docs"),
        "crossval": ("test_crossval",),
        "keep": ("test_keep",),
        "bench": ("test_bench", "test_keep"),
    }
    wrong = [
        f"{one.file}:{one.line}: {one.importer} imports {one.imported}"
        for one in imports(ROOT, "tests", "tools")
        if one.importer.split(".")[0] != one.imported.split(".")[0]
        and room(one.imported) not in ("", "fixtures")
        and room(one.importer) not in allowed.get(room(one.imported), ())
    ]
    assert not wrong, "\n".join(wrong)


def test_private_attributes_of_viser_are_touched_in_viser_compat_only() -> None:
    wrong = []
    for name, path in modules(ROOT, "explorer").items():
        if name == "explorer.server.viser_compat":
            continue
        for node in nodes(path):
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
    places = defaultdict(list)
    for package in ("lpn", "explorer", "tools"):
        for name, path in modules(ROOT, package).items():
            for node in nodes(path):
                if isinstance(node, ast.ClassDef) and not _private(node.name):
                    places[node.name].append(name)
    assert not {name: where for name, where in places.items() if len(where) > 1}


def test_no_public_type_has_two_meanings() -> None:
    places = defaultdict(list)
    for package in ("lpn", "explorer"):
        for module, path in modules(ROOT, package).items():
            for name in _types(ast.parse(path.read_text("utf-8")).body):
                places[name].append(module)
    assert not {name for name, where in places.items() if len(where) > 1}


def _types(body: Sequence[ast.stmt]) -> Iterator[str]:
    """Yield the public names of the classes, type aliases, and type variables of a module, which are in CamelCase."""
    for node in body:
        match node:
            case ast.If() | ast.Try():
                yield from _types([*node.body, *node.orelse])
            case (
                ast.ClassDef(name=name)
                | ast.Assign(targets=[ast.Name(id=name)])
                | ast.AnnAssign(target=ast.Name(id=name))
            ):
                if name[0].isupper() and not name.isupper():
                    yield name


@pytest.mark.parametrize("package", FLOORS)
def test_the_drawn_graph_is_that_of_the_code(package: str) -> None:
    page = (ROOT / "docs" / "architecture.md").read_text("utf-8")
    assert mermaid(ROOT, package, FLOORS[package]) in page, "Draw it again: python -m tools.fixtures.imports"
