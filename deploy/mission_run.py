"""One run from a checked mission to its outcome: folder, socket, processes, display."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Literal

from agents.planners.choice import make_planner
from deploy.local import SETTLE_S, Role, mission_roles, supervise
from deploy.outcome import describe, read_outcome
from deploy.progress import Display, follow
from deploy.run_folder import make_run_folder, socket_endpoint, socket_folder_parent
from ground_station.reconstruction.learned.requirements import require_backend
from ground_station.rehearsal import rehearse
from protocol.errors import ProcessError
from protocol.importance import compile_kernels
from protocol.mission import Mission
from protocol.operation_settings import CONSOLE_FILE

Speed = Literal["max", "1"]

CONSOLE_POLL_S = 0.3
"""How often the console's address is looked for, wall time."""
LANDING_S = 180.0
"""What drones in the air get to come home and down once the ground station is done."""


def fly(
    mission: Mission,
    display: Display,
    *,
    out: Path,
    speed: Speed,
    started: datetime,
    restarts: int = 0,
    with_autopilots: bool = False,
    with_console: bool = False,
    mapper: Sequence[str] = (),
) -> int:
    """Run ``mission`` on this machine and say how it went; the exit code of the command.

    A process that dies is started again up to ``restarts`` times, the simulator of vehicles excepted.
    ``with_autopilots``: also start PX4-like vehicles of our own. ``with_console``: and the page in the browser.
    ``mapper``: and this command, which makes the map.
    """
    require_backend(mission)
    with TemporaryDirectory(prefix="covrecon-", dir=socket_folder_parent(), ignore_cleanup_errors=True) as private:
        endpoint = mission.transport.endpoint or socket_endpoint(Path(private))
        run = make_run_folder(out, mission, started, endpoint)
        roles = mission_roles(
            run,
            endpoint,
            [drone.id for drone in mission.drones],
            speed,
            px4=mission.vehicles.kind == "px4",
            autopilots=with_autopilots,
            console=with_console,
            mapper=mapper,
            mocap=mission.localization.source == "mocap" and mission.vehicles.kind == "px4" and not with_autopilots,
        )
        with display:
            compile_everything(mission)
            display.say(f"{mission.name}: drones {len(mission.drones)}, seed {mission.seed}, run folder {run}")
            result = asyncio.run(_supervise_and_show(roles, run, Path(private), endpoint, mission, display, restarts))
    try:
        for line in describe(read_outcome(run), run):
            display.say(line)
    except ProcessError:
        if result == 0:
            raise
        # A run that ended early said why already.
        display.say(f"no result; what was kept: {run}; what it came to by then: covrecon report {run}")
    return result


def compile_everything(mission: Mission) -> None:
    """Let numba compile here what the processes will run, once and not in all of them at the same time.

    A process that compiled a kernel itself runs a slightly different one than those that load it from the cache
    (inlined, with fast-math), so without this the first run on a machine would differ from all later ones.
    """
    compile_kernels()
    make_planner(mission, mission.drones[0].id).rehearse()
    rehearse(mission)


async def _say_where_the_console_is(run: Path, display: Display) -> None:
    """Once it serves; without one, never."""
    file = run / CONSOLE_FILE
    while not file.exists():  # noqa: ASYNC110  # another process makes it
        await asyncio.sleep(CONSOLE_POLL_S)
    display.say(f"console: {json.loads(file.read_bytes())['url']}")


async def _supervise_and_show(
    roles: list[Role], run: Path, private: Path, endpoint: str, mission: Mission, display: Display, restarts: int
) -> int:
    watching = [
        asyncio.create_task(watch)
        for watch in (follow(endpoint, mission, display), _say_where_the_console_is(run, display))
    ]
    try:
        return await supervise(
            roles,
            logs=run / "logs",
            private=private,
            say=display.say,
            restarts=restarts,
            settle_s=LANDING_S if mission.vehicles.kind == "px4" else SETTLE_S,
        )
    finally:
        for watch in watching:
            watch.cancel()
        await asyncio.gather(*watching, return_exceptions=True)
