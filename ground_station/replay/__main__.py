"""``python -m ground_station.replay``: the process behind ``covrecon replay``, alone like the ground station in flight.

Alone, because a process that compiled a kernel itself computes other last bits than one that found it compiled, and so
might more numerical threads than a ground station has.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from rich.console import Console
from rich.progress import Progress

from ground_station.replay.run import replay
from ground_station.replay.text import describe
from protocol.errors import CovreconError, MissionError

SAME, DIFFERENT, BAD_INPUT = 0, 1, 2
"""Exit codes. With changed settings it is SAME: the difference is what was asked for."""
LINE_PERIOD_S = 5.0
"""Between two lines of progress where there is no terminal."""


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m ground_station.replay")
    parser.add_argument("recording", type=Path)
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="change a setting")
    parser.add_argument("--out", type=Path, help="folder for what the replay comes to")
    parsed = parser.parse_args(arguments)
    told, asked = _console(stderr=True), _console(stderr=False)
    try:
        with _progress(told) as progress:
            replayed = replay(parsed.recording, parsed.set, parsed.out, progress=progress, now_s=time.monotonic)
    except CovreconError as error:
        told.print(error)
        return BAD_INPUT if isinstance(error, MissionError) else DIFFERENT
    for line in describe(replayed):
        asked.print(line)
    return DIFFERENT if replayed.comparison.difference and not replayed.changed else SAME


def _console(*, stderr: bool) -> Console:
    return Console(stderr=stderr, highlight=False, markup=False, soft_wrap=True)


@contextmanager
def _progress(console: Console) -> Iterator[Callable[[int, int], None]]:
    """A bar on a terminal, a line now and then elsewhere."""
    if console.is_terminal:
        with Progress(console=console, transient=True) as bar:
            task = bar.add_task("replay", total=None)
            yield lambda tick, last: bar.update(task, completed=tick, total=last)
        return
    said_s = time.monotonic()

    def say(tick: int, last: int) -> None:
        nonlocal said_s
        if time.monotonic() - said_s >= LINE_PERIOD_S:
            said_s = time.monotonic()
            console.print(f"replayed tick {tick} of {last}")

    yield say


if __name__ == "__main__":
    sys.exit(main())
