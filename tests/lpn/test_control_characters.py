"""Names, paths, and metadata that hold commands for a terminal: none of them reaches a terminal, a table, or a page."""

from __future__ import annotations

import io
import os
import re
import shlex
import shutil
import subprocess
import sys
from contextlib import redirect_stderr, redirect_stdout, suppress
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from rich.progress import Progress
from rich.table import Table

from lpn.cli import main
from lpn.core import notebook_html
from lpn.core.consoles import Console, plain_streams
from lpn.core.files import printable
from lpn.flight.files import Flight, Frame, write_flight
from tools.fixtures import small_worlds

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="other systems allow few of these names")

# Colours, the window's title, C0, C1 and DEL, controls and marks of the direction of writing, and line separators.
EVIL = "\x1b[31m\x1b]0;title\x07\x9b31m\x7f\x08\u202egpj\u2066\u2069\u200e\u200f\u061c\u2028\u2029"
# Bytes that are not UTF-8, in names of files alone.
NAME = EVIL + "\udce9"
SHOWN = printable(EVIL)


def evil(text: str) -> str:
    """The characters of a text that must not leave."""
    return "".join(sorted({c for c in text if c not in "\n\t" and printable(c) != c}))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, model_file: Path) -> Path:
    """A data set `places`, a map, a flight, and models, all with such names, and metadata of pictures and models."""
    folder = tmp_path_factory.mktemp("evil") / f"all{EVIL}"
    # OpenCV crashes where it writes to a name that is not UTF-8.
    root = small_worlds.make_dataset(folder / "new", train=1, test=4).rename(folder / f"places{NAME}")
    lines = ["path,weather,=b" + EVIL]
    for query in sorted((root / "test" / "query_drone").rglob("*.png")):
        renamed = query.with_name(f"{query.stem}{EVIL}.png")
        query.rename(renamed)
        lines.append(f'"{renamed.relative_to(root).as_posix()}","rain{EVIL}",1')
    lines[0] = lines[0].replace("=", "")
    (root / "metadata.csv").write_text("\n".join(lines) + "\n")
    (folder / "models").mkdir()
    for name in ("first", "second"):
        shutil.copy(model_file, folder / "models" / f"{name}{EVIL}.onnx")
    (folder / "models" / f"third{NAME}.safetensors").write_bytes(b"damaged")
    (folder / "broken").mkdir()
    torch.save(small_worlds.make_network().state_dict(), folder / "broken" / "net.pth")
    (folder / "broken" / "opts.yaml").write_text(f'h: "256{EVIL.encode("unicode_escape").decode()}"\n')
    return folder


def found(folder: Path, start: str) -> str:
    return str(next(file for file in sorted(folder.iterdir()) if file.name.startswith(start)))


def fly(folder: Path) -> tuple[str, str]:
    """Write a map and a flight over it with such names; return their paths."""
    rasterio = pytest.importorskip("rasterio")
    land = cv2.GaussianBlur(np.random.default_rng(0).integers(0, 255, (300, 300, 3), np.uint8), (0, 0), 1.5)
    file = folder / f"town{EVIL}.tif"
    place = rasterio.Affine(0.5, 0, 500_000, 0, -0.5, 5_200_000)
    kind = {"driver": "GTiff", "width": 300, "height": 300, "count": 3, "dtype": "uint8", "crs": "EPSG:32632"}
    with rasterio.open(file, "w", transform=place, **kind) as written:
        written.write(land.transpose(2, 0, 1))
        written.update_tags(TIFFTAG_IMAGEDESCRIPTION=EVIL)
    (folder / "photos").mkdir()
    photo = folder / "photos" / f"one{EVIL}.png"
    small_worlds.write(photo, np.ascontiguousarray(land[60:240, 60:240]))
    frame = Frame(photo.name, photo, 180, 180, 0.0, 46.9516, 9.0010, 80.0, None, None, 0.0, "gimbal", -90.0, 0.0, 58.0)
    write_flight(Flight(f"monday{EVIL}", (frame,), (f"a note{EVIL}",)), folder / f"flight{EVIL}")
    return str(file), str(folder / f"flight{EVIL}")


COMMANDS = {
    "failures": ("{data} --model {model} --where 'weather ~ rain' --csv {out}.csv", 0),
    "doctor opts.yaml": ("--model {broken}/net.pth", 2),
    "compare": ("{data} --model {model} {second} --table {out}.tex", 0),
    "report": ("{data} --model {model} --query {query} --out {out}.html", 0),
    "explain --over": ("{data} --model {model} --query {query} --over rotation --step 180 --csv {out}.csv", 0),
    "doctor": ("{models}", 1),
    "locate": ("--map {map} --flight {flight} --matcher sift --out {out}.csv", 0),
    f"evaluate --data{EVIL}": ("", 2),
    EVIL: ("", 2),
}


