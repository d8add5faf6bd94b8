"""The contents of sdist and wheel, and the demo of an installation with only the base packages, in a browser."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import tarfile
import time
import tomllib
import zipfile
from pathlib import Path

import pytest
from playwright.sync_api import expect

from lpn.core.demo import DEMO_QUERY
from tests.e2e.conftest import Contexts, Screen
from tools.fixtures import packages
from tools.fixtures.processes import free_port

ROOT = Path(__file__).parents[2]
# Bytes of the wheel.
LARGEST = 50_000_000
# Bytes of all tracked files.
LARGEST_CHECKOUT = 60_000_000

pytestmark = [pytest.mark.slow, pytest.mark.skipif(not (ROOT / ".git").exists(), reason="needs a checkout's git")]


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, Path]:
    """The checkout's files, the sdist of them, and the wheel of the unpacked sdist."""
    folder = tmp_path_factory.mktemp("built")
    for name in packages.tracked_files(ROOT):
        (folder / "checkout" / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, folder / "checkout" / name)
    sdist = packages.build("sdist", folder / "checkout", folder)
    with tarfile.open(sdist) as archive:
        archive.extractall(folder / "unpacked", filter="data")
    return folder / "checkout", sdist, packages.build("wheel", next((folder / "unpacked").iterdir()), folder)


def test_the_sdist_holds_what_is_built_and_nothing_else(built: tuple[Path, Path, Path]) -> None:
    checkout, sdist, _ = built
    with tarfile.open(sdist) as archive:
        files = {one.name.partition("/")[2] for one in archive.getmembers() if one.isfile()}
    beside = {
        "CITATION.cff",
        "LICENSE",
        "MANIFEST.in",
        "PKG-INFO",
        "README.md",
        "pyproject.toml",
        "setup.cfg",
        "setup.py",
    }
    assert {file for file in files if not file.startswith("lpn_explorer.egg-info/")} == beside | packed(checkout)
    assert sum(path.stat().st_size for path in checkout.rglob("*") if path.is_file()) < LARGEST_CHECKOUT


def test_the_wheel_holds_the_code_and_the_assets_once(built: tuple[Path, Path, Path]) -> None:
    checkout, _, wheel = built
    assert wheel.stat().st_size <= LARGEST
    with zipfile.ZipFile(wheel) as archive:
        files = [name for name in archive.namelist() if ".dist-info/" not in name]
    assert sorted(files) == sorted(re.sub("^assets/", "lpn/assets/", name) for name in packed(checkout))


def packed(checkout: Path) -> set[str]:
    """The files of a checkout that people install."""
    names = {path.relative_to(checkout).as_posix() for path in checkout.rglob("*") if path.is_file()}
    return {name for name in names if re.match(r"(lpn|explorer)/|assets/[^/]+/", name) and ".egg-info/" not in name}


@pytest.mark.slow
def test_an_installed_wheel_opens_the_demo_and_writes_nothing_beside_it(
    built: tuple[Path, Path, Path], tmp_path: Path, contexts: Contexts
) -> None:
    _, _, wheel = built
    base = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["dependencies"]
    scripts = packages.make_environment(tmp_path / "env", base)
    install = ("-m", "pip", "--python", str(scripts / "python"), "install", "--no-deps", "--no-index", str(wheel))
    subprocess.run([shutil.which("python") or "python3", *install], check=True, capture_output=True)
    home = tmp_path / "home"
    environment = {
        "PATH": str(scripts) + os.pathsep + os.environ["PATH"],
        "HOME": str(home),
        "LPN_CACHE": str(home / "c"),
    }
    found = subprocess.run(
        [scripts / "python", "-c", _WHERE], cwd=tmp_path, env=environment, check=True, capture_output=True, text=True
    )
    where = json.loads(found.stdout)
    assets = Path(where["assets"])
    assert tmp_path / "env" in assets.parents
    assert where == {"assets": str(assets), "same": True, "torch": False, "outside": []}
    before = {path: path.stat().st_mtime_ns for path in assets.rglob("*")}
    port = free_port()
    started = time.monotonic()
    with subprocess.Popen(
        [scripts / "lpn-explorer", "--port", str(port)],
        cwd=tmp_path,
        env=environment,
        stdout=subprocess.PIPE,
        text=True,
    ) as process:
        assert f"ready: http://127.0.0.1:{port}" in process.stdout.readline()
        print(f"{time.monotonic() - started:.2f} s to the address")
        try:
            screen = Screen(contexts().new_page(), f"http://127.0.0.1:{port}/").open()
            expect(screen.rows).to_have_count(4)
            expect(screen.photo.locator(".picture")).to_have_attribute("aria-label", re.compile(re.escape(DEMO_QUERY)))
            assert not [one for one in screen.complaints if "WebGL" not in one]
        finally:
            process.terminate()
    assert {path: path.stat().st_mtime_ns for path in assets.rglob("*")} == before
    listed = subprocess.run([scripts / "lpn", "models"], cwd=tmp_path, env=environment, check=True, capture_output=True)
    assert b"city-lpn" in listed.stdout


# Run in the installation: where it has its assets, and which modules lie outside of it.
_WHERE = """
import importlib.resources, importlib.util, json, sys
import explorer.app, lpn
from lpn.core.demo import ASSETS
found = importlib.resources.files("lpn") / "assets"
outside = [module.__file__ for name, module in sys.modules.items()
           if name.partition(".")[0] in ("lpn", "explorer") and not module.__file__.startswith(sys.prefix)]
torch = importlib.util.find_spec("torch") is not None
print(json.dumps({"assets": str(ASSETS), "same": found == ASSETS, "torch": torch, "outside": outside}))
"""
