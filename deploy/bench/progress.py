"""How far a study is: bars on a terminal, plain lines everywhere else."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Protocol, Self

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn
from rich.text import Text

from ground_station.study.plan_file import PlannedFlight

LINE_PERIOD_S = 60.0
"""Between two plain lines while no flight ends, wall time."""


@dataclass(slots=True)
class Tally:
    """What is flown, what flies, and about how long the rest takes.

    A flight's work counts as its duration for each process that thinks: the drones, and what they share.
    """

    left: dict[str, float]
    """Work of the flights that are not flown yet, by name."""
    flown: int
    """Flights, also those of earlier calls."""
    total: int
    shares: dict[str, float] = field(default_factory=dict)
    """Of each flight that flies, how much of it is flown."""
    done: float = 0.0
    """Work of the flights that ended in this call."""
    words: tuple[str, str] = ("flights flown", "flying")
    """What is done, and what is being done; where it is something else than flights."""

    @classmethod
    def of(cls, planned: Sequence[PlannedFlight], left: Sequence[PlannedFlight], duration_s: float) -> Self:
        work = {flight.name: duration_s * (SHARED_WORK + flight.drones) for flight in left}
        return cls(work, len(planned) - len(left), len(planned))

    def began(self, name: str) -> None:
        self.shares[name] = 0.0

    def ended(self, name: str, *, well: bool) -> None:
        self.shares.pop(name, None)
        self.done += self.left.pop(name)
        self.flown += well

    def rest_s(self, elapsed_s: float) -> float:
        """Wall time until all is flown, at the pace so far; NaN before there is one."""
        under_way = sum(self.left[name] * share for name, share in self.shares.items())
        worked = self.done + under_way
        return elapsed_s * (sum(self.left.values()) - under_way) / worked if worked > 0 else math.nan

    def text(self, elapsed_s: float) -> str:
        rest_s = self.rest_s(elapsed_s)
        rest = f"about {duration_text(rest_s)} left" if math.isfinite(rest_s) else "time left not known yet"
        finished, under_way = self.words
        return f"{self.flown} of {self.total} {finished}, {len(self.shares)} {under_way}, {rest}"


SHARED_WORK = 2.0
"""Of the simulator and the ground station, in drones."""


def duration_text(seconds: float) -> str:
    minutes = math.ceil(seconds / 60)
    return f"{minutes // 60} h {minutes % 60} min" if minutes >= 60 else f"{minutes} min"


class Watch(Protocol):
    def began(self, name: str) -> None: ...
    def ended(self, name: str, text: str, *, well: bool) -> None: ...
    def flown(self, shares: dict[str, float]) -> None:
        """Now and then: how much is flown of the flights that fly."""

    def say(self, text: str) -> None: ...
    def __enter__(self) -> Self: ...
    def __exit__(self, *_: object) -> None: ...


class PlainWatch:
    """A line for each flight that ended, and one now and then."""

    def __init__(self, tally: Tally, write: Callable[[str], None], clock: Callable[[], float] = time.monotonic) -> None:
        self._tally, self._write, self._clock = tally, write, clock
        self._began_s = self._said_s = clock()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        return

    def say(self, text: str) -> None:
        self._write(text)

    def began(self, name: str) -> None:
        self._tally.began(name)

    def ended(self, name: str, text: str, *, well: bool) -> None:
        self._tally.ended(name, well=well)
        self._write(f"{name}: {text}")
        self._tell()

    def flown(self, shares: dict[str, float]) -> None:
        self._tally.shares.update(shares)
        if self._clock() - self._said_s >= LINE_PERIOD_S:
            self._tell()

    def _tell(self) -> None:
        self._said_s = self._clock()
        self._write(self._tally.text(self._said_s - self._began_s))


class LiveWatch:
    """Redrawn in place: all flights, and a bar for each that flies; what is said scrolls above."""

    def __init__(self, tally: Tally, console: Console, clock: Callable[[], float] = time.monotonic) -> None:
        self._tally, self._console, self._clock = tally, console, clock
        self._began_s = clock()
        columns = (TextColumn("{task.description}", markup=False), BarColumn())
        self._progress = Progress(*columns, console=console)
        self._all = self._progress.add_task(self._text(), total=sum(tally.left.values()))
        self._tasks: dict[str, TaskID] = {}

    def __enter__(self) -> Self:
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()

    def say(self, text: str) -> None:
        self._console.print(Text(text))

    def began(self, name: str) -> None:
        self._tally.began(name)
        self._tasks[name] = self._progress.add_task(name, total=1.0)

    def ended(self, name: str, text: str, *, well: bool) -> None:
        self._tally.ended(name, well=well)
        self._progress.remove_task(self._tasks.pop(name))
        self.say(f"{name}: {text}")
        self._redraw()

    def flown(self, shares: dict[str, float]) -> None:
        self._tally.shares.update(shares)
        for name, share in shares.items():
            self._progress.update(self._tasks[name], completed=share)
        self._redraw()

    def _redraw(self) -> None:
        done = self._tally.done + sum(self._tally.left[name] * share for name, share in self._tally.shares.items())
        self._progress.update(self._all, completed=done, description=self._text())

    def _text(self) -> str:
        return self._tally.text(self._clock() - self._began_s)
