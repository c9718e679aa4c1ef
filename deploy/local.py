"""All processes of a mission on this machine: started, watched, started again if so wished, and ended together.

The ground station's end is the run's end. A drone that dies is told about and the others fly on; without the router,
the ground station or the simulator nothing can go on, so their failure ends the run, unless they may be started again.
The simulator may not where it carries the vehicles: it is the world. Whatever happens, also to the launcher itself, no
process and no socket stays behind (`deploy.reaper`).
"""

from __future__ import annotations

import asyncio
import math
import os
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import AsyncIterator, Callable, Iterator, Mapping, Sequence
from contextlib import asynccontextmanager, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from protocol.errors import ProcessError
from protocol.guard import ROOT

GRACE_S = 5.0
"""Between SIGTERM and SIGKILL: time to brake, to close a journal and a session."""
SETTLE_S = 20.0
"""What the others get to end by themselves once the ground station is done."""
KILL_S, KILL_POLL_S = 2.0, 0.01
"""How long killed processes may take to be gone, and how often it is looked for."""
LOG_LINES = 15
"""Last lines of a failed process's log that are shown ..."""
LOG_BYTES = 16 * 1024
"""... out of so many bytes."""
BAD_INPUT = 2
"""Exit code of a process that refuses its mission, scene or endpoint; any other failure is 1."""

Kind = Literal["router", "ground", "sim", "observer", "autopilots", "agent", "console", "mapper", "mocap"]
"""sim and autopilots carry vehicles, an observer only watches them."""
SERVANTS: tuple[Kind, ...] = ("router", "autopilots", "console", "mapper", "mocap")
"""Serve until the others are gone, and go with the group."""


@dataclass(frozen=True, slots=True)
class Role:
    """One process to start; ``name`` is that of its log."""

    name: str
    kind: Kind
    command: tuple[str, ...]


