"""Give damaged input to every reader in a watched process: `python -m tools.fuzz.readers --inputs 10000`.

A finding is an exception other than LPNError, a crash, an endless read, more than two seconds of processor time, or far more
memory than a real file takes. Inputs of findings are kept; --again reads one of them again.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import resource
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from random import Random
from typing import Any

from tools.fuzz import targets
from tools.fuzz.mutation import mutated
from tools.fuzz.targets import TARGETS, FuzzCase, complaint, described

# Allowed seconds of processor time for an input.
SLOW = 2.0
# Allowed growth of peak memory for an input, in megabytes; a picture of 64 megapixels and its copy take 192 each.
LARGE = 480
# Seconds after which a read counts as endless; on a busy machine most of them belong to other processes.
STUCK = 120.0
# Bytes of address space for a reader, above its size at the start; it protects the machine.
MEMORY = 3 << 30
_MOST = 20


@dataclass(frozen=True)
class FuzzFinding:
    """An input with which a reader failed."""

    reader: str
    number: int
    said: str


def an_input(name: str, cases: Sequence[FuzzCase], number: int, seed: int = 0) -> tuple[FuzzCase, bytes]:
    """The damaged file with a number, and the case that reads it."""
    rng = Random(f"{name} {seed} {number}")
    case = cases[number % len(cases)]
    return case, mutated(case.seeds, rng)


def run(
    name: str, inputs: int, seed: int = 0, keep: Path | None = None, stuck: float = STUCK
) -> tuple[int, list[FuzzFinding]]:
    """Give damaged inputs to a reader in watched processes.

    Args:
        keep: folder for the inputs of findings.
        stuck: seconds after which a read counts as endless.

    Returns:
        Number of inputs read, and the findings; it stops after 20 of them.
    """
    found: list[FuzzFinding] = []
    first = 0
    while first < inputs and len(found) < _MOST:
        first = _watched(name, range(first, inputs), seed, keep, found, stuck)
    return first, found


def _watched(name: str, numbers: range, seed: int, keep: Path | None, found: list[FuzzFinding], stuck: float) -> int:
    """Run one process until it ends or is killed; returns the number of the next input."""
    context = multiprocessing.get_context("spawn")
    current = context.Value("q", -1, lock=False)
    began = context.Value("d", 0.0, lock=False)
    here, there = context.Pipe(duplex=False)
    process = context.Process(target=_work, args=(name, numbers, seed, keep, there, current, began), daemon=True)
    process.start()
    there.close()
    said = None
    while True:
        try:
            while here.poll(0.2):
                found.append(here.recv())
        except EOFError:
            break
        if current.value >= 0 and time.monotonic() - began.value > stuck:
            said = f"did not end in {stuck:g} s"
            process.kill()
            break
        if len(found) >= _MOST:
            process.kill()
            break
    process.join()
    number = int(current.value)
    if process.exitcode and len(found) < _MOST:
        said = said or (f"the process ended ({-process.exitcode})" if process.exitcode < 0 else "the process failed")
        if number < 0:
            raise SystemExit(f"The reader {name} could not be made ready; see above.")
        found.append(FuzzFinding(name, number, said))
    return number + 1


def _work(name: str, numbers: range, seed: int, keep: Path | None, to: Connection, current: Any, began: Any) -> None:
    with tempfile.TemporaryDirectory(prefix="lpn-fuzz-") as folder:
        cases = getattr(targets, name)(Path(folder))
        _bound_memory()
        # Libraries warn about damaged files.
        os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        for number in numbers:
            case, data = an_input(name, cases, number, seed)
            if keep is not None:
                (keep / f"{name}.now").write_bytes(data)
            began.value, current.value = time.monotonic(), number
            spent = time.process_time()
            error = complaint(case.read, data)
            spent = time.process_time() - spent
            peak, before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, peak
            more = (peak - before) // 1024
            if error is not None or spent > SLOW or more > LARGE:
                said = f"took {spent:.1f} s and {more} MB" if error is None else described(error)
                to.send(FuzzFinding(name, number, said))
                if keep is not None:
                    (keep / f"{name}-{number}.bin").write_bytes(data)
            began.value = time.monotonic()
    to.close()


def _bound_memory() -> None:
    for line in Path("/proc/self/status").read_text().splitlines() if Path("/proc/self/status").exists() else ():
        if line.startswith("VmSize:"):
            most = int(line.split()[1]) * 1024 + MEMORY
            resource.setrlimit(resource.RLIMIT_AS, (most, most))


def again(name: str, number: int, seed: int = 0) -> None:
    """Read one input in this process, with its traceback."""
    with tempfile.TemporaryDirectory(prefix="lpn-fuzz-") as folder:
        case, data = an_input(name, TARGETS[name](Path(folder)), number, seed)
        print(f"{len(data)} bytes, beginning with {data[:80]!r}")
        watchdog = threading.Timer(STUCK, lambda: print("The read does not end.", flush=True))
        watchdog.daemon = True
        watchdog.start()
        case.read(data)


def main() -> int:
    """Run the readers and print the findings."""
    parser = argparse.ArgumentParser(
        prog="python -m tools.fuzz.readers", description="Damaged input for everything that is read."
    )
    parser.add_argument("--inputs", type=int, default=10_000, help="for each reader")
    parser.add_argument("--reader", action="append", choices=[*TARGETS], help="this one alone; may be repeated")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--keep", type=Path, default=Path("runs/fuzz"), help="folder for the inputs of findings")
    parser.add_argument(
        "--again", type=int, help="read the input of this number of one --reader again, with its traceback"
    )
    given = parser.parse_args()
    names = given.reader or [*TARGETS]
    if given.again is not None:
        again(names[0], given.again, given.seed)
        return 0
    given.keep.mkdir(parents=True, exist_ok=True)
    bad = 0
    for name in names:
        started = time.monotonic()
        done, found = run(name, given.inputs, given.seed, given.keep)
        bad += len(found)
        print(f"{name}: {done:,} inputs in {time.monotonic() - started:.0f} s, {len(found)} findings", flush=True)
        for finding in found[:_MOST]:
            print(f"  {finding.number}: {finding.said}", flush=True)
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
