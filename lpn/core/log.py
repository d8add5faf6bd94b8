"""The log on stderr: one line a record, with time and level. Only warnings and errors are shown unless asked otherwise.

Text from outside cannot break a line, and no line contains a token.
"""

from __future__ import annotations

import logging
import os
import re
import sys
import traceback as tracebacks
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Final, Literal, get_args
from urllib.parse import quote, quote_plus

from lpn.core.errors import InputError
from lpn.core.files import printable

# The environment variable and the flag that set the level.
VARIABLE: Final = "LPN_LOG"
FLAG: Final = "--log-level"
LogLevel = Literal["debug", "info", "warning", "error"]
LEVELS: tuple[LogLevel, ...] = get_args(LogLevel)
OUR_LOGGERS = ("lpn", "explorer")
_TOKEN = re.compile(r"(token=)[^&\s\"'<>]+", re.IGNORECASE)
_MAX_LENGTH = 1000


def parse_level(arguments: list[str]) -> tuple[LogLevel, list[str]]:
    """Return the level from the command line or else the environment, and the remaining arguments.

    Raises:
        InputError: if the level is unknown.
    """
    level, source, rest = os.environ.get(VARIABLE, "").strip() or "warning", VARIABLE, list(arguments)
    for position, argument in enumerate(rest):
        if argument == FLAG or argument.startswith(f"{FLAG}="):
            separate = argument == FLAG
            level = "".join(rest[position + 1 : position + 2]) if separate else argument.partition("=")[2]
            source = FLAG
            del rest[position : position + 1 + separate]
            break
    level = level.lower()
    if level not in LEVELS:
        raise InputError(f"{source} is {printable(level)[:40]!r}; expected one of {', '.join(LEVELS)}.")
    return level, rest


@contextmanager
def log_to_stderr(level: LogLevel) -> Iterator[None]:
    """Log to stderr inside the context: our own loggers from `level` on, libraries' loggers from warnings on."""
    handler, root = StderrHandler(whole_tracebacks=level == "debug"), logging.getLogger()
    levels = dict.fromkeys(OUR_LOGGERS, level.upper())
    # websockets reports port scans, and connections that a browser opens in advance, as errors.
    levels["websockets"] = "ERROR" if level == "debug" else "CRITICAL"
    before = {name: logging.getLogger(name).level for name in levels}
    for name, wanted in levels.items():
        logging.getLogger(name).setLevel(wanted)
    root.addHandler(handler)
    try:
        yield
    finally:
        root.removeHandler(handler)
        for name, old in before.items():
            logging.getLogger(name).setLevel(old)


def conceal(secret: str | None) -> None:
    """Hide a secret in all further lines of the running log, also where it is URL-encoded."""
    for handler in logging.getLogger().handlers:
        if isinstance(handler, StderrHandler) and secret:
            handler.secrets |= {secret, quote(secret, safe=""), quote_plus(secret)}


class StderrHandler(logging.Handler):
    """Writes one line a record. Indented tracebacks of our loggers follow; with `whole_tracebacks`, those of all loggers.

    Attributes:
        secrets: texts that no line may contain.
    """

    def __init__(self, whole_tracebacks: bool = False) -> None:
        super().__init__()
        self.setFormatter(
            logging.Formatter("%(asctime)s.%(msecs)03d %(levelname)-7s %(name)s: %(message)s", "%Y-%m-%d %H:%M:%S")
        )
        self.secrets: set[str] = set()
        self._whole_tracebacks = whole_tracebacks

    def emit(self, record: logging.LogRecord) -> None:
        """Write a record; drop it if that fails, because logging would print it with its secrets."""
        with suppress(Exception):
            sys.stderr.write(f"{self.format(record)}\n")

    def format(self, record: logging.LogRecord) -> str:
        """Return the record's line, and its traceback's lines."""
        try:
            message = record.getMessage()
        except Exception:  # a library's malformed call must not fail here
            message = str(record.msg)
        plain = {"msg": self._clean(message), "args": None, "exc_info": None, "exc_text": None, "stack_info": None}
        text = super().format(logging.makeLogRecord({**vars(record), **plain}))
        error = record.exc_info[1] if record.exc_info else None
        if error is None:
            return text
        if self._whole_tracebacks or record.name.partition(".")[0] in OUR_LOGGERS:
            lines = "".join(tracebacks.format_exception(error)).splitlines()
            return "\n".join([text, *(f"    {self._clean(line)}" for line in lines)])
        return f"{text} ({type(error).__name__}: {self._clean(str(error), 200)})"

    def _clean(self, text: str, length: int = _MAX_LENGTH) -> str:
        """Hide secrets before cutting: half a token would not be recognised."""
        for secret in self.secrets:
            text = text.replace(secret, "***")
        return printable(_TOKEN.sub(r"\1***", text))[:length]
