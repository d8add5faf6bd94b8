"""Plant faults one by one, and check that the tests notice each: `python -m tools.mutations [NAME ...] [--check] [--out FILE]`.

mutations.txt beside this file has the list. Faults are planted in a copy of the checkout in a temporary folder, so the checkout
is never changed. The program fails if a fault cannot be planted, or if no test notices it.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.util import cache_from_source
from pathlib import Path
from tempfile import TemporaryDirectory

from lpn.core.errors import InputError
from tools.fixtures.packages import tracked_files

TABLE = Path("tools/mutations.txt")
# Most seconds for the tests of one fault. A fault that keeps them from ending must be replaced.
_LONGEST = 900


@dataclass(frozen=True)
class Mutation:
    """A fault, and the tests that must notice it.

    Attributes:
        behaviour: the faulty behaviour in words.
        file: its place, relative to the checkout.
        tests: files or node ids of pytest.
        anchor, replacement: text that occurs once in the file, and its replacement.
    """

    name: str
    behaviour: str
    file: str
    tests: tuple[str, ...]
    anchor: str
    replacement: str

    def problem(self, root: Path) -> str:
        """Return the reason if the fault cannot be planted, else ""."""
        path = root / self.file
        count = path.read_text("utf-8").count(self.anchor) if path.is_file() else 0
        if count != 1:
            return (
                f"The mutation {self.name} does not apply: its anchor {self.anchor!r} occurs {count} times in {self.file}, not "
                f"once. Anchor it in {TABLE} where this behaviour is now: {self.behaviour}."
            )
        if missing := [test for test in self.tests if not (root / test.partition("::")[0]).is_file()]:
            return f"The mutation {self.name} names the tests {missing[0]}, which are not there; name others."
        return ""


def read_table(path: Path) -> list[Mutation]:
    """Read a table of mutations; its first lines describe the format.

    Raises:
        InputError: if it cannot be read, an entry is not complete, or two have one name.
    """
    if not path.is_file():
        raise InputError(f"There is no {path} here; run this in the folder of the checkout.")
    found: dict[str, Mutation] = {}
    lines = [line for line in path.read_text("utf-8").splitlines() if not line.startswith("#")]
    for block in filter(None, (block.strip("\n") for block in "\n".join(lines).split("\n\n"))):
        head, *rest = block.split("\n")
        name, _, behaviour = head.partition(": ")
        file, _, tests = (rest[0] if rest else "").partition(": ")
        old, new = ("\n".join(line[2:] for line in rest[1:] if line.startswith(sign)) for sign in "-+")
        if not (behaviour and tests and old and old != new) or any(line[:2] not in ("- ", "+ ") for line in rest[1:]):
            raise InputError(
                f"The entry {head!r} of {path} is not complete; expected name: behaviour, then file: tests, then lines that "
                "begin with '- ' and '+ ' and differ."
            )
        if name in found:
            raise InputError(f"{path} has two mutations of the name {name}; rename one.")
        found[name] = Mutation(name, behaviour, file, tuple(tests.split()), old, new)
    return list(found.values())


def first_failure(tree: Path, tests: Sequence[str], longest: float = _LONGEST) -> str | None:
    """Run tests in a copy of the checkout for at most `longest` seconds; return the first that fails, None if all pass.

    Raises:
        InputError: if they cannot be collected, or do not end.
    """
    options = ["-x", "-q", "-ra", "--tb=no", "-m", "", "-p", "no:cacheprovider", f"--basetemp={tree.parent / 'pytest'}"]
    environment = os.environ | {"PYTHONPATH": str(tree), "OMP_NUM_THREADS": "1"}
    process = subprocess.Popen(
        [sys.executable, "-m", "pytest", *options, *tests],
        cwd=tree,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    )
    try:
        output, _ = process.communicate(timeout=longest)
    except subprocess.TimeoutExpired:
        raise InputError(
            f"{' '.join(tests)} did not end within {longest:g} s; choose a fault that lets them, or free the machine."
        ) from None
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
    if process.returncode == 0:
        return None
    failed = [
        line.split(" ", 1)[1].split(" - ")[0] for line in output.splitlines() if line.startswith(("FAILED ", "ERROR "))
    ]
    if process.returncode != 1 or not failed:
        raise InputError(f"pytest could not run {' '.join(tests)}:\n{output[-2000:]}")
    return failed[0]


def write(path: Path, text: str) -> None:
    """Write a module, and delete its bytecode, which Python could take for current after a change within a second."""
    path.write_text(text, "utf-8")
    Path(cache_from_source(path)).unlink(missing_ok=True)


def run(root: Path, mutations: Sequence[Mutation]) -> dict[str, str | None]:
    """Return the test that notices each mutation, by name; None where none does.

    Raises:
        InputError: if a test fails without any mutation.
    """
    noticed: dict[str, str | None] = {}
    with TemporaryDirectory(prefix="mutations-") as folder:
        tree = Path(folder) / "checkout"
        for name in tracked_files(root):
            (tree / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(root / name, tree / name)
        if failed := first_failure(tree, sorted({test for one in mutations for test in one.tests}), _LONGEST * 4):
            raise InputError(f"{failed} fails without a mutation, so that it would notice nothing; mend it first.")
        for one in mutations:
            began, text = time.monotonic(), (root / one.file).read_text("utf-8")
            write(tree / one.file, text.replace(one.anchor, one.replacement))
            by = noticed[one.name] = first_failure(tree, one.tests)
            write(tree / one.file, text)
            seconds = time.monotonic() - began
            print(f"{one.name:26} {seconds:4.0f} s  {by or 'NOT NOTICED: ' + one.behaviour}", flush=True)
    return noticed


def main(arguments: list[str]) -> None:
    """Run the named mutations, or all."""
    parser = argparse.ArgumentParser(prog="python -m tools.mutations", description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help="mutations; all by default")
    parser.add_argument("--check", action="store_true", help="only see that they can be planted")
    parser.add_argument("--out", type=Path, help="a JSON file for the test that notices each")
    options = parser.parse_args(arguments)
    root = Path.cwd()
    for asked in (signal.SIGINT, signal.SIGTERM):
        signal.signal(asked, lambda number, _: sys.exit(128 + number))
    try:
        table = {one.name: one for one in read_table(TABLE)}
        if unknown := set(options.names) - table.keys():
            raise InputError(f"There is no mutation {', '.join(sorted(unknown))}; there are {', '.join(table)}.")
        chosen = [table[name] for name in options.names] or list(table.values())
        if problems := list(filter(None, (one.problem(root) for one in chosen))):
            raise InputError("\n".join(problems))
        if options.check:
            print(f"All {len(chosen)} mutations apply.")
            return
        noticed = run(root, chosen)
    except InputError as error:
        raise SystemExit(str(error)) from error
    if options.out:
        options.out.write_text(json.dumps(noticed, indent=1) + "\n", "utf-8")
    missed = [name for name, by in noticed.items() if by is None]
    print(f"{len(noticed) - len(missed)} of {len(noticed)} mutations are noticed.")
    if missed:
        raise SystemExit(f"No test notices {', '.join(missed)}; write one that does.")


if __name__ == "__main__":
    main(sys.argv[1:])
