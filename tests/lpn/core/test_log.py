from __future__ import annotations

import logging
import re
from unittest.mock import Mock

import pytest

from lpn.cli import main
from lpn.core import log
from lpn.core.errors import InputError

LINE = r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d\.\d{3} "


@pytest.fixture
def logger() -> logging.Logger:
    return logging.getLogger("lpn.somewhere")


@pytest.fixture(autouse=True)
def _no_level_in_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(log.VARIABLE, raising=False)


def lines(capsys: pytest.CaptureFixture[str]) -> list[str]:
    return capsys.readouterr().err.splitlines()


@pytest.mark.parametrize(("level", "count"), [("debug", 4), ("info", 3), ("warning", 2), ("error", 1)])
def test_what_is_asked_for_is_shown_and_no_more(
    level: log.LogLevel, count: int, logger: logging.Logger, capsys: pytest.CaptureFixture[str]
) -> None:
    with log.log_to_stderr(level):
        for number in (logging.ERROR, logging.WARNING, logging.INFO, logging.DEBUG):
            logger.log(number, "It is %s", "so")
    found = lines(capsys)
    assert [line.split()[2] for line in found] == ["ERROR", "WARNING", "INFO", "DEBUG"][:count]
    assert re.fullmatch(LINE + "ERROR   lpn.somewhere: It is so", found[0])
    assert not logging.getLogger("lpn").level


def test_libraries_say_warnings_and_not_how_their_connections_end(capsys: pytest.CaptureFixture[str]) -> None:
    with log.log_to_stderr("debug"):
        logging.getLogger("websockets.server").info("connection open")
        logging.getLogger("asyncio").debug("Using selector")
    assert lines(capsys) == []
    with log.log_to_stderr("warning"):
        logging.getLogger("websockets.server").error("opening handshake failed", exc_info=ValueError("x"))
        logging.getLogger("asyncio").warning("slow")
        try:
            raise ValueError("odd\nvalue")
        except ValueError:
            logging.getLogger("viser").exception("It failed")
    found = lines(capsys)
    said = [re.split(r" [A-Z]+ +", line)[1] for line in found]
    assert said == ["asyncio: slow", "viser: It failed (ValueError: odd?value)"]


def test_no_text_of_others_breaks_a_line(logger: logging.Logger, capsys: pytest.CaptureFixture[str]) -> None:
    mistaken = logging.LogRecord("lpn", logging.WARNING, "", 0, "A mistake %s %d", ("of ours",), None)
    assert log.StderrHandler().format(mistaken).endswith("lpn: A mistake %s %d")
    with log.log_to_stderr("warning"):
        logger.warning("The picture %s", "a\nb\r\x1b[2J\u2028\x00%s" + "x" * 5000)
        try:
            raise ValueError("first\nsecond \x1b[31m")
        except ValueError:
            logger.exception("It failed")
    found = lines(capsys)
    assert found[0].endswith("x" * 900)
    assert "The picture a?b??[2J??%sxxx" in found[0]
    assert len(found[0]) < 1100
    assert found[1].endswith("It failed")
    assert found[2] == "    Traceback (most recent call last):"
    assert all(line.startswith("    ") for line in found[2:])
    assert "\x1b" not in "".join(found)


@pytest.mark.parametrize(
    "error", [BrokenPipeError(), OSError(5, "closed"), BlockingIOError(), ValueError("closed file")]
)
def test_a_closed_terminal_costs_the_line_alone(
    error: Exception, logger: logging.Logger, monkeypatch: pytest.MonkeyPatch
) -> None:
    terminal = Mock(write=Mock(side_effect=[error, None]))
    with log.log_to_stderr("warning"):
        log.conceal("open-sesame")
        monkeypatch.setattr("sys.stderr", terminal)
        logger.warning("The line %s", "open-sesame")
        logger.warning("The next")
    assert terminal.write.call_count == 2
    assert re.fullmatch(LINE + "WARNING lpn.somewhere: The next\n", terminal.write.call_args.args[0])


def test_no_token_is_shown(logger: logging.Logger, capsys: pytest.CaptureFixture[str]) -> None:
    with log.log_to_stderr("debug"):
        log.conceal("correct horse/battery")
        log.conceal(None)
        logger.debug("GET /?query=1&token=guessed%%20one&map=1 and %s", "correct horse/battery")
        logger.info("In an address: %s", "correct%20horse%2Fbattery")
        try:
            raise ValueError("token=another and correct horse/battery")
        except ValueError:
            logger.exception("It failed")
    shown = "\n".join(lines(capsys))
    for secret in ("guessed", "horse", "another"):
        assert secret not in shown.replace('raise ValueError("token=another', "")
    assert "query=1&token=***&map=1 and ***" in shown


def test_no_half_of_a_token_is_shown_where_a_line_is_cut(
    logger: logging.Logger, capsys: pytest.CaptureFixture[str]
) -> None:
    with log.log_to_stderr("debug"):
        log.conceal("correct horse/battery")
        logger.info("%s%s", "x" * 990, "correct horse/battery")
        logger.error("Failed", exc_info=ValueError("x" * 978 + "correct horse/battery"))
    with log.log_to_stderr("info"):
        log.conceal("correct horse/battery")
        logging.getLogger("viser").error("Failed", exc_info=ValueError("x" * 190 + "correct horse/battery"))
        logger.info("token of a form: correct+horse%2Fbattery")
    shown = capsys.readouterr().err
    assert shown.count("***") == 4
    assert max(map(len, shown.splitlines())) < 1100
    assert "correct" not in shown


@pytest.mark.parametrize(
    ("given", "environ", "level", "rest"),
    [
        (["explore"], "", "warning", ["explore"]),
        (["explore"], " INFO ", "info", ["explore"]),
        (["--log-level", "debug", "explore", "--port", "1"], "info", "debug", ["explore", "--port", "1"]),
        (["explore", "--log-level=error"], "", "error", ["explore"]),
        (["--log-level", "all"], "", None, []),
        (["x", "--log-level"], "", None, []),
        ([], "verbose", None, []),
    ],
)
def test_the_level_comes_from_the_command_line_or_else_from_the_environment(
    given: list[str], environ: str, level: str | None, rest: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(log.VARIABLE, environ)
    if level is not None:
        assert log.parse_level(given) == (level, rest)
        return
    with pytest.raises(InputError, match="expected one of debug, info, warning, error"):
        log.parse_level(given)


def test_the_command_line_names_it(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    assert main.main(["--help"]) == 0
    assert "--log-level debug COMMAND" in capsys.readouterr().out
    monkeypatch.setenv("LPN_LOG", "loud")
    assert main.main(["doctor"]) == 2
    assert capsys.readouterr().err == "lpn: LPN_LOG is 'loud'; expected one of debug, info, warning, error.\n"