def environment(outer: Mapping[str, str]) -> dict[str, str]:
    """What the processes run under: our packages before any other's, and one numerical thread each.

    They share the machine; who wants more threads starts them by hand. Set values win.
    """
    threads = dict.fromkeys(("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
    fixed = {"PYTHONPATH": str(ROOT), "PYTHONUNBUFFERED": "1", "PYTHONFAULTHANDLER": "1"}
    return threads | dict(outer) | fixed


def mission_roles(
    run: Path,
    endpoint: str,
    drones: Sequence[int],
    speed: str,
    *,
    px4: bool = False,
    autopilots: bool = False,
    console: bool = False,
    mapper: Sequence[str] = (),
    mocap: bool = False,
) -> list[Role]:
    """Router, simulator, ground station and one agent a drone; all read ``mission.json`` in the run folder.

    ``px4``: the vehicles are not the simulator's. ``autopilots``: they are PX4-like ones of our own. ``console``: with
    the page in the browser. ``mapper``: command of a process of the user's own that makes the map. ``mocap``:
    with what passes the poses of motion capture on.
    """
    told = ("--mission", str(run / "mission.json"), "--endpoint", endpoint, "--run", str(run), "--speed", speed)

    def role(name: str, kind: Kind, module: str, *more: str) -> Role:
        # -P keeps the folder that the launcher was called in from shadowing a package.
        return Role(name, kind, (sys.executable, "-P", "-m", module, *told, *more))

    return [
        role("router", "router", "protocol.router"),
        *([role("autopilots", "autopilots", "sim_bridge.px4_endpoint")] if autopilots else []),
        role("sim", "observer" if px4 else "sim", "sim_bridge"),
        role("ground", "ground", "ground_station"),
        *([Role("mapper", "mapper", (*mapper, *told))] if mapper else []),
        *([role("mocap", "mocap", "ground_station.motion_capture")] if mocap else []),
        *([role("console", "console", "ground_station.console")] if console else []),
        *(role(f"drone-{drone}", "agent", "agents", "--drone", str(drone)) for drone in drones),
    ]


async def supervise(
    roles: Sequence[Role],
    *,
    logs: Path,
    private: Path,
    say: Callable[[str], None],
    restarts: int = 0,
    grace_s: float = GRACE_S,
    settle_s: float = SETTLE_S,
) -> int:
    """Start ``roles`` in order and stay until the run is over; its exit code, 0 only if every process ended well.

    Each process writes to its own file in the folder ``logs``. ``private``, the socket's folder, is removed at the
    end. ``say`` gets what a person should know. A router, ground station or agent that dies of anything but bad input
    is started again up to ``restarts`` times, and then counts as one that never died. Raises `ProcessError` when a
    command cannot be started.
    """
    run = _Run(logs, say, restarts)
    with interruption() as interrupted:
        try:
            async with process_group(private, grace_s) as group:
                for role in roles:
                    await run.start(role, group)
                return await run.watch(interrupted, group, settle_s)
        finally:
            await asyncio.gather(*run.waits)  # all have ended: take their exit codes, so that no zombie stays


class _Run:
    """The processes of one run that are still waited for, and what the ends of the others came to."""

    def __init__(self, logs: Path, say: Callable[[str], None], restarts: int) -> None:
        self._logs, self._say, self._restarts = logs, say, restarts
        self._restarted: Counter[str] = Counter()
        self._result = 0
        self._over = False
        """The ground station has ended well."""
        self._hopeless = False
        self._drone_ended_well = False
        self.waits: dict[asyncio.Task[int], Role] = {}

    async def start(self, role: Role, group: int) -> None:
        process = await _start(role, self._logs / f"{role.name}.log", group)
        self.waits[asyncio.create_task(process.wait())] = role

    async def watch(self, interrupted: asyncio.Future[signal.Signals], group: int, settle_s: float) -> int:
        clock = asyncio.get_running_loop().time
        deadline = math.inf
        while left := [role.name for role in self.waits.values() if role.kind not in SERVANTS]:
            patience = None if deadline == math.inf else max(0.0, deadline - clock())
            watched: set[asyncio.Future[Any]] = {*self.waits, interrupted}
            await asyncio.wait(watched, timeout=patience, return_when=asyncio.FIRST_COMPLETED)
            if interrupted.done():
                number = interrupted.result()
                self._say(f"{number.name}: ending the run")
                return 128 + number
            ended = [task for task in self.waits if task.done()]
            if not ended:
                self._say(f"not ended {settle_s:g} s after the ground station: {', '.join(left)}")
                return 1
            for task in ended:
                await self._take_end(self.waits.pop(task), task.result(), group)
            if self._over:
                deadline = min(deadline, clock() + settle_s)
            if self._hopeless or (self._result != 0 and not self._drone_ended_well and not self._drones_left()):
                return self._result
        return self._result

    async def _take_end(self, role: Role, code: int, group: int) -> None:
        if code == 0:
            self._over |= role.kind == "ground"
            self._drone_ended_well |= role.kind == "agent"
        elif self._may_start_again(role, code):
            self._restarted[role.name] += 1
            self._say(f"{role.name} {_death(code)}; started again ({self._restarted[role.name]} of {self._restarts})")
            await self.start(role, group)
        else:
            self._say(_obituary(role, code, self._logs))
            self._result = self._result or (BAD_INPUT if code == BAD_INPUT else 1)
            self._hopeless |= role.kind not in ("agent", "observer", "console", "mapper", "mocap")

    def _may_start_again(self, role: Role, code: int) -> bool:
        mortal = role.kind not in ("sim", "autopilots") and code != BAD_INPUT and not self._over
        return mortal and self._restarted[role.name] < self._restarts

    def _drones_left(self) -> bool:
        return any(role.kind == "agent" for role in self.waits.values())


async def _start(role: Role, log: Path, group: int) -> asyncio.subprocess.Process:
    with log.open("ab") as output:  # one that is started again writes on
        try:
            return await asyncio.create_subprocess_exec(
                *role.command,
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                env=environment(os.environ),
                process_group=group,
            )
        except OSError as error:
            raise ProcessError(f"{role.name}: cannot start {role.command[0]}: {error.strerror}") from error


@asynccontextmanager
async def process_group(private: Path, grace_s: float) -> AsyncIterator[int]:
    """A process group that is ended with this context, or with this process; its number."""
    script = Path(__file__).with_name("reaper.py")
    leader = subprocess.Popen(  # noqa: ASYNC220  # a few milliseconds, and nothing else is running yet
        [sys.executable, "-I", "-S", str(script), str(grace_s), str(private)],
        stdin=subprocess.PIPE,
        process_group=0,
    )
    try:
        yield leader.pid
    finally:
        await asyncio.to_thread(leader.communicate)  # closes the pipe, the reaper's sign
        if leader.returncode != 0:  # it had to kill the group, or was killed before it could
            await _end_group(leader.pid)
            shutil.rmtree(private, ignore_errors=True)


async def _end_group(group: int) -> None:
    """SIGKILL, and wait until it has worked: on a busy machine it takes its time."""
    deadline = time.monotonic() + KILL_S
    with suppress(ProcessLookupError):
        while time.monotonic() < deadline:
            os.killpg(group, signal.SIGKILL)
            await asyncio.sleep(KILL_POLL_S)


@contextmanager
def interruption() -> Iterator[asyncio.Future[signal.Signals]]:
    """Done once a person or the system asks the run to end."""
    loop = asyncio.get_running_loop()
    received: asyncio.Future[signal.Signals] = loop.create_future()

    def receive(number: signal.Signals) -> None:
        if not received.done():
            received.set_result(number)

    numbers = [signal.SIGINT, signal.SIGTERM]
    if signal.getsignal(signal.SIGHUP) != signal.SIG_IGN:  # nohup: the run is to outlive its terminal
        numbers.append(signal.SIGHUP)
    for number in numbers:
        loop.add_signal_handler(number, receive, number)
    try:
        yield received
    finally:
        for number in numbers:
            loop.remove_signal_handler(number)
        received.cancel()


def _death(code: int) -> str:
    return f"ended with exit code {code}" if code > 0 else f"was killed by {signal.Signals(-code).name}"


def _obituary(role: Role, code: int, logs: Path) -> str:
    log = logs / f"{role.name}.log"
    with log.open("rb") as file:
        file.seek(max(0, log.stat().st_size - LOG_BYTES))
        lines = file.read().decode(errors="replace").splitlines()[-LOG_LINES:]
    return "\n    ".join([f"{role.name} {_death(code)}; end of {log}:", *(lines or ["(empty)"])])
