"""The program for a machine with a GPU, tried without one. Tests reach tools only as processes."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

ROWS = """
from rich.console import Console
from tools.bench.gpu import ParityRow, parity_table
rows = [
    ParityRow("good", {"float32": 1e-4, "float16": 0.02}),
    ParityRow("bad", {"float32": 1.1e-4}),
    ParityRow("provider", failure="no driver"),
]
assert [row.agrees for row in rows] == [True, False, False]
Console(width=150).print(parity_table(rows))
"""

FORGED = """
from pathlib import Path
import numpy as np
from lpn.core.numbers import wrap_degrees
from tools.bench.wrong_maps import RENDERED, forged, open_pair
flight, own = open_pair(RENDERED, Path())
moved = forged(flight, own, own, 3)
before, after = own.frame.xy(*flight.degrees.T), own.frame.xy(*moved.degrees.T)
steps, turned = np.diff(before, axis=0), np.diff(after, axis=0)
np.testing.assert_allclose(np.linalg.norm(turned, axis=1), np.linalg.norm(steps, axis=1), atol=0.05)
long = np.linalg.norm(steps, axis=1) > 5
turns = wrap_degrees(np.degrees(np.arctan2(*turned.T) - np.arctan2(*steps.T)))[long]
np.testing.assert_allclose(wrap_degrees(turns - turns[0]), 0, atol=0.5)
headings = [one.heading - other.heading for one, other in zip(moved.frames, flight.frames, strict=True)]
np.testing.assert_allclose(wrap_degrees(np.array(headings) - turns[0]), 0, atol=0.5)
west, south, east, north = own.bounds
assert ((after >= (west, south)) & (after <= (east, north))).all()
assert np.linalg.norm(after.mean(axis=0) - before.mean(axis=0)) > 5
"""

CUT = """
import numpy as np, tempfile
from pathlib import Path
from tools.bench.wrong_maps import RENDERED, cut_maps, open_pair
flight, own = open_pair(RENDERED, Path())
with tempfile.TemporaryDirectory() as folder:
    for name, part in cut_maps(flight, own, [0.5], ["north"], Path(folder)):
        x, y = part.frame.xy(*flight.degrees.T).T
        west, south, east, north = part.bounds
        assert ((x > west - 1) & (x < east + 1) & (y > south - 1) & (y < north + 1)).sum() == 20, name
        assert north - south < 500 and east - west > 700
"""

TINY = """
import sys
from tools.bench import gpu
sys.argv = ["gpu", "--device", "cpu", "--tiny"]
gpu.main()
"""

FRESH_CACHE = """
import sys
from lpn.core.files import cache_folder
from tools.bench import flights
caches = []
flights.measure = lambda *_: caches.append((cache_folder(), cache_folder().is_dir()))
sys.argv = ["flights", "folder", "monday"]
flights.main()
print(caches[0][1], str(caches[0][0]) == USERS, caches[0][0].exists())
"""


def run(*arguments: str) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "CUDA_VISIBLE_DEVICES": ""}
    folder = Path(__file__).parents[1]
    return subprocess.run([sys.executable, *arguments], capture_output=True, text=True, env=environment, cwd=folder)


def test_without_a_gpu_the_bench_says_so_in_one_sentence() -> None:
    done = run("-m", "tools.bench.gpu")
    assert done.returncode == 1
    (line,) = done.stderr.splitlines()
    assert line.endswith(
        "finds no GPU here, so nothing was measured; run this on a machine with one, or give --device cpu."
    )
    assert not done.stdout


def test_the_table_tells_agreement_from_difference_and_from_nothing() -> None:
    done = run("-c", ROWS)
    lines = {line.split()[1]: line for line in done.stdout.splitlines() if line.startswith("│")}
    assert done.returncode == 0, done.stderr
    assert ["met" in lines[name] for name in ("good", "bad", "provider")] == [True, False, False]
    assert "missed" in lines["bad"]
    assert "not run" in lines["provider"]
    assert "2.0e-02" in lines["good"]


def test_parity_at_tiny_size() -> None:
    done = run("-c", TINY)
    assert done.returncode == 0, done.stderr
    found = [line for line in done.stdout.splitlines() if " met " in line]
    assert len(found) == 2  # a checkpoint, and one that is exported
    for word in ("vgg16_bn, 3 views, n = 1", "ONNX Runtime, cpu"):
        assert word in done.stdout


def test_flights_are_measured_with_a_fresh_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("LPN_CACHE", str(tmp_path / "users"))
    program = FRESH_CACHE.replace("USERS", repr(str(tmp_path / "users")))
    assert run("-c", program).stdout.split() == ["True", "False", "False"]


def test_a_map_is_cut_where_a_share_of_the_tags_stays() -> None:
    done = run("-c", CUT)
    assert done.returncode == 0, done.stderr


def test_forged_tags_are_those_of_the_flight_turned_and_moved() -> None:
    done = run("-c", FORGED)
    assert done.returncode == 0, done.stderr
