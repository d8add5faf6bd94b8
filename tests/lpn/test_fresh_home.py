"""Commands of a new user: all that they leave in the home folder is our cache."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from tools.fixtures import small_worlds

_RUN = """
import sys
from pathlib import Path

import lpn
from explorer.app import App
from explorer.opening import open_model
from lpn.cli.main import main
from lpn.drawing.plots import pyplot

root, folder = sys.argv[1:]
query = next(Path(root).glob("test/query_drone/*/*.png"))
model = lpn.load("city-lpn")
assert model.part_embeddings(model.prepare(lpn.load_picture(query), "drone")[None], "drone").shape[1] == model.n_parts
given = [root, "--model", "city-lpn"]
assert main(["evaluate", *given, "--task", "drone-to-satellite"]) == 0
swept = ["--over", "rotation", "--query", query.parent.name, "--step", "90", "--csv", f"{folder}/sweep.csv"]
assert main(["explain", *given, *swept]) == 0
assert main(["report", *given, "--query", query.parent.name, "--out", f"{folder}/report.html"]) == 0
main(["doctor"])
pyplot()
App(open_model(Path(root), Path("city-lpn")), "127.0.0.1", 0).close()
"""


def test_nothing_is_written_into_a_fresh_home_but_the_cache(tmp_path: Path) -> None:
    home = tmp_path / "home"
    home.mkdir()
    root = small_worlds.make_dataset(tmp_path / "places", train=1, test=3)
    # No variable may lead a cache elsewhere.
    keep = ("PATH", "SYSTEMROOT", "OMP_NUM_THREADS", "LD_LIBRARY_PATH", "PYTHONPATH", "TMPDIR")
    environ = {name: os.environ[name] for name in keep if name in os.environ}
    done = subprocess.run(
        [sys.executable, "-c", _RUN, str(root), str(tmp_path)],
        env={**environ, "HOME": str(home), "USERPROFILE": str(home)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    cache = home / ".cache" / "lpn-explorer"
    files = [file for file in home.rglob("*") if file.is_file()]
    assert files
    assert [file for file in files if cache not in file.parents] == []
    assert {"matplotlib", "descriptors"} <= {entry.name for entry in cache.iterdir()}


def test_the_settings_that_a_user_has_for_matplotlib_hold(tmp_path: Path) -> None:
    settings = tmp_path / ".config" / "matplotlib" / "matplotlibrc"
    settings.parent.mkdir(parents=True)
    settings.write_text("figure.dpi: 123\n")
    code = "from lpn.drawing.plots import pyplot\nprint(pyplot().rcParams['figure.dpi'])"
    environ = {name: value for name, value in os.environ.items() if not name.startswith(("MPL", "MATPLOTLIB", "XDG"))}
    environ |= {"HOME": str(tmp_path), "LPN_CACHE": str(tmp_path / "cache")}
    done = subprocess.run([sys.executable, "-c", code], env=environ, capture_output=True, text=True, check=True)
    assert done.stdout == "123.0\n"
