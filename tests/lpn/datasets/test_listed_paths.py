"""Lists and tables as other systems write them, read like their own."""

from __future__ import annotations

import json
import re
import unicodedata
from collections.abc import Callable
from pathlib import Path

import pytest

from lpn.core.errors import DataError
from lpn.core.lists import decoded, separated
from lpn.datasets import open_dataset
from lpn.datasets.geo import Position, Positions, read_positions
from lpn.datasets.listed_paths import FilesBelow, by_name, listed_path, name_of, plain_path
from lpn.datasets.metadata import columns
from lpn.tasks.notes import Note, add_tags, read_notes, set_note
from lpn.tasks.notes import columns as note_columns
from tools.fixtures import layouts, small_worlds

OTHER_MACHINES = ("C:\\Users\\x\\University-Release\\", "/home/x/University-Release/", "\\\\server\\share\\data\\")


@pytest.mark.parametrize(
    ("text", "plain"),
    [
        ("a/b.jpg", "a/b.jpg"),
        ("a\\b.jpg", "a/b.jpg"),
        (".\\a\\.\\b.jpg", "a/b.jpg"),
        ("./a//b.jpg  ", "a/b.jpg"),
        ("\ufeffa/b.jpg", "a/b.jpg"),
        ("C:\\data\\a.jpg", "C:/data/a.jpg"),
        ("\\\\server\\share\\a.jpg", "/server/share/a.jpg"),
        ("id,40.1,-80.5,.jpg", "id,40.1,-80.5,.jpg"),
        ("", ""),
    ],
)
def test_a_path_of_any_system_has_one_form(text: str, plain: str) -> None:
    assert plain_path(text) == plain
    assert name_of(text) == plain.rpartition("/")[2]


@pytest.mark.parametrize(
    "text", ["../a.jpg", "a/../b.jpg", "a\\..\\b.jpg", "", " / ", "a\nb.jpg", "C:a.jpg", "x:y/a.jpg"]
)
def test_a_path_that_may_lead_elsewhere_is_refused(text: str) -> None:
    with pytest.raises(DataError, match=r"Line 3 of list names the file .*without '\.\.'"):
        listed_path(text, "Line 3 of list")


@pytest.mark.parametrize("text", ["/etc/passwd", "C:\\a.jpg", "\\\\server\\a.jpg"])
def test_an_absolute_path_is_refused_and_never_looked_up(text: str, tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"List names the file .*; expected a path below the data set's folder"):
        listed_path(text, "List")
    assert FilesBelow(tmp_path).find(plain_path(text)) is None


def test_an_absolute_path_of_another_picture_is_no_error_among_names() -> None:
    names = ["test/q/1.jpg", "test/q/2.jpg"]
    assert by_name({"/z/n.jpg": 1, "Test/q/2.JPG": 2}, names, "metadata.csv") == {"test/q/2.jpg": 2}
    with pytest.raises(DataError, match=r"metadata\.csv names the file '/z/n\.jpg'; expected a path below"):
        by_name({"/z/n.jpg": 1}, names, "metadata.csv")
    with pytest.raises(DataError, match=r"metadata\.csv names test/q/2\.jpg twice, also as TEST/q/2\.jpg; keep one"):
        by_name({"test/q/2.jpg": 1, "TEST/q/2.jpg": 2}, names, "metadata.csv")


