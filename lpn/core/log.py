"""The log: one line on stderr for each thing, with time and level. Quiet unless asked: warnings and errors alone.

What names and texts of others hold cannot break a line, and no token is ever in one.
"""

from __future__ import annotations

import logging
import os
import re
import sys
import traceback
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from typing import Final, Literal, get_args
from urllib.parse import quote, quote_plus

from lpn.core.errors import InputError
from lpn.core.files import printable

VARIABLE: Final = "LPN_LOG"
"""The environment variable that the level is read from."""
FLAG: Final = "--log-level"
Level = Literal["debug", "info", "warning", "error"]
LEVELS: tuple[Level, ...] = get_args(Level)
OURS = ("lpn", "explorer")
_HIDDEN = "***"
_TOKEN = re.compile(r"(token=)[^&\s\"'<>]+", re.IGNORECASE)
_LONGEST = 1000


def level_given(arguments: list[str], environ: Mapping[str, str] | None = None) -> tuple[Level, list[str]]:
    """The level that command line or environment name, and the arguments without it.

    Raises:
        InputError: when it is none.
    """
    environ = os.environ if environ is None else environ
    level, said, rest = environ.get(VARIABLE, "").strip() or "warning", VARIABLE, list(arguments)
    for position, argument in enumerate(rest):
        if argument == FLAG or argument.startswith(f"{FLAG}="):
            both = argument == FLAG
            level = "".join(rest[position + 1 : position + 2]) if both else argument.partition("=")[2]
            said = FLAG
            del rest[position : position + 1 + both]
            break
    level = level.lower()
    if level not in LEVELS:
        raise InputError(f"{said} is {printable(level)[:40]!r}; expected one of {', '.join(LEVELS)}.")
    return level, rest


@contextmanager
def shown(level: Level) -> Iterator[None]:
    """Show the log on stderr while this lasts: our own from this level on, others' from warnings on."""
    handler = _Stderr()
    handler.setFormatter(Lines(level == "debug"))
    root = logging.getLogger()
    names = {name: level.upper() for name in OURS} | {
        # It calls a browser's connection that was opened ahead and never used, or a port scan, an error.
        "websockets": "ERROR" if level == "debug" else "CRITICAL"
    }
    before = {name: logging.getLogger(name).level for name in names}
    for name, wanted in names.items():
        logging.getLogger(name).setLevel(wanted)
    root.addHandler(handler)
    try:
        yield
    finally:
        root.removeHandler(handler)
        for name, old in before.items():
            logging.getLogger(name).setLevel(old)


class Lines(logging.Formatter):
    """A record as one line. Tracebacks follow, indented: those of our own, and of libraries at debug.

    Args:
        whole: whether libraries' tracebacks are shown, too.
    """

    def __init__(self, whole: bool) -> None:
        super().__init__("%(asctime)s.%(msecs)03d %(levelname)-7s %(name)s: %(message)s", "%Y-%m-%d %H:%M:%S")
        self._whole = whole

    def format(self, record: logging.LogRecord) -> str:
        """The line, without a line break at its end."""
        line = logging.LogRecord(record.name, record.levelno, "", 0, _said(record), None, None)
        line.created, line.msecs = record.created, record.msecs
        text = super().format(line)
        error = record.exc_info[1] if record.exc_info else None
        if error is None:
            return text
        if self._whole or record.name.partition(".")[0] in OURS:
            traced = "".join(traceback.format_exception(error)).splitlines()
            text = "\n".join([text, *(f"    {_short(one)}" for one in traced)])
        else:
            text += f" ({type(error).__name__}: {_short(str(error), 200)})"
        return text


_SECRETS: list[str] = []


def conceal(secret: str | None) -> None:
    """Let no line show this from now on, as it is or as an address or a form has it."""
    if secret:
        _SECRETS.extend({secret, quote(secret, safe=""), quote_plus(secret)} - set(_SECRETS))
        del _SECRETS[:-100]


def concealed(text: str) -> str:
    """A text without tokens: those that are known, and whatever an address gives as one."""
    for secret in _SECRETS:
        text = text.replace(secret, _HIDDEN)
    return _TOKEN.sub(rf"\1{_HIDDEN}", text)


class _Stderr(logging.Handler):
    """Writes to what stderr is at the time."""

    def emit(self, record: logging.LogRecord) -> None:
        with suppress(OSError, ValueError):  # a closed terminal
            sys.stderr.write(self.format(record) + "\n")
            sys.stderr.flush()


def _said(record: logging.LogRecord) -> str:
    try:
        message = record.getMessage()
    except Exception:  # a library's mistake is no reason to fail
        message = str(record.msg)
    return _short(message)


def _short(text: str, longest: int = _LONGEST) -> str:
    """A text of others as part of a line; tokens go first, as half of one would not be known for what it is."""
    return printable(concealed(text))[:longest]
