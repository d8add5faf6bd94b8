from __future__ import annotations

import random
from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat
from scipy.sparse import eye_array

from lpn.core.errors import DataError
from lpn.datasets import matlab

_read = matlab._read
VALUES = {
    "names": np.array(["abc", "déf"]),
    "mixed": np.array(["a", np.arange(3.0)], dtype=object),
    "set": {"rows": np.array([[1.0], [2.0]]), "inner": {"flag": True, "half": np.float32(0.5)}},
    "wide": np.arange(24, dtype=np.int16).reshape(2, 3, 4),
    "empty": np.zeros((0, 3)),
    "wave": np.array([1 + 2j]),
}


@pytest.fixture(autouse=True)
def _in_its_own_process(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(matlab, "_read", _read)


@pytest.mark.parametrize("packed", [False, True])
def test_what_was_saved_is_read(packed: bool, tmp_path: Path) -> None:
    savemat(tmp_path / "a.mat", VALUES, do_compression=packed)
    found = matlab.load(tmp_path / "a.mat", list(VALUES), "such a file", simplify=True)
    assert list(found) == list(VALUES)
    assert found["names"].tolist() == ["abc", "déf"]
    assert found["set"]["rows"].tolist() == [1, 2]
    assert found["set"]["inner"]["half"] == 0.5
    np.testing.assert_array_equal(found["wide"], VALUES["wide"])


@pytest.mark.parametrize(
    "content", [b"", b"no matlab file at all" * 20, b"MATLAB 7.3".ljust(512) + b"\x89HDF\r\n\x1a\n" + bytes(600)]
)
def test_what_is_none_is_one_sentence(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "a.mat").write_bytes(content)
    with pytest.raises(DataError, match=r"a\.mat cannot be read \(it is no MATLAB 5 file.*; expected such a file\."):
        matlab.load(tmp_path / "a.mat", ["names"], "such a file")
    if content.startswith(b"MATLAB 7.3"):
        with pytest.raises(DataError, match=r"one of 7\.3; save it by save\(\.\.\., '-v7'\)"):
            matlab.load(tmp_path / "a.mat", ["names"], "such a file")
    with pytest.raises(DataError, match="No such file"):
        matlab.load(tmp_path / "absent.mat", ["names"], "such a file")


@pytest.mark.parametrize("packed", [False, True])
def test_a_cut_file_is_one_sentence(packed: bool, tmp_path: Path) -> None:
    file = tmp_path / "a.mat"
    savemat(file, VALUES, do_compression=packed)
    whole = file.read_bytes()
    for kept in (len(whole) // 2, len(whole) - 2):
        file.write_bytes(whole[:kept])
        with pytest.raises(DataError, match="cannot be read"):
            matlab.load(file, list(VALUES), "such a file")


@pytest.mark.slow
@pytest.mark.parametrize("packed", [False, True])
def test_damage_anywhere_never_ends_the_process(packed: bool, tmp_path: Path) -> None:
    file, rng = tmp_path / "a.mat", random.Random(0)
    savemat(file, VALUES, do_compression=packed)
    whole = file.read_bytes()
    messages: list[str] = []
    for _ in range(20):
        damaged = bytearray(whole)
        for _ in range(rng.randint(1, 5)):
            damaged[rng.randrange(len(whole))] = rng.randrange(256)
        file.write_bytes(damaged)
        try:
            matlab.load(file, list(VALUES), "such a file")
        except DataError as error:
            messages.append(str(error))
    assert len(messages) > 4
    assert not any("\n" in message for message in messages)


@pytest.mark.parametrize(
    ("reader", "seconds", "message"),
    [
        ("import os; os.abort()", 60.0, "its reader crashed"),
        ("import time; time.sleep(60)", 0.5, "its reader did not end in time"),
    ],
)
def test_a_reader_that_crashes_or_hangs_is_one_sentence(
    reader: str, seconds: float, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    savemat(tmp_path / "a.mat", VALUES)
    monkeypatch.setattr(matlab, "_READER", reader)
    monkeypatch.setattr(matlab, "_SECONDS", seconds)
    with pytest.raises(DataError, match=message):
        matlab.load(tmp_path / "a.mat", ["names"], "such a file")


def test_other_variables_are_not_read(tmp_path: Path) -> None:
    savemat(tmp_path / "a.mat", VALUES | {"sparse": eye_array(3)})
    assert list(matlab.load(tmp_path / "a.mat", ["wide"], "such a file")) == ["wide"]
