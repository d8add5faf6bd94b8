"""The `lpn` command: finds the subcommand, parses its options, and reports each error in one sentence."""

from __future__ import annotations

import io
import os
import select
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import cache, partial
from importlib import import_module
from importlib.metadata import entry_points
from pkgutil import iter_modules
from typing import Any, TextIO

import lpn.cli
from lpn.cli.parsing import parse
from lpn.core import log
from lpn.core.consoles import plain_streams, progress_bars
from lpn.core.errors import LPNError
from lpn.core.files import printable
from lpn.core.requirements import broken_package, missing_package
from lpn.core.shutdown import WRITE_SECONDS, StopSignals, exit_now, writes_finished


@cache  # it looks through all installed packages
def commands() -> dict[str, type[Any]]:
    """Return the subcommands, sorted by name: entry points `lpn.commands`, and classes NameCommand in `lpn.cli`."""
    found = {point.name: point.load() for point in entry_points(group="lpn.commands")}
    for module in iter_modules(lpn.cli.__path__):
        if module.name != "main":
            of = import_module(f"lpn.cli.{module.name}")
            classes = [name for name, value in vars(of).items() if getattr(value, "__module__", "") == of.__name__]
            found |= {
                name.removesuffix("Command").lower(): getattr(of, name) for name in classes if name.endswith("Command")
            }
    return dict(sorted(found.items()))


def main(arguments: Sequence[str] | None = None, stopped: Callable[[int], object] = lambda status: status) -> int:
    """Run the command line, and return the exit status.

    The status is 0; 1 if doctor or describe with Ray found damage; 2 after an error of the user; or 128 plus the number of the
    signal that stopped the command. A command whose reader closes the pipe (`lpn doctor | head -1`) ends silently with 128 plus
    the number of SIGPIPE. SIGPIPE itself stays ignored, Python's default, because it would end a server when a browser leaves.

    Args:
        stopped: called with the status if a signal stopped the command, while further signals are still handled.
    """
    try:
        try:
            return _run_until_stopped(arguments, stopped)
        finally:  # otherwise Python reports a closed pipe at exit
            if sys.stdout is not None:
                sys.stdout.flush()
    except SystemExit as error:
        # Rich ends the command when its pipe is closed.
        if not isinstance(error.__context__, BrokenPipeError):
            raise
    except OSError as error:
        if not _is_unread(error):
            return _refused(error)
    for stream in filter(_reader_left, (sys.stdout, sys.stderr)):
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
    return 128 + 13  # SIGPIPE; Windows has no name for it


def _is_unread(error: OSError) -> bool:
    """Return whether an error comes from a closed standard output or error, not from a connection."""
    return isinstance(error, BrokenPipeError) and (_reader_left(sys.stdout) or _reader_left(sys.stderr))


def _reader_left(stream: TextIO) -> bool:
    """Return whether the reader of a pipe has closed it."""
    with suppress(AttributeError, OSError, ValueError):  # Windows cannot tell; a stream may have no file
        watch = select.poll()
        watch.register(stream.fileno(), 0)
        return bool(watch.poll(0))
    return False


def _run_until_stopped(arguments: Sequence[str] | None, stopped: Callable[[int], object]) -> int:
    for stream in (sys.stdout, sys.stderr):
        # A terminal that cannot encode a character must not raise.
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")
    try:
        level, words = log.parse_level(list(sys.argv[1:] if arguments is None else arguments))
    except LPNError as error:
        print(f"lpn: {error}", file=sys.stderr)
        return 2
    if not words or words[0] in ("-h", "--help"):
        print(_help())
        return 0
    if words[0] == "--version":
        print(lpn.__version__)
        return 0
    if words[0] not in commands():
        print(f"lpn has no command {words[0]!r}; it has {', '.join(commands())}.", file=sys.stderr)
        return 2
    parsed: list[Any] = []
    stop = StopSignals(lambda number: _stopped(parsed, number))
    with plain_streams(), log.log_to_stderr(level), stop.listening():
        try:
            return _run(words, parsed)
        except KeyboardInterrupt:
            pass
        except BaseException:  # libraries may convert KeyboardInterrupt
            if not stop.signal:
                raise
        writes_finished(WRITE_SECONDS)  # in other threads
        status = stop.end()
        if stop.signal:
            stopped(status)
        return status


def _run(arguments: list[str], parsed: list[Any]) -> int:
    """Parse a command, append it to `parsed`, and run it."""
    try:
        command = commands()[arguments[0]]
        with plain_streams(colours=sys.stdout.isatty()):  # tyro prints colours
            parsed.append(reader(command)(arguments[1:], f"lpn {arguments[0]}"))
        with progress_bars():
            return int(parsed[0].run() or 0)
    except LPNError as error:
        print(f"lpn: {printable(str(error))}", file=sys.stderr)
        return 2
    except ModuleNotFoundError as error:
        print(f"lpn: {missing_package(error)}", file=sys.stderr)
        return 2
    except ImportError as error:
        print(f"lpn: {broken_package(error)}", file=sys.stderr)
        return 2
    except OSError as error:
        if _is_unread(error):
            raise
        return _refused(error)


def reader(command: type[Any]) -> Callable[[list[str], str], Any]:
    """Return a command's parser of arguments and program name: its own `parse`, or the default one."""
    return getattr(command, "parse", partial(parse, command))


def _refused(error: OSError) -> int:
    name = f" ({printable(str(error.filename))})" if error.filename else ""
    print(f"lpn: The system refused a file or device{name}: {error.strerror or error}.", file=sys.stderr)
    return 2


def _stopped(parsed: list[Any], number: int) -> int:
    """Report that the command was stopped, and how to resume."""
    command = parsed[0] if parsed else None
    serves = getattr(command, "SERVES", False)  # a stop is the normal end of a server
    with suppress(OSError):  # a closed terminal
        if serves:
            print("Stopped.", flush=True)
        elif os.environ.get("RANK", "0") == "0":  # only one process of a training reports it
            how = getattr(command, "resume_hint", lambda: _AGAIN)
            print(f"lpn: Stopped. {how()}", file=sys.stderr, flush=True)
    return 0 if serves else 128 + number


_AGAIN = "Nothing is half-written; give the same command again."


def _help() -> str:
    lines = [
        f"  {name:10} {(command.__doc__ or '').strip().partition(chr(10))[0]}" for name, command in commands().items()
    ]
    return "\n".join(
        [
            "usage: lpn COMMAND [--help]",
            "",
            "LPN, the Local Pattern Network for cross-view geo-localization, and its explorer.",
            "",
            *lines,
            "",
            "lpn COMMAND --help lists the options of a command, --help-all all of them; lpn --version prints the version.",
            f"lpn {log.FLAG} debug COMMAND shows more messages ({', '.join(log.LEVELS)}; or set {log.VARIABLE}).",
        ]
    )


def run() -> None:
    """The console script; after a stop it waits for no thread that still computes."""
    sys.exit(main(None, exit_now))


if __name__ == "__main__":
    run()
