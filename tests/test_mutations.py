"""The faults that tests must notice: all can be planted, and the program tells which are noticed."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tools.fixtures.packages import tracked_files

ROOT = Path(__file__).parents[1]
MODULE = "def total(values):\n    return sum(value for value in values if value > 0)\n"
TESTS = "from toy import total\n\n\ndef test_total():\n    assert total([1, 2, -1]) == 3\n"
ENTRY = "{name}: the total is wrong\ntoy.py: test_toy.py\n- {old}\n+ {new}\n\n"


@pytest.fixture
def toy(tmp_path: Path) -> Path:
    """A checkout of a module and its test, with two mutations: a sign, and a bound that no test asks for."""
    folder = tmp_path / "toy"
    (folder / "tools").mkdir(parents=True)
    (tmp_path / "tmp").mkdir()
    (folder / "toy.py").write_text(MODULE)
    (folder / "test_toy.py").write_text(TESTS)
    entries = ENTRY.format(name="sign", old="sum(", new="-sum("), ENTRY.format(name="bound", old="> 0", new=">= 0")
    (folder / "tools" / "mutations.txt").write_text("# A comment.\n" + "".join(entries))
    subprocess.run(["git", "init", "-q"], cwd=folder, check=True)
    return folder


def start(folder: Path, *arguments: object) -> subprocess.Popen[str]:
    """Start the program in a checkout, with its own temporary folder."""
    environment = os.environ | {"PYTHONPATH": str(ROOT), "TMPDIR": str(folder.parent / "tmp")}
    command = [sys.executable, "-m", "tools.mutations", *map(str, arguments)]
    pipe = subprocess.PIPE
    return subprocess.Popen(command, cwd=folder, env=environment, stdout=pipe, stderr=pipe, text=True)


def ended(process: subprocess.Popen[str]) -> tuple[int, str, str]:
    """Return exit status, output, and errors of the program."""
    out, err = process.communicate(timeout=300)
    assert "Traceback" not in err, err
    return process.returncode, out, err


def test_every_mutation_can_be_planted_and_there_are_twenty() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "tools.mutations", "--check"], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert int(done.stdout.split()[1]) >= 20


def test_the_program_tells_which_mutations_are_noticed_and_leaves_the_checkout_alone(toy: Path) -> None:
    before = {name: (toy / name).read_bytes() for name in tracked_files(toy)}
    status, out, err = ended(start(toy, "--out", toy.parent / "found.json"))
    assert status == 1
    assert json.loads((toy.parent / "found.json").read_text()) == {"sign": "test_toy.py::test_total", "bound": None}
    assert "NOT NOTICED: the total is wrong" in out
    assert "1 of 2 mutations are noticed." in out
    assert err == "No test notices bound; write one that does.\n"
    assert {name: (toy / name).read_bytes() for name in tracked_files(toy)} == before
    assert ended(start(toy, "sign"))[0] == 0
    assert not list((toy.parent / "tmp").iterdir())


def test_what_cannot_be_planted_or_tells_nothing_is_one_sentence(toy: Path) -> None:
    assert ended(start(toy, "sing"))[2] == "There is no mutation sing; there are sign, bound.\n"
    (toy / "test_toy.py").write_text(TESTS.replace("== 3", "== 4"))
    assert ended(start(toy))[2].startswith("test_toy.py::test_total fails without a mutation")
    (toy / "test_toy.py").write_text("import missing\n")
    assert ended(start(toy))[2].startswith("pytest could not run test_toy.py:\n")
    (toy / "toy.py").write_text(MODULE.replace("sum(", "sum(+sum(") + "# > 0\n")
    status, _, err = ended(start(toy, "--check"))
    assert status == 1
    assert [line.partition(": ")[0] for line in err.splitlines()] == [
        f"The mutation {name} does not apply" for name in ("sign", "bound")
    ]
    assert "occurs 2 times in toy.py, not once. Anchor it in tools/mutations.txt" in err
    (toy / "tools" / "mutations.txt").write_text("sign: wrong\ntoy.py: test_toy.py\n- one\n+ one\n")
    assert "is not complete; expected name: behaviour" in ended(start(toy, "--check"))[2]
    (toy / "tools" / "mutations.txt").unlink()
    assert ended(start(toy))[2].startswith("There is no tools/mutations.txt here")
