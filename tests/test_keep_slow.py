"""What the slow measures of tools.keep do apart from the measuring. Tests reach tools only as processes."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

BEGIN = """
import json, os, sys, tempfile
from pathlib import Path
from lpn.core.errors import DataError
from tools.keep import _resumable, flights, training
from tools.keep.measures import all_measures, errors
known = all_measures()
folder = Path(tempfile.mkdtemp(dir=os.environ["KEEP_TEST"]))
"""

TRUTH = """
from lpn.core.demo import DEMO_FLIGHT
flights.write_positions(DEMO_FLIGHT[0].with_name("truth.csv"), folder / "positions.csv")
header, first, second, *others = (folder / "positions.csv").read_text().splitlines()
assert header == "photo,latitude,longitude,point" and len(others) == 78
assert first == "LPN_0086.webp,46.203270150,-31.393268518,camera", first
assert second == "LPN_0086.webp,46.203265177,-31.393271195,ground", second
"""

RENDERED = """
point = {"photos": 34, "median": 1.0, "ce95": 1.7, "largest": 3.0, "within": {"1": 94.1, "2": 100.0, "3": 100.0}}
measured = {"frames": 40, "surveyed": {"registration": {"camera": point, "ground": point}}}
figures = flights.rendered_figures(measured)
assert figures["photos"] == 40 and figures["placed"] == 34 and figures["middle within 1 radii"] == 94.1
assert errors(known["rendered"], figures, figures) == {}
worse = {**figures, "placed": 33, "camera largest m": 5.1, "middle within 2 radii": 93.0, "camera within 3 radii": 97.1}
assert set(errors(known["rendered"], worse, figures)) == {*worse} - {name for name in worse if worse[name] == figures[name]}
"""

REAL = """
def row(name, east, north, state="accepted"):
    return {"frame": name, "state": state, "easting_m": str(east), "northing_m": str(north), "radius_on_map_m": "6.0"}
def figures(*rows):
    filled = [row(str(i), i, i) for i in range(30 - len(rows))]
    return flights.real_figures([*rows, *filled])
def wrong(found):
    return set(errors(known["real"], found, before))
before = figures(row("a", 100, 200), row("b", 300, 400, "contradicted"))
assert before["placed"] == 30 and before["places"][:4] == [100.0, 200.0, 300.0, 400.0]
assert wrong(before) == set()
assert wrong(figures(row("a", 108, 208), row("b", 300, 400))) == set(), "11.3 m, and 2 radii are 12 m"
assert wrong(figures(row("a", 109, 209), row("b", 300, 400))) == {"places"}
assert wrong(figures(row("a", float("nan"), 200), row("b", 300, 400))) == {"places"}
assert wrong(figures(row("a", 100, 200), row("b", "", "", "refused"))) == {"placed", "placed photos", "places"}
"""

WRONG_MAPS = """
def figures(elsewhere=0, coarse=4, beyond=0):
    names = "brighton, mirrored", "caliterra", "own, 1 m a pixel"
    counts = (0, 0), (elsewhere, elsewhere), (coarse, beyond)
    return flights.wrong_map_figures([
        {"map": name, "photos": 18, "accepted": {"registration": accepted}, "beyond": {"registration": beyond}}
        for name, (accepted, beyond) in zip(names, counts)
    ])
def wrong(found):
    return set(errors(known["wrong-brighton"], found, figures()))
assert wrong(figures()) == set() and wrong(figures(coarse=5)) == set()
assert wrong(figures(elsewhere=1)) == {"over caliterra accepted"}
assert wrong(figures(coarse=3)) == {"own, 1 m a pixel accepted"}
assert wrong(figures(beyond=1)) == {"own, 1 m a pixel beyond"}
"""

TRAINING = """
names = [f"{reading} {task}" for reading in training.READINGS for task in training.TASKS]
seeds = [dict.fromkeys(names, value) for value in (82.5, 85.0, 83.75)]
figures = training.training_figures(seeds)
assert figures["CSLS drone-to-satellite mean"] == 83.75 and figures["CSLS drone-to-satellite half range"] == 1.25
assert figures["calibrated satellite-to-drone by seed"] == [82.5, 85.0, 83.75]
assert errors(known["training"], figures, {}) == {}
worse = training.training_figures([{**seed, "CSLS satellite-to-drone": 82.4} for seed in seeds])
assert set(errors(known["training"], worse, {})) == {"CSLS satellite-to-drone mean"}
"""

GOES_ON = """
_resumable._ROOT = folder
(folder / "lpn").mkdir()
(folder / "lpn" / "one.py").write_text("1")
os.environ["LPN_CACHE"] = "the user's"
measured = []
def measure(name):
    measured.append(name)
    return [name]
