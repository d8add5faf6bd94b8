"""The installs without torch: the explorer, maps, and live flights work with the packages of their extras alone."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path

from tools.fixtures.packages import link_packages, needed
from tools.keep.measures import Figures, Measure, Value, equal, reported

# Packages that none of these installs may bring.
_ROOT = Path(__file__).parents[2]
HEAVY = ("torch", "scipy", "pyproj", "onnx")
_BEGIN = """
import shutil, sys, threading, time
from pathlib import Path
from lpn.cli.main import main
from lpn.core.demo import DEMO, DEMO_FLIGHT, DEMO_MODEL
photos = Path("photos")
photos.mkdir()
shots = sorted(DEMO_FLIGHT[1].glob("*.webp"))[:2]
"""
_EXPLORE = """
from contextlib import closing
from explorer.app import App
from explorer.opening import open_model
from tools.fixtures.screen_tab import ScreenTab
with closing(App(open_model(DEMO, DEMO_MODEL), "127.0.0.1", 0)) as app:
    with ScreenTab(app.link) as tab:
        tab.open()
        tab.turn(30)
"""
_MAPS = """
for shot in shots:
    shutil.copy(shot, photos)
options = ["--matcher", "sift", "--prior", "20", "--out", "track.csv"]
main(["locate", "--map", str(DEMO_FLIGHT[0]), "--flight", "photos", *options])
assert len(Path("track.csv").read_text().splitlines()) == 1 + len(shots)
"""
# Photos arrive until one is answered; those that lie there when the command starts to look are left out.
_LIVE = """
fixes = Path("live.jsonl")
def fly():
    for number in range(300):
        time.sleep(1)
        if fixes.is_file() and fixes.stat().st_size:
            return
        shutil.copy(shots[0], "arrived.part")
        Path("arrived.part").rename(photos / f"{number}{shots[0].suffix}")
threading.Thread(target=fly, daemon=True).start()
options = ["--matcher", "sift", "--size", "400", "--idle", "5", "--out", str(fixes)]
main(["locate", "--live", "photos", "--map", str(DEMO_FLIGHT[0]), "--model", str(DEMO_MODEL), *options])
assert fixes.read_text()
"""
# Extras of each install, and what is done with them.
INSTALLS = {"base": ((), _EXPLORE), "maps": (("maps",), _MAPS), "live": (("maps", "live"), _LIVE)}


def imports() -> Figures:
    """Use each install in a process that finds the packages of this install alone.

    For each install: "works", or the error's last line; which of `HEAVY` it requires, with what its requirements require; and the
    number of required packages.
    """
    figures: dict[str, Value] = {}
    for name, (extras, code) in INSTALLS.items():
        own = needed([f"lpn-explorer[{','.join(extras)}]"])
        figures[f"{name} heavy packages"] = ", ".join(sorted(own.intersection(HEAVY))) or "none"
        figures[f"{name} packages"] = len(own)
        with tempfile.TemporaryDirectory() as folder:
            site = Path(folder, "site")
            site.mkdir()
            link_packages(own, site)
            environment = {
                **os.environ,
                "PYTHONPATH": f"{site}{os.pathsep}{_ROOT}",
                "HOME": folder,
                "LPN_CACHE": f"{folder}/cache",
            }
            command = [sys.executable, "-S", "-c", _BEGIN + code]
            done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=folder, env=environment)
        if done.returncode:
            print(done.stderr, file=sys.stderr)
        figures[f"{name} use"] = "works" if done.returncode == 0 else _last_line(done)
    return figures


def _last_line(done: subprocess.CompletedProcess[str]) -> str:
    return (done.stderr.splitlines() or [f"ended with status {done.returncode}"])[-1]


MEASURES = (
    Measure(
        "imports",
        imports,
        {"* use": equal(), "* heavy packages": equal(), "* packages": reported()},
    ),
)
