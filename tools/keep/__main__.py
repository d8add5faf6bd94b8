"""Measure what must not get worse: `python -m tools.keep [NAME ...] [--slow] [--out FILE] [--accept NAME]`.

Without names, the quick measures run, and with `--slow` the slow ones. The program ends with status 1 and one sentence for each
broken bound. `--accept` writes the new baseline of a measure whose figures changed on purpose, unless they break a bound that
does not depend on the baseline.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import subprocess
import sys
import time
import traceback
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from lpn.core.errors import InputError, LPNError
from lpn.core.files import check_outputs, portable, write_atomic
from lpn.core.resources import usable_cores
from tools.keep.measures import Figures, Measure, NotMeasuredError, Value, all_measures, errors

BASELINE = Path(__file__).with_name("baseline")
_ROOT = Path(__file__).parents[2]
# The measured code, and the measuring code: changes elsewhere change no figure.
_PRODUCT = ("lpn", "explorer", "assets")
_TOOLS = ("tools", "pyproject.toml", "constraints.txt", ":!tools/keep/baseline")


def main(arguments: Sequence[str], measures: dict[str, Measure] | None = None, baseline: Path = BASELINE) -> int:
    """Measure, print the table, and return the exit status.

    Args:
        measures: by default all.
        baseline: folder of the baselines, one file for each measure.
    """
    known = all_measures() if measures is None else measures
    options = _parser(known).parse_args(arguments)
    if unknown := sorted(set(options.names + options.accept) - set(known)):
        return _refuse(f"There is no measure {', '.join(unknown)}; there are {', '.join(known)}.")
    names = options.names + options.accept + ["calls"] * options.calls
    names = list(dict.fromkeys(names)) or [name for name, one in known.items() if one.slow == options.slow]
    try:
        check_outputs((options.out, ".json"))
        state = _state(*_PRODUCT, *_TOOLS)
        records = _earlier(options.out, state)
        for name in names:
            if "figures" not in records.get(name, {}):
                print(f"Measuring {name} ...", file=sys.stderr, flush=True)
                records[name] = _measured(known[name])
            old = _read(baseline / f"{name}.json", "figures").get("figures", {})
            records[name] = _compared(known[name], records[name], old)
            if name in options.accept and "figures" in records[name]:
                found = _values(records[name])
                if wrong := errors(known[name], found, found):
                    return _refuse(
                        f"{name} is not accepted: {'; '.join(f'{one}: {why}' for one, why in wrong.items())}."
                    )
                _write(baseline / f"{name}.json", {"commit": _state(*_PRODUCT), "figures": found}, 2)
                _show({name: records[name]}, "Accepted: the old baseline beside the new one")
                records[name] = _compared(known[name], records[name], found)
            elif name in options.accept:
                records[name].setdefault("error", f"{name}: nothing was measured, so its baseline stays as it is.")
            if options.out is not None:
                _write(options.out, {"commit": state, "cores": usable_cores(), "measures": records}, 4)
        _show({name: records[name] for name in names})
    except LPNError as error:
        return _refuse(str(error))
    broken = [sentence for name in names for sentence in _sentences(name, records[name])]
    unmeasured = [f"{n} was not measured: {records[n]['not_measured']}." for n in names if "not_measured" in records[n]]
    for sentence in (*unmeasured, *broken):
        print(sentence, file=sys.stderr)
    return 1 if broken else 0


def _parser(known: dict[str, Measure]) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m tools.keep", description="Measure what must not get worse.")
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"measures: {', '.join(known)}")
    parser.add_argument("--slow", action="store_true", help="run the slow half instead of the quick one")
    parser.add_argument("--calls", action="store_true", help="count the calls of a turn, and print their path")
    parser.add_argument("--out", type=Path, help="JSON file of the results; the same commit goes on where it stopped")
    parser.add_argument(
        "--accept", action="append", default=[], metavar="NAME", help="write a new baseline for this measure"
    )
    return parser


def _refuse(sentence: str) -> int:
    print(sentence, file=sys.stderr)
    return 1


def _state(*paths: str) -> str:
    """The last commit of some paths, with a digest of what differs from it; empty outside of a checkout."""
    commands = ("log", "-1", "--format=%h", "--abbrev=8"), ("diff", "HEAD"), ("ls-files", "-o", "--exclude-standard")
    commit, *changed = (
        subprocess.run(
            ["git", "-C", str(_ROOT), *command, "--", *paths], capture_output=True, text=True, check=False
        ).stdout.strip()
        for command in commands
    )
    return commit + (f"+{hashlib.sha256(''.join(changed).encode()).hexdigest()[:8]}" if any(changed) else "")


def _read(file: Path, key: str) -> dict[str, Any]:
    """Read a file of this program, which has a key beside "commit"; empty without the file."""
    if not file.is_file():
        return {}
    try:
        found = json.loads(file.read_bytes())
    except ValueError:
        found = None
    if not isinstance(found, dict) or not isinstance(found.get(key), dict):
        raise InputError(f'{file} is no JSON of tools.keep with "{key}"; name another file, or delete this one.')
    return found


def _earlier(out: Path | None, state: str) -> dict[str, Any]:
    """The records of an interrupted run of the same state of the code."""
    found = {} if out is None else _read(out, "measures")
    return dict(found["measures"]) if state and found.get("commit") == state else {}


def _measured(measure: Measure) -> dict[str, Any]:
    started = time.perf_counter()
    try:
        figures = measure.run()
    except NotMeasuredError as reason:
        return {"not_measured": str(reason)}
    except Exception as error:
        traceback.print_exc()
        return {"error": f"{measure.name} failed: {type(error).__name__}: {error}"}
    seconds = round(time.perf_counter() - started, 1)
    return {"seconds": seconds, "figures": {name: {"value": value} for name, value in figures.items()}}


def _values(record: dict[str, Any]) -> dict[str, Value]:
    return {name: one["value"] for name, one in record["figures"].items() if "value" in one}


def _compared(measure: Measure, record: dict[str, Any], baseline: Figures) -> dict[str, Any]:
    """Add baseline, bound, and verdict to each figure of a record; of a list, only its largest change."""
    if "figures" not in record:
        return record
    found = _values(record)
    wrong = errors(measure, found, baseline)
    figures: dict[str, dict[str, Any]] = {}
    for name in {**found, **wrong}:
        bound = measure.bound(name)
        figures[name] = {"value": found[name]} if name in found else {}
        old = baseline.get(name)
        figures[name] |= {} if old is None or isinstance(old, list) else {"baseline": old}
        figures[name] |= {"change": _change(found.get(name), old)}
        figures[name] |= {"bound": "" if bound is None else bound.text, "verdict": wrong.get(name, "held")}
    return {**record, "figures": figures}


def _sentences(name: str, record: dict[str, Any]) -> list[str]:
    if "error" in record:
        return [record["error"]]
    verdicts = {figure: one["verdict"] for figure, one in record.get("figures", {}).items()}
    return [f"{name}, {figure}: {verdict}." for figure, verdict in verdicts.items() if verdict != "held"]


def _text(value: object, depth: int, indent: str = "") -> str:
    """JSON in which the entries of the outer dictionaries have a line each, down to a depth."""
    if not depth or not isinstance(value, dict):
        return json.dumps(portable(value), separators=(",", ":"))
    inner = f"{indent} "
    lines = [f"{inner}{json.dumps(key)}: {_text(entry, depth - 1, inner)}" for key, entry in value.items()]
    return "{\n" + ",\n".join(lines) + f"\n{indent}}}"


def _write(file: Path, value: object, depth: int) -> None:
    write_atomic(file, f"{_text(value, depth)}\n".encode())


def _show(records: dict[str, Any], title: str = "What must not get worse") -> None:
    table = Table(title=title)
    for column in ("measure", "figure", "value", "baseline", "largest change", "bound", ""):
        table.add_column(column, justify="right" if column in ("value", "baseline", "largest change") else "left")
    for name, record in records.items():
        for figure, one in record.get("figures", {}).items():
            verdict = "held" if one["verdict"] == "held" else "[red]BROKEN[/]"
            verdict = "" if one["bound"] == "reported" else verdict
            values = (_short(one.get(key)) for key in ("value", "baseline", "change"))
            table.add_row(name, escape(figure), *values, one["bound"], verdict)
        reason = record.get("not_measured") or record.get("error")
        if reason:
            table.add_row(name, escape(reason), "", "", "", "", "not measured")
        table.add_section()
    Console(width=150).print(table)


def _short(value: Value | None) -> str:
    match value:
        case None:
            return ""
        case list():
            return f"{len(value):,} values"
        case str():
            return escape(value if len(value) <= 40 else f"{value[:37]}...")
    return f"{value:g}"


def _change(value: Value | None, baseline: Value | None) -> float | None:
    """The largest difference of two numbers or lists of one length; None of others."""
    if value is None or baseline is None or isinstance(value, str) or isinstance(baseline, str):
        return None
    new, old = (one if isinstance(one, list) else [one] for one in (value, baseline))
    differences = [abs(a - b) for a, b in zip(new, old, strict=False)]
    return float(f"{max(differences, default=0):.2g}") if len(new) == len(old) else None


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
