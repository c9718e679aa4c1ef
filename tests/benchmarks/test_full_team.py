"""A team of four over the field of 1.5e7 cells: what each process takes of its 50 ms, digests, jumps and a late joiner
included. In virtual time and in one process, so that the figures are each process's own."""

from __future__ import annotations

import asyncio
from collections import defaultdict
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from agents.agent import Agent
from faults.session import Session
from faults.team import Team, flying
from faults.virtual_loop import run
from ground_station.ground_station import GroundStation
from protocol import topics
from protocol.importance import compile_kernels
from protocol.mission_file import load_mission
from protocol.replica import Replica
from protocol.replication import Replication

Record = Callable[..., None]
TICK_S = 0.05
MISSION_S, KILLED_S, BACK_S, COMPARED_S = 26.0, 11.02, 12.0, 25.0
"""How long it flies, when its fourth drone dies, between two ticks, and is started again, and when all are compared."""
END_S = 10.0
"""For all to end by themselves."""
WARM_TICKS = 20
"""At the start, left out."""
MISSION = load_mission(
    Path(__file__).parents[2] / "missions" / "paper-full.toml",
    drones=4,
    replaced={"duration_s": MISSION_S, "feedback.threshold": 1.0},  # so that phi jumps from the start
)
LATE = "drone/4"
TEAM = ("ground", "drone/1", "drone/2", "drone/3", LATE)


class Watch:
    """CPU seconds of each process of a team in each tick, and the bytes of phi that it ends with."""

    def __init__(self, team: Team) -> None:
        self._team = team
        self._before: dict[str, float] = {}
        self.ticks_s: dict[str, dict[int, float]] = defaultdict(dict)
        self.sha256: dict[str, str] = {}
        self.jumps: dict[str, int] = {}
        self.complete_s = 0.0
        """When the one that came back had all of phi."""
        team.network.taps.append(self._look)

    def _look(self, sender: Session, key: str, payload: bytes) -> None:
        del payload
        if key != topics.TICK.key or sender.process.role != "sim":
            return
        for role, member in self._team.members.items():
            taken = member.process.cpu_s
            if role in self._before:
                self.ticks_s[role][self._team.tick] = taken - self._before[role]
            self._before[role] = taken
        now_s = asyncio.get_running_loop().time()
        if not self.complete_s and now_s > BACK_S and (late := self._replication(LATE)) and late.whole:
            self.complete_s = now_s

    def compare_at(self, tick: int) -> None:
        """Note everybody's phi as it is when all earlier ticks are in."""
        for role in TEAM:
            replication = self._replication(role)
            assert replication is not None
            replication.when_reached(tick, partial(self._note, role, replication.replica))

    def _note(self, role: str, replica: Replica) -> None:
        self.sha256[role], self.jumps[role] = replica.field.sha256, replica.jumps.taken

    def _replication(self, role: str) -> Replication | None:
        """None while it starts."""
        shell = self._team.members[role].shell
        return shell._replication if isinstance(shell, Agent | GroundStation) else None


async def fly(folder: Path) -> Watch:
    loop = asyncio.get_running_loop()
    async with flying(MISSION, folder, seed=1) as team:
        watch = Watch(team)
        for role in team.roles:
            team.start(role)
        loop.call_at(KILLED_S, team.kill, LATE)
        loop.call_at(BACK_S, team.start, LATE)
        await asyncio.sleep(BACK_S + 1.0)
        watch.compare_at(round(COMPARED_S / TICK_S))
        await asyncio.sleep(MISSION_S + END_S - BACK_S)
        assert team.failed() == []
    return watch


@pytest.mark.timeout(300)
def test_team_over_the_full_field(record: Record, tmp_path: Path) -> None:
    compile_kernels()
    watch = run(fly(tmp_path))
    assert len(watch.sha256) == 5
    assert len(set(watch.sha256.values())) == 1, "all end in the same bytes"
    assert min(watch.jumps.values()) > 2
    joining = [taken for tick, taken in watch.ticks_s[LATE].items() if BACK_S <= tick * TICK_S < watch.complete_s]
    agent, ground = (
        [taken for tick, taken in watch.ticks_s[role].items() if WARM_TICKS <= tick < KILLED_S / TICK_S]
        for role in ("drone/1", "ground")
    )
    for quantile in (50, 99):
        taken = float(np.percentile(agent, quantile))
        record(f"agent_tick_15e6_p{quantile}", taken * 1e3, "ms CPU", "a tick of 50 ms", TICK_S / taken)
        taken = float(np.percentile(ground, quantile))
        record(f"ground_tick_15e6_p{quantile}", taken * 1e3, "ms CPU", "a tick of 50 ms", TICK_S / taken)
    taken = watch.complete_s - BACK_S
    record("late_join_15e6", taken, "s, virtual", "1.5e7 cells through 20 Mbit/s", 4 * 14_976_000 * 8 / 20e6 / taken)
    record("late_join_15e6_tick", max(joining) * 1e3, "ms CPU at worst", "a tick of 50 ms", TICK_S / max(joining))