def test_files_are_found_in_another_case_and_with_letters_composed_otherwise(tmp_path: Path) -> None:
    decomposed = unicodedata.normalize("NFD", "Zürich")
    for name in ("Test/A.JPG", f"{decomposed}/1.jpg", "two/a.jpg", "two/A.jpg"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(b"")
    below = FilesBelow(tmp_path)
    assert below.find("test/a.jpg") == "Test/A.JPG"
    assert below.find("zürich/1.JPG") == f"{decomposed}/1.jpg"
    assert [below.find(f"two/{name}") for name in ("a.jpg", "A.jpg", "a.JPG")] == ["two/a.jpg", "two/A.jpg", None]
    assert below.find("absent/a.jpg") is None


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-16-le", "utf-16-be"])
@pytest.mark.parametrize("lines", ["\n", "\r\n"])
def test_text_of_any_editor_is_decoded(encoding: str, lines: str) -> None:
    text = f"path\tlatitude{lines}test/ä.jpg\t30,25{lines}{lines}\t{lines}"
    table = separated(decoded(text.encode(encoding), "a"), "a")
    assert (table.decimal_comma, list(table.rows)) == (True, [(1, ["path", "latitude"]), (2, ["test/ä.jpg", "30,25"])])
    assert list(separated(f"sep=\t{lines}a,b\tc{lines}", "a").rows) == [(2, ["a,b", "c"])]
    table = separated(decoded(f"path;latitude{lines}a.jpg;30,25{lines}".encode(encoding), "a"), "a")
    assert (table.decimal_comma, list(table.rows)) == (True, [(1, ["path", "latitude"]), (2, ["a.jpg", "30,25"])])
    assert list(separated(f"a;b,c{lines}", "a").rows) == [(1, ["a;b", "c"])]


def respelled(path: str) -> str:
    """The path as another system may write it; a place in it that is no path is unchanged."""
    stem, dot, ending = path.rpartition(".")
    return "./" + (stem + dot + ending.upper()).replace("/", "\\") + "  "


def test_geo_csv_of_another_system_has_the_same_positions(tmp_path: Path) -> None:
    root = small_worlds.map_dataset(small_worlds.make_dataset(tmp_path / "places", train=1, test=3))
    pictures = open_dataset(root).queries("drone")
    right = Positions(root).of(pictures)
    header, *lines = (root / "geo.csv").read_text().splitlines()
    changed = [",".join([respelled(line.split(",")[0]), *line.split(",")[1:]]) for line in lines]
    for encoding in ("utf-8-sig", "utf-16"):
        (root / "geo.csv").write_bytes("\r\n".join([header, *changed, ""]).encode(encoding))
        assert Positions(root).of(pictures) == right
        described = [f"{picture.path.parent.name}/{picture.path.name}" for picture in pictures]
        assert Positions(root).match(["test/query_drone/" + name for name in described]) == right


def test_geo_csv_with_decimal_commas_is_read_where_they_cannot_be_separators() -> None:
    text = "sep=;\r\npath;latitude;longitude;altitude\r\ntest\\q\\1.jpg;30,25;120,5;1,5\r\n"
    assert read_positions(text) == {"test/q/1.jpg": Position(30.25, 120.5, 1.5)}
    with pytest.raises(DataError, match=r"Line 2 of geo\.csv has the latitude '30,25'"):
        read_positions('path,latitude,longitude\na.jpg,"30,25",120.5\n')
    with pytest.raises(DataError, match=r"gives test/q/1\.jpg a second position"):
        read_positions("path,latitude,longitude\ntest/q/1.jpg,1,2\ntest\\q\\1.jpg,1,3\n")


def test_metadata_of_another_system_has_the_same_columns(tmp_path: Path) -> None:
    paths = ["test/query_drone/0001/a.jpg", "test/query_drone/0002/b.jpg"]
    lines = [f"{respelled(path)},{weather}" for path, weather in zip(paths, ("rain", "sun"), strict=True)]
    (tmp_path / "metadata.csv").write_bytes("\r\n".join(["path,weather", *lines]).encode("utf-16"))
    (column,) = columns(tmp_path, paths)
    assert column.values.tolist() == ["rain", "sun"]


def test_a_note_of_a_file_name_with_a_backslash_is_read_back(tmp_path: Path) -> None:
    for text in ("hello", "again"):
        set_note(tmp_path / "notes.csv", "a\\b.jpg", "x", text)
    add_tags(tmp_path / "notes.csv", ["a\\b.jpg"], "y")
    stored = read_notes(tmp_path / "notes.csv")
    assert list(stored.values()) == [Note(("x", "y"), "again")]
    assert [column.values.tolist() for column in note_columns(stored, ["a\\b.jpg"])] == [["x y"], ["again"]]


def test_notes_of_another_system_keep_their_queries(tmp_path: Path) -> None:
    text = "path,tags,note\r\n.\\test\\query_drone\\0005\\1.jpg,night,=1+1\r\n"
    (tmp_path / "notes.csv").write_bytes(text.encode("utf-16"))
    notes = read_notes(tmp_path / "notes.csv")
    assert {path: (note.tags, note.text) for path, note in notes.items()} == {
        "test/query_drone/0005/1.jpg": (("night",), "=1+1")
    }


def contents(root: Path) -> tuple[dict[str, list[tuple[str, int, str]]], list[list[tuple[list[int], list[int]]]]]:
    """Return file, place, and group of each picture of a data set by list, and the listed tiles of each task."""
    dataset = open_dataset(root)
    lists = {
        name: [(picture.path.relative_to(root).as_posix(), picture.label, picture.group) for picture in of]
        for name, of in dataset.lists().items()
    }
    truths = [dataset.truth(task) or [] for task in dataset.tasks()]
    return lists, [[(of.good.tolist(), of.semi.tolist()) for of in truth] for truth in truths]


def rewrite(file: Path, text: str) -> None:
    file.write_bytes(text.encode("utf-16"))


PAIRS = "satellite,drone,split\ntiles/a.jpg,drones/1.jpg,train\ntiles/a.jpg,drones/2.jpg,train\nb.jpg,3.jpg,test\n"


def respell_vigor(root: Path) -> None:
    for file in (root / "splits").rglob("*.txt"):
        whole, city, lines = file.name == "satellite_list.txt", file.parent.name, []
        for row in map(str.split, file.read_text().splitlines()):
            for at in range(len(row)) if whole else (0, *range(1, len(row), 3)):
                folder = "satellite" if whole or at else "panorama"
                row[at] = respelled(f"{city}/{folder}/{row[at]}").strip()
            lines.append(" ".join(row))
        rewrite(file, "\n".join(lines))


def respell_gta(root: Path) -> None:
    for file in root.glob("*.json"):
        entries = json.loads(file.read_text())
        for entry in entries:
            for key in ("drone_img_dir", "sate_img_dir"):
                entry[key] = re.split(r"[\\/]x\.", respelled(f"{entry[key]}/x.png"))[0]
            entry["drone_img_name"] = name_of(respelled(entry["drone_img_name"]))
            for key in ("pair_pos_sate_img_list", "pair_pos_semipos_sate_img_list"):
                entry[key] = [respelled(f"satellite/{name}") for name in entry[key]]
        file.write_text(json.dumps(entries))


@pytest.mark.parametrize(
    ("make", "respell"),
    [(layouts.vigor, respell_vigor), (layouts.gta, respell_gta)],
    ids=["vigor", "gta"],
)
def test_lists_of_another_system_are_the_same(
    tmp_path: Path, make: Callable[[Path], Path], respell: Callable[[Path], None]
) -> None:
    root = make(tmp_path / "set")
    right = contents(root)
    respell(root)
    assert contents(root) == right


def test_two_spellings_of_one_tile_are_one_place(tmp_path: Path) -> None:
    root = layouts.pairs(tmp_path / "mine", PAIRS.replace("tiles/a.jpg,drones/2", "tiles/a.JPG,drones/2"))
    assert len({picture.label for picture in open_dataset(root).train("drone")}) == 1


def test_cvact_finds_pictures_in_another_case(tmp_path: Path) -> None:
    root = layouts.cvact(tmp_path / "cvact")
    right = contents(root)
    for file in [*root.rglob("*.jpg")]:
        file.rename(file.with_suffix(".JPG"))
    assert [len(of) for of in contents(root)[0].values()] == [len(of) for of in right[0].values()]


@pytest.mark.parametrize("before", ["", *OTHER_MACHINES])
def test_denseuav_of_another_system_has_the_same_positions(tmp_path: Path, before: str) -> None:
    """Its list names a place by the folder above a file, whatever stands before it."""
    root = layouts.denseuav(tmp_path / "denseuav")
    dataset = open_dataset(root)
    right = dataset.coordinates(dataset.queries("drone")).tolist()
    lines = [line.partition(" ") for line in (root / "Dense_GPS_ALL.txt").read_text().splitlines()]
    rewrite(root / "Dense_GPS_ALL.txt", "\r\n".join(f"{before}{respelled(path)} {rest}" for path, _, rest in lines))
    again = open_dataset(root)
    assert again.coordinates(again.queries("drone")).tolist() == right
