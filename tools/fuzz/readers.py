"""Give damaged input to every reader in a watched process: `python -m tools.fuzz.readers --inputs 10000`.

A finding is an exception other than LPNError, a crash, an endless read, more than two seconds of processor time, or far more
memory than a real file takes. An input is made of its reader, seed, and number alone, so --again reads it again.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import re
import resource
import sys
import tempfile
import time
from collections.abc import Sequence
from multiprocessing.connection import Connection
from pathlib import Path
from random import Random
from typing import Any

from lpn.core.errors import LPNError
from tools.fuzz import field_targets, targets
from tools.fuzz.targets import FuzzCase

TARGETS = targets.TARGETS | {"flights": field_targets.flights, "maps": field_targets.maps}
# Findings after which a reader is abandoned.
MOST = 20
# Allowed seconds of processor time for an input.
SLOW = 2.0
# Allowed growth of peak memory for an input, in megabytes; a picture of 64 megapixels and its copy take 192 each.
LARGE = 480
# Seconds after which a read counts as endless; on a busy machine most of them belong to other processes.
STUCK = 120.0
# Bytes of address space for a reader, above its size at the start; it protects the machine.
MEMORY = 3 << 30
# Kinds of damage, and what is written by them.
_CHANGES = (
    "bit", "bit", "number", "number", "text", "written number", "cut", "drop", "double", "splice", "noise", "noise",
)  # fmt: skip
_NUMBERS = (0, 1, 2, 7, *(2**bits - less for bits in (7, 8, 15, 16, 31, 32, 63, 64) for less in (1, 0)))
_WRITTEN = b"0 -1 1e999 -0 nan inf 999999999999999999999999999999 true null [] {}".split()
_TEXTS = (
    *_WRITTEN, b"", b"[[[[[[[[", b'"', b"\n", b"\0", b"\r", b",", b";", b"\t", b"..", b"../../etc/passwd", b"/etc/passwd",
    b"C:\\x", b"%s%n", b"%00", b"%ff", b"&", b"\xff\xfe", b"\xef\xbb\xbf", "ä".encode(), "\u202e".encode(),
    "\U0001f6f0".encode(), b"<img src=x onerror=alert(1)>",
)  # fmt: skip
_NUMBER = re.compile(rb"-?\d+(\.\d+)?(e-?\d+)?")


def an_input(name: str, cases: list[FuzzCase], number: int, seed: int) -> tuple[FuzzCase, bytes]:
    """The damaged file with a number, and the case that reads it."""
    case = cases[number % len(cases)]
    return case, mutated(case.seeds, Random(f"{name} {seed} {number}"))


def mutated(seeds: Sequence[bytes], rng: Random) -> bytes:
    """Damage one of the seed files with one to eight changes."""
    data = bytearray(rng.choice(seeds))
    for _ in range(rng.choice((1, 1, 1, 2, 2, 3, 5, 8))):
        _change(data, rng, rng.choice(seeds))
    return bytes(data[:2_000_000])


def _change(data: bytearray, rng: Random, other: bytes) -> None:
    kind, at = rng.choice(_CHANGES), _position(data, rng)
    if kind == "bit" and data:
        data[at % len(data)] ^= 1 << rng.randrange(8)
    elif kind == "number":
        width = rng.choice((1, 2, 4, 8))
        value = rng.choice(_NUMBERS) & (2 ** (8 * width) - 1)
        data[at : at + width] = value.to_bytes(width, rng.choice(("little", "big")))
    elif kind == "text":
        data[at : at + rng.choice((0, 1, 8))] = rng.choice(_TEXTS)
    elif kind == "written number" and (found := list(_NUMBER.finditer(data, 0, 100_000))):
        chosen = rng.choice(found)
        data[chosen.start() : chosen.end()] = rng.choice((*_WRITTEN, str(rng.choice(_NUMBERS)).encode()))
    elif kind == "cut":
        del data[at:]
    elif kind == "drop":
        del data[at : at + rng.choice((1, 4, 16, 64, len(data) // 4))]
    elif kind == "double":
        data[at:at] = data[at : at + rng.choice((1, 8, 32, 512))] * rng.choice((1, 2, 50))
    elif kind == "splice":
        start = rng.randrange(len(other) + 1)
        data[at:] = other[start : start + 100_000]
    elif kind == "noise":
        data[at : at + rng.choice((0, 1))] = rng.randbytes(rng.choice((1, 4, 64)))


def _position(data: bytearray, rng: Random) -> int:
    """A random position, often near an end, where formats keep headers and indexes."""
    size = len(data)
    low, high = rng.choice(((0, size), (0, min(size, 256)), (max(size - 256, 0), size)))
    return rng.randint(low, max(high - 1, low))


def run(name: str, inputs: int, seed: int) -> tuple[int, list[tuple[int, str]]]:
    """Give damaged inputs to a reader in watched processes.

    Returns:
        Number of inputs read, and the numbers and complaints of findings; it stops after 20 of them.
    """
    found: list[tuple[int, str]] = []
    first = 0
    while first < inputs and len(found) < MOST:
        first = _watched(name, range(first, inputs), seed, found)
    return first, found


def _watched(name: str, numbers: range, seed: int, found: list[tuple[int, str]]) -> int:
    """Run one process until it ends or is killed; returns the number of the next input."""
    context = multiprocessing.get_context("spawn")
    current, began = context.Value("q", -1, lock=False), context.Value("d", 0.0, lock=False)
    here, there = context.Pipe(duplex=False)
    process = context.Process(target=_work, args=(name, numbers, seed, there, current, began), daemon=True)
    process.start()
    there.close()
    said = ""
    while len(found) < MOST and not said:
        try:
            if here.poll(0.2):
                found.append(here.recv())
            elif current.value >= 0 and time.monotonic() - began.value > STUCK:
                said = f"did not end in {STUCK:g} s"
        except EOFError:
            break
    if said or len(found) >= MOST:
        process.kill()
    process.join()
    number = int(current.value)
    if process.exitcode and len(found) < MOST:
        if number < 0:
            raise SystemExit(f"The reader {name} could not be made ready; see above.")
        found.append((number, said or f"the process ended with status {process.exitcode}"))
    return number + 1


def _work(name: str, numbers: range, seed: int, to: Connection, current: Any, began: Any) -> None:
    with tempfile.TemporaryDirectory(prefix="lpn-fuzz-") as folder:
        cases = TARGETS[name](Path(folder))
        if Path("/proc/self/statm").exists():
            most = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize() + MEMORY
            resource.setrlimit(resource.RLIMIT_AS, (most, most))
        # Libraries warn about damaged files.
        os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        for number in numbers:
            case, data = an_input(name, cases, number, seed)
            began.value, current.value = time.monotonic(), number
            spent = time.process_time()
            said = complaint(case, data)
            spent = time.process_time() - spent
            peak, before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, peak
            if not said and (spent > SLOW or peak - before > 1024 * LARGE):
                said = f"took {spent:.1f} s and {(peak - before) // 1024} MB"
            if said:
                to.send((number, said))
            began.value = time.monotonic()
    to.close()
    # The explorer ends likewise. The interpreter's normal end would abort a session's thread inside C++ code.
    os._exit(0)


def complaint(case: FuzzCase, data: bytes) -> str:
    """Read an input; an error that a reader must not raise in one line, with the place it came from, or nothing."""
    try:
        case.read(data)
    except LPNError as error:
        # A person reads a sentence or two, and no traceback.
        return "" if str(error) and "\n" not in str(error) else f"several lines, or none: {str(error)!r}"
    except Exception as error:
        trace = error.__traceback__
        while trace is not None and trace.tb_next is not None:
            trace = trace.tb_next
        where = "" if trace is None else f" ({Path(trace.tb_frame.f_code.co_filename).name}:{trace.tb_lineno})"
        return f"{type(error).__name__}: {json.dumps(str(error))[:200]}{where}"
    return ""


def main() -> int:
    """Run the readers and print the findings."""
    parser = argparse.ArgumentParser(prog="python -m tools.fuzz.readers", description="Damage what is read.")
    parser.add_argument("--inputs", type=int, default=10_000, help="for each reader")
    parser.add_argument("--reader", action="append", choices=[*TARGETS], help="this one alone; may be repeated")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--again", type=int, help="read this input of one --reader again, with its traceback")
    given = parser.parse_args()
    names = given.reader or [*TARGETS]
    if given.again is not None:
        with tempfile.TemporaryDirectory(prefix="lpn-fuzz-") as folder:
            case, data = an_input(names[0], TARGETS[names[0]](Path(folder)), given.again, given.seed)
            print(f"{len(data)} bytes, beginning with {data[:80]!r}")
            case.read(data)
        return 0
    bad = 0
    for name in names:
        started = time.monotonic()
        done, found = run(name, given.inputs, given.seed)
        bad += len(found)
        print(f"{name}: {done:,} inputs in {time.monotonic() - started:.0f} s, {len(found)} findings", flush=True)
        for number, said in found:
            print(f"  {number}: {said}", flush=True)
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
