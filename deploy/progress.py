"""What a person sees while a mission runs: a live table on a terminal, plain lines everywhere else."""

from __future__ import annotations

import asyncio
import math
import time
from collections.abc import Callable
from typing import Protocol, Self

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from protocol.bus import connect
from protocol.credentials import OPERATOR
from protocol.errors import BusError, CredentialsError
from protocol.links import link_of
from protocol.messages import DroneStatus, Status
from protocol.mission import Mission
from protocol.topics import STATUS

CONNECT_S = 60.0
"""How long the display waits for the router."""
LINE_PERIOD_S = 5.0
"""Between two plain lines, wall time."""


class Display(Protocol):
    def show(self, status: Status) -> None: ...
    def say(self, text: str) -> None: ...
    def __enter__(self) -> Self: ...
    def __exit__(self, *_: object) -> None: ...


async def follow(endpoint: str, mission: Mission, display: Display) -> None:
    """Show the ground station's status until cancelled. A run that cannot be watched goes on unwatched, and says so."""
    try:
        link = link_of(mission, OPERATOR, endpoint=endpoint)
        async with connect(link, mission.name, timeout_s=CONNECT_S) as bus:
            bus.on(STATUS, display.show)
            await asyncio.Event().wait()
    except (BusError, CredentialsError) as error:
        display.say(f"no progress to show: {error}")


class PlainDisplay:
    """One line every few seconds, and one for each new activity."""

    def __init__(self, write: Callable[[str], None], clock: Callable[[], float] = time.monotonic) -> None:
        self._write = write
        self._clock = clock
        self._next_s = -math.inf
        self._activity = ""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        return

    def say(self, text: str) -> None:
        self._write(text)

    def show(self, status: Status) -> None:
        if self._clock() < self._next_s and status.activity == self._activity:
            return
        self._next_s = self._clock() + LINE_PERIOD_S
        self._activity = status.activity
        alive = sum(drone.alive for drone in status.drones)
        parts = [
            f"{status.time_s:7.1f} s",
            f"J {status.importance:.3f}",
            f"F visible {status.f_score_visible:.3f} objects {status.f_score_objects:.3f}",
            f"keyframes {status.keyframes} ({status.keyframes_per_s:.1f}/s, {status.dropped} unused)",
            f"jumps {status.jumps}",
            f"separation {status.min_separation_m:.2f} m",
            f"drones {alive}/{len(status.drones)}",
            status.activity,
        ]
        self._write("  ".join(parts))


class LiveDisplay:
    """The newest status, redrawn in place; what is said scrolls above it."""

    def __init__(self, console: Console, mission: Mission, clock: Callable[[], float] = time.monotonic) -> None:
        self._console = console
        self._mission = mission
        self._clock = clock
        self._started_s = clock()
        self._live = Live(Text("starting ..."), console=console, refresh_per_second=4)

    def __enter__(self) -> Self:
        self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._live.stop()

    def say(self, text: str) -> None:
        self._console.print(Text(text))

    def show(self, status: Status) -> None:
        self._live.update(self._picture(status))

    def _picture(self, status: Status) -> RenderableType:
        wall_s = self._clock() - self._started_s
        facts = Table.grid(padding=(0, 2))
        for _ in range(4):
            facts.add_column()
        facts.add_row("time", f"{status.time_s:.0f} of {self._mission.duration_s:.0f} s", "wall", f"{wall_s:.0f} s")
        facts.add_row(
            "importance J",
            f"{status.importance:.3f}",
            "",
            ProgressBar(total=1.0, completed=1 - status.importance, width=40),
        )
        facts.add_row("F visible", f"{status.f_score_visible:.3f}", "F objects", f"{status.f_score_objects:.3f}")
        facts.add_row(
            "keyframes",
            f"{status.keyframes} ({status.dropped} unused)",
            "a second",
            f"{status.keyframes_per_s:.1f}",
        )
        facts.add_row("jumps", f"{status.jumps}", "separation", f"{status.min_separation_m:.2f} m")
        heading = Text(f"{self._mission.name}: {status.phase}, {status.activity}", style="bold")
        return Group(heading, facts, _team(status.drones))


def _team(drones: tuple[DroneStatus, ...]) -> Table:
    table = Table(box=None, padding=(0, 2), header_style="dim")
    table.add_column("drone")
    table.add_column("mode")
    # Text, because rich reads "[m]" in a plain header as markup.
    for header in ("x, y, z [m]", "speed [m/s]", "separation [m]", "slack", "QP [ms]", "brakings"):
        table.add_column(Text(header), justify="right")
    for drone in drones:
        table.add_row(
            str(drone.drone),
            Text(drone.mode if drone.alive else "silent", style="" if drone.alive else "red"),
            ", ".join(f"{value:.2f}" for value in drone.position),
            f"{drone.speed_mps:.2f}",
            f"{drone.separation_m:.2f}",
            f"{drone.slack:.2f}",
            f"{drone.solve_s * 1000:.2f}",
            str(drone.fallbacks),
        )
    return table
