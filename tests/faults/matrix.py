"""Every fault on real processes: what is done to a flight, and what must hold of it afterwards.

``python -m faults.matrix`` flies the cells and says how each went; `faults.reliability` also writes it down.
"""

from __future__ import annotations

import argparse
import asyncio
import os
import random
import resource
import signal
import sys
from collections.abc import AsyncIterator, Awaitable, Callable
from concurrent.futures import ProcessPoolExecutor
from contextlib import asynccontextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import zenoh

from faults.datagrams import Loss
from faults.garbage import Rubbish
from faults.judgement import Figures, judge
from faults.processes import START_S, STOP_BELOW, Flight, HarnessError, Transport, fly, small_mission
from faults.proxy import Fault as Slow
from ground_station.checkpoint import CHECKPOINT_FILE
from ground_station.journal import JOURNAL_FILE
from protocol.session import Link, open_client
from protocol.topics import TOPICS

TEAMS = (1, 4)
VICTIM = "drone-1"
FAULT_S = 3.0
"""How long most faults last: longer than the lease after which a silent process is taken for dead."""
LONG_S = 6.0
"""... and those that do not silence anybody."""
BEFORE_S = 5.0
"""Mission time that passes first, so that there is something to lose: a map, jumps, a checkpoint."""
LATE_PATIENCE_S = 20.0
RUBBISH_PERIOD_S = 0.01
LOOK_S = 0.5
LOOP_LAG_MAX_S = 0.1
"""Of the ground station while an agent is stopped, 99th percentile: nobody may make it wait."""

WORKERS = os.cpu_count() or 1
"""Flights at a time."""

Act = Callable[[Flight], Awaitable[Figures]]


@dataclass(frozen=True)
class Fault:
    """One row of the matrix."""

    name: str
    act: Act
    """Does it and undoes it; returns what is worth telling."""
    linked: tuple[str, ...] = ()
    transport: Transport = "tcp"
    late: tuple[str, ...] = ()
    new_epoch: bool = False
    """Whether the ground station cannot go on with its journal."""


@dataclass(frozen=True)
class Result:
    """One cell, as it is written down."""

    fault: str
    drones: int
    held: bool
    figures: Figures


def killed(name: str, pause_s: float) -> Act:
    async def act(flight: Flight) -> Figures:
        await flight.kill(name)
        await asyncio.sleep(pause_s)
        flight.start(name)
        return {}

    return act


async def come_late(flight: Flight) -> Figures:
    flight.start(VICTIM)
    await flight.until(lambda: "drone/1" in flight.monitor.alive, "the late drone", START_S)
    return {"joined_at_s": round(flight.monitor.tick * flight.mission.tick_s, 1)}


def stopped(name: str) -> Act:
    async def act(flight: Flight) -> Figures:
        flight.signal(name, signal.SIGSTOP)
        lags_s = []
        for _ in range(round(FAULT_S / LOOK_S)):
            await asyncio.sleep(LOOK_S)
            if flight.monitor.status is not None:
                lags_s.append(flight.monitor.status.loop_lag_s)
        flight.signal(name, signal.SIGCONT)
        if name == "ground":
            return {}
        if max(lags_s) >= LOOP_LAG_MAX_S:
            raise HarnessError(f"the ground station's event loop was {max(lags_s):.3f} s late (99 %)")
        return {"ground_loop_lag_p99_ms": round(max(lags_s) * 1e3, 1)}

    return act


def link_made(slow: Slow, name: str, seconds: float = FAULT_S) -> Act:
    async def act(flight: Flight) -> Figures:
        link = flight.links[name]
        passed = link.passed_bytes
        link.set(slow)
        await asyncio.sleep(seconds)
        link.heal()
        return {"passed_bytes_meanwhile": link.passed_bytes - passed}

    return act