@pytest.mark.parametrize("case", COMMANDS)
def test_no_command_passes_on_what_a_terminal_obeys(
    case: str, folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    models = folder / "models"
    places = {"data": found(folder, "places"), "model": found(models, "first"), "second": found(models, "second")}
    places |= {"broken": str(folder / "broken"), "out": str(tmp_path / "out"), "models": str(models)}
    arguments, status = COMMANDS[case]
    if "{map}" in arguments:
        places["map"], places["flight"] = fly(tmp_path)
    query = next((Path(places["data"]) / "test" / "query_drone").rglob("*.png"))
    places["query"] = query.parent.name
    words = [case] if case == EVIL else [*case.split(" ")[:1], *(["--data" + EVIL] if EVIL in case else [])]
    ended = 0
    try:
        ended = main.main([*words, *(argument.format(**places) for argument in shlex.split(arguments))])
    except SystemExit as error:  # of the options' parser
        ended = int(error.code or 0)
    said = capsys.readouterr()
    assert ended == status, said.out + said.err
    assert evil(said.out) == evil(said.err) == ""
    assert said.out + said.err
    for file in filter(Path.is_file, tmp_path.glob("out*")):
        text = file.read_text("utf-8")
        assert evil(text) == "", file.name
        assert SHOWN.partition("]")[0] in text or file.suffix in (".csv", ".html", ".tex")


def test_no_other_console_prints() -> None:
    root = Path(main.__file__).parents[2]
    files = [file for package in ("lpn", "explorer") for file in sorted((root / package).rglob("*.py"))]
    assert files
    rich = "from rich.console import Console"
    importing = [file.relative_to(root).as_posix() for file in files if rich in file.read_text("utf-8")]
    assert importing == []


def test_consoles_clean_texts_and_keep_colours_bars_and_lines() -> None:
    file = io.StringIO()
    console = Console(file=file, force_terminal=True, color_system="standard", width=200)
    table = Table(title=EVIL)
    table.add_column(EVIL)
    table.add_row(NAME)
    console.print(table, NAME, f"[red]colour[/red]\ta{EVIL}", "two\nlines")
    with Progress(console=console) as bar:
        bar.add_task(NAME, total=1)
    written = file.getvalue()
    assert set(evil(written)) == {"\x1b", "\r"}
    assert "\x1b[31mcolour\x1b[0m" in written
    assert "two\nlines" in written
    assert "\x1b[31m\x1b]0;" not in written
    assert "\x1b]0" not in written
    assert "?]0;title" in written


def test_streams_are_plain_but_for_a_library_that_prints_colours() -> None:
    out, err = io.StringIO(), io.StringIO()
    with redirect_stdout(out), redirect_stderr(err):
        with plain_streams():
            print(f"one{NAME}\ttwo\nthree")
            print(NAME, file=sys.stderr)
            sys.stderr.writelines([f"{NAME}\n", "\rover"])
            with plain_streams(colours=True):
                print("\x1b[1mbold\x1b[0m\x1b]0;title\x07")
        assert (sys.stdout, sys.stderr) == (out, err)
    assert err.getvalue() == f"{printable(NAME)}\n" * 2 + "?over"
    assert out.getvalue() == f"one{printable(NAME)}\ttwo\nthree\n\x1b[1mbold\x1b[0m?]0;title?\n"


def on_terminal(code: str) -> tuple[int, str]:
    """The status of Python code run on a terminal, and what the terminal received."""
    ours, its = os.openpty()
    environment = {**os.environ, "TERM": "xterm-256color", "NO_COLOR": "", "LPN_LOG": ""}
    with subprocess.Popen([sys.executable, "-c", code], stdout=its, stderr=its, env=environment) as process:
        os.close(its)
        received = b""
        with suppress(OSError):  # the end of a terminal that nobody writes to
            while piece := os.read(ours, 10_000):
                received += piece
    os.close(ours)
    return process.returncode, received.decode()


def test_a_stop_shows_the_cursor_that_a_bar_hid() -> None:
    opened = "from lpn.core import consoles, progress, shutdown\nwith consoles.plain_streams():\n "
    assert on_terminal(f"{opened}shutdown.exit_now(3)") == (3, "\x1b[?25h" * 2)
    status, received = on_terminal(
        f"{opened}with consoles.progress_bars(): progress.report_progress('Reading', 1, 3); shutdown.exit_now(4)"
    )
    assert status == 4
    assert received.endswith("\x1b[?25h" * 2)


def test_the_help_and_the_errors_of_every_command_keep_their_colours() -> None:
    code = """
import sys
from contextlib import suppress
from lpn.cli.main import commands, main
for name in commands():
    for option in ("--help", "--nonsense"):
        print("command", name, option, flush=True)
        with suppress(SystemExit):
            main([name, option])
"""
    status, received = on_terminal(code)
    assert status == 0
    for told in received.split("command ")[1:]:
        assert "?[" not in told, told[:300]
    assert "\x1b[1m" in received


def test_a_terminal_gets_bars_and_spinners_whole_and_no_command_of_a_name() -> None:
    code = """
import logging, sys
from lpn.core import consoles, log
from lpn.core.progress import report_progress
with consoles.plain_streams(), log.log_to_stderr("info"):
    with consoles.progress_bars():
        report_progress("Describing tiles\x1b]0;title\x07", 1, 3)
        print("out \x1b[2J")
        print("err \x1b[2J", file=sys.stderr)
        logging.getLogger("lpn.x").info("a line of the log")
        report_progress("Describing tiles\x1b]0;title\x07", 2, 3)
    with consoles.progress_bars():
        report_progress("Reading", 2, 3)
    with consoles.terminal().status("Opening"):
        pass
"""
    status, received = on_terminal(code)
    assert status == 0
    assert "\x1b[?25l" in received  # a bar hides the cursor
    assert not re.search(
        r"\?\[(\?|\d+[mK]|1A)", received
    )  # the rest of a bar's own commands without their first character
    assert "\x1b]" not in received
    assert "\x1b[2J" not in received
    for text in ("Describing tiles?]0;t", "Reading", "Opening", "lpn.x: a line of the log"):
        assert text in received


def test_a_notebooks_table_holds_none() -> None:
    page = notebook_html.table("names", ["name"], [[NAME], ["two\nlines"]])
    assert not set(evil(page)) - {"\u061c", "\u200e", "\u200f"}
    assert "two\nlines" in page
