"""How all processes log: one line a record for people, or one JSON object a record for machines (``COVRECON_LOG``).

Modules log by `logging.getLogger(__name__)`, and give figures that a machine should find by ``extra=``. structlog only
renders the records here, those of libraries too.
"""

from __future__ import annotations

import logging
import os
import sys
import threading
from collections.abc import Mapping
from datetime import UTC, datetime
from types import TracebackType
from typing import Any, Literal, get_args

from structlog.processors import ExceptionRenderer, JSONRenderer, format_exc_info
from structlog.stdlib import ExtraAdder, ProcessorFormatter
from structlog.tracebacks import ExceptionDictTransformer
from structlog.typing import EventDict, Processor, WrappedLogger

from protocol.errors import ProcessError

LogFormat = Literal["human", "json"]
VARIABLE = "COVRECON_LOG"
"""Environment variable with the format; without it "human"."""
FRAMES_MAX = 30
"""Of an exception in JSON; local variables are never written: they may be secret, and large."""

log = logging.getLogger(__name__)


def configure(role: str, mission: str = "", drone: int = 0, environment: Mapping[str, str] = os.environ) -> None:
    """Send all records from INFO on to stderr; every JSON record says which process it came from. May be called again.

    Args:
        role: kind of process, as in ``python -m role``.
        mission: name of the mission; empty before it is known.
        drone: 0 where it has no meaning.

    Raises:
        ProcessError: ``environment`` asks for a format that does not exist.
    """
    form = environment.get(VARIABLE) or "human"
    if form not in get_args(LogFormat):
        raise ProcessError(f"{VARIABLE}={form}: must be one of {', '.join(get_args(LogFormat))}")
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(_human() if form == "human" else _json(_identity(role, mission, drone)))
    logging.basicConfig(level=logging.INFO, handlers=[handler], force=True)
    logging.captureWarnings(capture=True)
    if form == "json":  # what nobody catches would be printed as plain lines between the records
        sys.excepthook = _log_uncaught
        threading.excepthook = _log_uncaught_in_thread


def say_last(error: Exception) -> None:
    """Say on stderr what ended this process: bare for a person, whose eye falls on the last line; in JSON a record."""
    handlers = logging.getLogger().handlers
    if any(isinstance(handler.formatter, _JsonFormatter) for handler in handlers):
        log.critical("%s", error)
    else:
        sys.stderr.write(f"{error}\n")


class _JsonFormatter(ProcessorFormatter):
    """A type of its own, by which `say_last` knows it."""


def _human() -> ProcessorFormatter:
    return ProcessorFormatter(foreign_pre_chain=[ExtraAdder()], processors=[format_exc_info, _line])


def _json(identity: dict[str, str | int]) -> ProcessorFormatter:
    def identify(_logger: WrappedLogger, _method: str, event: EventDict) -> EventDict:
        record: logging.LogRecord = event.pop("_record")
        event.pop("_from_structlog")
        head = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "logger": record.name,
        }
        return {**head, "event": event.pop("event"), **identity, **event}

    exceptions = ExceptionRenderer(ExceptionDictTransformer(show_locals=False, max_frames=FRAMES_MAX))
    chain: list[Processor] = [identify, exceptions, JSONRenderer()]
    return _JsonFormatter(foreign_pre_chain=[ExtraAdder()], processors=chain)


def _identity(role: str, mission: str, drone: int) -> dict[str, str | int]:
    known: dict[str, str | int] = {"role": role}
    if mission:
        known["mission"] = mission
    if drone:
        known["drone"] = drone
    return known


_TIME = logging.Formatter()
"""Local time as `logging` writes it."""


def _line(_logger: WrappedLogger, _method: str, event: EventDict) -> str:
    """``2026-11-22 20:23:49,793 INFO ground_station.status: drone/1 is there``, then extras as key=value.

    Further lines are indented: text that came over the bus cannot pass for a record.
    """
    record: logging.LogRecord = event.pop("_record")
    event.pop("_from_structlog")
    text, exception = event.pop("event").rstrip().replace("\n", "\n    "), event.pop("exception", None)
    extras = "".join(f" {key}={value!r}" for key, value in event.items())
    line = f"{_TIME.formatTime(record)} {record.levelname} {record.name}: {text}{extras}"
    return line if exception is None else f"{line}\n{exception}"


def _log_uncaught(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    log.critical("uncaught %s", kind.__name__, exc_info=(kind, error, trace))


def _log_uncaught_in_thread(end: Any) -> None:
    """``end``: `threading.ExceptHookArgs`."""
    if end.exc_type is not SystemExit:
        log.critical(
            "uncaught %s in thread %s",
            end.exc_type.__name__,
            end.thread.name if end.thread else "?",
            exc_info=(end.exc_type, end.exc_value, end.exc_traceback),
        )