def datagrams_lost(loss: Loss) -> Act:
    async def act(flight: Flight) -> Figures:
        links = flight.datagram_links.values()
        passed = sum(link.passed for link in links)
        for link in links:
            link.set(loss)
        await asyncio.sleep(LONG_S)
        for link in links:
            link.heal()
        return {
            "datagrams_lost": sum(link.lost for link in links),
            "datagrams_passed_meanwhile": sum(link.passed for link in links) - passed,
        }

    return act


async def links_reset(flight: Flight) -> Figures:
    for _ in range(3):
        for link in flight.links.values():
            link.reset()
        await asyncio.sleep(FAULT_S / 3)
    return {"connections": sum(link.connections for link in flight.links.values())}


async def disk_full(flight: Flight) -> Figures:
    """No file of the ground station may grow beyond its journal's present size, the journal least of all."""
    pid, size = flight.pid("ground"), (flight.run / JOURNAL_FILE).stat().st_size
    before = len(flight.monitor.jumps)
    resource.prlimit(pid, resource.RLIMIT_FSIZE, (size, resource.RLIM_INFINITY))
    await asyncio.sleep(LONG_S)
    meanwhile = len(flight.monitor.jumps) - before
    status = flight.monitor.status
    resource.prlimit(pid, resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    return {"unwritten": status.unwritten if status else 0, "jumps_published_meanwhile": meanwhile}


def damaged(file_name: str) -> Act:
    """Some bytes in the middle of a file of the ground station, while it is dead."""

    async def act(flight: Flight) -> Figures:
        path = flight.run / file_name
        await flight.until(lambda: path.exists() and path.stat().st_size > 0, f"{file_name} to be written", START_S)
        await flight.kill("ground")
        content = bytearray(path.read_bytes())
        middle = len(content) // 2
        for index in range(middle, min(middle + 8, len(content))):
            content[index] ^= 0xFF
        path.write_bytes(content)
        flight.start("ground")
        return {"bytes": len(content)}

    return act


async def rubbish(flight: Flight) -> Figures:
    """A client that puts rubbish on every topic: torn and flipped messages, and noise."""
    dice = random.Random(1)
    make = Rubbish(dice)
    heard: dict[str, bytes] = {}
    keys = [topic.of(drone.id) for topic in TOPICS for drone in flight.mission.drones]
    refused = flight.monitor.refused()

    def hear(sample: zenoh.Sample) -> None:
        heard[str(sample.key_expr)] = sample.payload.to_bytes()

    async with _rogue(flight) as session:
        subscriber = session.declare_subscriber("**", hear)
        sent = 0
        for _ in range(round(FAULT_S / RUBBISH_PERIOD_S)):
            for key in dice.sample(keys, 2):
                session.put(key, make(key, heard.get(key, b"rubbish")))
                sent += 1
            await asyncio.sleep(RUBBISH_PERIOD_S)
        subscriber.undeclare()  # type: ignore[no-untyped-call]  # zenoh's stub leaves it untyped
    return {"sent": sent, "refused_by_the_monitor": flight.monitor.refused() - refused}


@asynccontextmanager
async def _rogue(flight: Flight) -> AsyncIterator[zenoh.Session]:
    session = await open_client(Link(flight.endpoint), flight.mission.name, timeout_s=START_S)
    try:
        yield session
    finally:
        await asyncio.to_thread(session.close)


FAULTS = (
    Fault("agent killed and started again", killed(VICTIM, 1.0)),
    Fault("agent away for 5 s", killed(VICTIM, 5.0)),
    Fault("agent stopped for 3 s", stopped(VICTIM)),
    Fault("agent joins in flight", come_late, late=(VICTIM,)),
    Fault("ground station killed and started again", killed("ground", 1.0)),
    Fault("ground station stopped for 3 s", stopped("ground")),
    Fault("router killed and started again", killed("router", 1.0)),
    Fault("black hole around an agent for 3 s", link_made(Slow(held=("up", "down")), VICTIM), (VICTIM,)),
    Fault("agent hears nothing for 3 s", link_made(Slow(held=("down",)), VICTIM), (VICTIM,)),
    Fault("nobody hears an agent for 3 s", link_made(Slow(held=("up",)), VICTIM), (VICTIM,)),
    Fault("black hole around the ground station for 3 s", link_made(Slow(held=("up", "down")), "ground"), ("ground",)),
    Fault("connections reset, three times", links_reset, (VICTIM, "ground", "sim")),
    Fault("agent's link delayed by 150 to 200 ms", link_made(Slow(0.15, 0.05), VICTIM, LONG_S), (VICTIM,)),
    Fault(
        "ground station's downlink at 30 kB/s",
        link_made(Slow(bytes_per_s=30e3, narrow=("down",)), "ground", LONG_S),
        ("ground",),
    ),
    Fault("10 % of datagrams lost", datagrams_lost(Loss(lost=0.1)), (VICTIM, "ground"), "udp"),
    Fault(
        "10 % of datagrams late, 10 % repeated",
        datagrams_lost(Loss(late=0.1, repeated=0.1)),
        (VICTIM, "ground"),
        "udp",
    ),
    Fault("ground station's disk full", disk_full),
    Fault("journal damaged while the ground station is dead", damaged(JOURNAL_FILE), new_epoch=True),
    Fault("checkpoint damaged while the ground station is dead", damaged(CHECKPOINT_FILE)),
    Fault("rubbish on every topic", rubbish),
)


async def fly_cell(fault: Fault, drones: int, folder: Path, *, stop_below: float = STOP_BELOW) -> Result:
    """Fly with ``fault`` in the middle and judge; never raises for what the flight does."""
    figures: Figures = {}
    violations: list[str] = []
    # With a single drone nobody flies before it joins, so it leaves instead.
    late = fault.late if drones > 1 else ()
    act = fault.act if drones > 1 or not fault.late else killed(VICTIM, LONG_S)
    mission = small_mission(folder, drones, stop_below=stop_below, patience_s=LATE_PATIENCE_S if late else START_S)
    try:
        async with fly(mission, folder, linked=fault.linked, transport=fault.transport, late=late) as flight:
            await flight.flying(BEFORE_S)
            await flight.until(lambda: len(flight.monitor.jumps) >= 2, "two jumps", START_S)
            figures["struck_at_s"] = round(flight.monitor.tick * mission.tick_s, 1)
            figures |= await act(flight)
            violations += await judge(flight, figures, new_epoch=fault.new_epoch)
    except HarnessError as error:
        violations.append(str(error))
    if violations:
        figures["violations"] = violations
    return Result(fault.name, drones, not violations, figures)


def cells(only: str = "") -> list[tuple[Fault, int]]:
    return [(fault, drones) for fault in FAULTS for drones in TEAMS if only in f"{fault.name}, {drones}"]


def fly_all(chosen: list[tuple[Fault, int]], say: Callable[[str], None], workers: int) -> list[Result]:
    """As many at a time as there are ``workers``; each flight takes most of a core."""
    results = []
    with ProcessPoolExecutor(workers, max_tasks_per_child=1) as pool:
        for result in pool.map(_fly_alone, [(fault.name, drones) for fault, drones in chosen]):
            say(f"{'held' if result.held else 'VIOLATED'}  {result.fault}, drones {result.drones}: {result.figures}")
            results.append(result)
    return results


def _fly_alone(cell: tuple[str, int]) -> Result:
    name, drones = cell
    fault = next(fault for fault in FAULTS if fault.name == name)
    with TemporaryDirectory() as folder:
        return asyncio.run(fly_cell(fault, drones, Path(folder)))


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m faults.matrix", description=__doc__)
    parser.add_argument("--only", default="", help='part of "fault, drones"')
    parser.add_argument("--workers", type=int, default=WORKERS, help="flights at a time")
    arguments = parser.parse_args()
    results = fly_all(cells(arguments.only), lambda text: print(text, flush=True), arguments.workers)
    print(f"{sum(result.held for result in results)} of {len(results)} cells held")
    return 0 if all(result.held for result in results) else 1


if __name__ == "__main__":
    sys.exit(main())