class KilledError(Exception):
    pass
def run(killed):
    with _resumable.resumable("rows") as work:
        assert os.environ["LPN_CACHE"] == str(work / "cache")
        rows = [_resumable.keep_row(work / "rows.json", name, lambda: measure(name)) for name in "ab"[: 1 if killed else 2]]
        if killed:
            raise KilledError
    return work, rows
for _ in range(2):
    try:
        run(killed=True)
    except KilledError:
        pass
assert measured == ["a"] and os.environ["LPN_CACHE"] == "the user's"
work, rows = run(killed=False)
assert measured == ["a", "b"] and rows == [["a"], ["b"]] and not work.exists()
try:
    run(killed=True)
except KilledError:
    pass
(folder / "lpn" / "one.py").write_text("2")
run(killed=False)
assert measured == ["a", "b", "a", "a", "b"], "rows of other code do not count"
"""

COMMAND = """
try:
    _resumable.run_lpn("locate", "--map", folder / "none.tif", "--flight", folder, "--out", folder / "track.csv")
except DataError as error:
    message = str(error)
assert message.startswith("lpn locate ended with status 2: ") and "none.tif" in message and "\\n" not in message, message
"""

SPEED = """
from tools.bench import __main__ as bench
from tools.bench.figures import Figure
from tools.keep.speed import ratios
bench.measured = lambda name: [Figure(f"{name} 9 x 9", 2.0, "ms", 6.0, 1.6), Figure("memory", 1.23456, "GB")]
figures = ratios("search")
assert figures == {
    "search 9 x 9, ms": 2.0, "search 9 x 9, times the peer": 3.0, "search 9 x 9, of the limit": 1.25, "memory, GB": 1.23
}, figures
assert errors(known["speed-search"], figures, {}) == {}
bench.measured = lambda name: []
try:
    ratios("search")
except DataError as error:
    message = str(error)
assert message == "python -m tools.bench search measured nothing; run it to see why.", message
"""

COUNTS = """
from tools.bench.single_photos import photos_of
from tools.bench.wrong_maps import open_pair
real = Path(os.environ["LPN_FLIGHTS"])
counts = {name: len(open_pair(name, real)[0].frames[::every]) for name, (every, _) in flights.WRONG_MAPS.items()}
assert counts == {"brighton": 18, "rendered": 40, "caliterra": 15, "seneca": 60}, counts
assert sum(counts.values()) == 133
photos = {"here": 0, "elsewhere": 0}
def count(name, **sides):
    for side, sources in sides.items():
        photos[side] += sum(len(list(photos_of([source], every))) for source, every in sources.items())
flights._single_photos = count
flights.shipped_photos(), flights.flights_photos(), flights.university_photos()
assert photos == {"here": 50, "elsewhere": 68}, photos
"""


def run(script: str, folder: Path) -> None:
    environment = {**os.environ, "KEEP_TEST": str(folder)}
    root = Path(__file__).parents[1]
    done = subprocess.run(
        [sys.executable, "-c", BEGIN + script], capture_output=True, text=True, env=environment, cwd=root
    )
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    "script", [TRUTH, RENDERED, REAL, WRONG_MAPS, TRAINING, GOES_ON, COMMAND, SPEED],
    ids=["truth", "rendered", "real", "wrong maps", "training", "goes on", "command", "speed"],
)  # fmt: skip
def test_figures_and_their_bounds(script: str, tmp_path: Path) -> None:
    run(script, tmp_path)


def test_as_many_photos_are_located_elsewhere_as_the_target_says(tmp_path: Path) -> None:
    for variable in ("LPN_FLIGHTS", "LPN_MINI_DATA"):
        if variable not in os.environ:
            pytest.skip(f"{variable} does not name the folder of the real data")
    run(COUNTS, tmp_path)
