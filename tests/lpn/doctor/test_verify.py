"""The verdicts of `lpn doctor PATH` about indexes and stores that are empty or were not finished."""

from __future__ import annotations

import errno
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lpn.cli import main
from lpn.core.errors import StoreError
from lpn.doctor.verify import verify
from lpn.index import DescriptorKind, ExactIndex, parts

KIND = DescriptorKind("0123456789abcdef", 2, 8)
VECTORS = np.full((20, 2, 8), 0.25, np.float32)
NAMES = [f"tile {i}" for i in range(20)]


def said(capsys: pytest.CaptureFixture[str], path: Path) -> tuple[int, str]:
    return main.main(["doctor", str(path)]), capsys.readouterr().out.strip()


def full(*_: Any, **__: Any) -> None:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_an_index_without_a_tile_is_called_empty(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    ExactIndex.create(tmp_path / "index", KIND).close()
    assert said(capsys, tmp_path) == (
        1,
        f"DAMAGED: {tmp_path}/index: is empty: no tile was added; see that the disk has space, and add them again with lpn "
        "index.",
    )


def test_an_index_on_a_full_disk_is_called_empty_or_tells_what_is_missing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    left = "an add was interrupted or is still running, and its tiles are missing"
    with ExactIndex.create(tmp_path / "index", KIND) as index:
        with monkeypatch.context() as patched:
            patched.setattr(parts.np, "save", full)
            with pytest.raises(StoreError, match="free space or choose another folder"):
                index.add(NAMES, VECTORS)
        assert [path.name for path in sorted((tmp_path / "index").iterdir())] == ["0000001", "index.json"]
        status, line = said(capsys, tmp_path / "index")
        assert (status, line) == (
            1,
            f"DAMAGED: {tmp_path}/index: is empty: {left}; see that the disk has space, and add them again with lpn index.",
        )
        index.add(NAMES, VECTORS)
        assert said(capsys, tmp_path / "index") == (0, f"{tmp_path}/index is what was written.")
        with monkeypatch.context() as patched:
            patched.setattr(parts.np, "save", full)
            with pytest.raises(StoreError, match="free space or choose another folder"):
                index.add(["another tile"], VECTORS[:1])
        assert said(capsys, tmp_path / "index") == (
            0,
            f"{tmp_path}/index is what was written; {left}, so add them again with lpn index.",
        )


def test_an_index_whose_manifest_was_not_finished_is_named(tmp_path: Path) -> None:
    (tmp_path / "index").mkdir()
    (tmp_path / "index" / "index.json.12-34.part").write_bytes(b"")
    (verdict,) = verify(tmp_path)
    assert not verdict.whole
    assert verdict.message.endswith(
        "is an index whose making was interrupted, and holds nothing; make it again with lpn index."
    )


def test_a_store_that_was_not_finished_is_named(tmp_path: Path) -> None:
    (tmp_path / "store").mkdir()
    (tmp_path / "store" / "descriptors.log").write_bytes(b"{}")
    (verdict,) = verify(tmp_path)
    assert not verdict.whole
    assert "its description was not finished; run lpn describe again" in verdict.message


def test_files_are_compared_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for options in (["--data", str(tmp_path)], ["--quick"], ["--json", str(tmp_path / "found.json")]):
        assert main.main(["doctor", str(tmp_path), *options]) == 2
        assert "is compared with its checksums alone; leave the options out" in capsys.readouterr().err
    assert main.main(["doctor", str(tmp_path / "none"), str(tmp_path)]) == 2
    assert "There is nothing at" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
