"""Commands over a real bus: asked until everybody has acknowledged them, obeyed once, and known after a restart."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Iterator
from pathlib import Path

import pytest

from deploy.command_client import Place, command, place_of
from deploy.run_folder import socket_endpoint
from faults.processes import small_mission
from faults.told import told
from ground_station.command_log import CommandLog
from ground_station.command_service import CommandService
from protocol import topics
from protocol.bus import Bus, connect
from protocol.errors import CommandError
from protocol.messages import CommandReply
from protocol.mission import Mission
from protocol.session import Link
from protocol.verbs import Verb

pytestmark = pytest.mark.light

DRONES = (1, 3)
PATIENCE_S = 10.0


class Ground:
    """What the ground station does with commands, and drones that acknowledge what they hear."""

    def __init__(self, mission: Mission, bus: Bus, log: CommandLog) -> None:
        self.said: list[str] = []
        self.deaf: set[int] = set()
        self.service = CommandService(mission, bus, log, phase=lambda: "flying", changed=self.say)

    def say(self, text: str) -> None:
        self.said.append(text)
        for order in self.service.orders:
            if order.drone not in self.deaf:
                self.service.hear(told().model_copy(update={"drone": order.drone, "obeyed": order.number}))


@pytest.fixture
def mission(tmp_path: Path) -> Mission:
    return small_mission(tmp_path, len(DRONES))


@pytest.fixture
async def place(tmp_path: Path, mission: Mission) -> Place:
    return Place(Link(socket_endpoint(tmp_path)), mission.name)


@pytest.fixture
async def bus(place: Place) -> AsyncIterator[Bus]:
    async with connect(place.link, place.mission, router=True) as bus:
        yield bus


@pytest.fixture
def ground(mission: Mission, bus: Bus, tmp_path: Path) -> Iterator[Ground]:
    with CommandLog(tmp_path / "commands") as log:
        yield Ground(mission, bus, log)


async def insist(place: Place, verb: Verb, drones: tuple[int, ...] = (), patience_s: float = PATIENCE_S) -> list[str]:
    heard: list[str] = []
    await command(place, verb, drones, say=heard.append, patience_s=patience_s)
    return heard


async def test_a_command_returns_when_all_have_acknowledged_it(ground: Ground, place: Place) -> None:
    assert await insist(place, "pause") == [
        "pause: drone 1, drone 3: waiting for drone 1, 3",
        "pause: drone 1, drone 3: acknowledged",
    ]
    assert [(order.drone, order.action) for order in ground.service.orders] == [(1, "hold"), (3, "hold")]


async def test_who_has_not_acknowledged_is_named(ground: Ground, place: Place) -> None:
    ground.deaf = {3}
    with pytest.raises(CommandError, match=r"not acknowledged within 1 s by drone 3"):
        await insist(place, "land", patience_s=1.0)
    assert ground.said == ["land: drone 1, drone 3"], "obeyed once, however often it was asked for"


async def test_a_refusal_is_an_error_with_its_reason(ground: Ground, place: Place) -> None:
    with pytest.raises(CommandError, match="refused: there is no drone 7; the mission has 1, 3"):
        await insist(place, "land", drones=(7,))
    assert ground.said == []


async def test_the_same_id_is_the_same_command(ground: Ground, place: Place) -> None:
    async with connect(place.link, place.mission) as operator:
        question = "id=a1;verb=pause;drones=1"
        answers: list[CommandReply] = await asyncio.gather(
            *(operator.ask(topics.COMMAND, question, timeout_s=PATIENCE_S) for _ in range(5))
        )
    assert len({answer.number for answer in answers}) == 1
    assert ground.said == ["pause: drone 1"]


async def test_an_old_command_that_comes_again_changes_nothing_and_is_told_of(
    ground: Ground, place: Place, caplog: pytest.LogCaptureFixture
) -> None:
    async with connect(place.link, place.mission) as operator:

        async def ask(question: str) -> CommandReply:
            return await operator.ask(topics.COMMAND, question, timeout_s=PATIENCE_S)

        await ask("id=a1;verb=pause")
        await ask("id=b2;verb=resume")
        orders, said = ground.service.orders, list(ground.said)
        for _ in range(4):
            assert (await ask("id=a1;verb=pause")).awaited == ()

    assert (ground.service.orders, ground.said) == (orders, said)
    assert "command 1 (pause: drone 1, drone 3) came again, though all have heard it: not obeyed" in caplog.text


async def test_an_id_that_was_refused_stays_refused(ground: Ground, place: Place) -> None:
    async with connect(place.link, place.mission) as operator:
        for question, accepted in (
            ("id=a1;verb=resume", False),
            ("id=b2;verb=pause", True),
            ("id=a1;verb=resume", False),
            ("id=c3;verb=resume", True),
        ):
            assert (await operator.ask(topics.COMMAND, question, timeout_s=PATIENCE_S)).accepted is accepted
    assert ground.said[0].startswith("pause")


async def test_a_ground_station_that_is_started_again_knows_what_was_commanded(
    ground: Ground, mission: Mission, bus: Bus, place: Place, tmp_path: Path
) -> None:
    await insist(place, "land", drones=(3,))
    with CommandLog(tmp_path / "commands") as log:  # the first is not closed: it was killed
        again = CommandService(mission, bus, log, phase=lambda: "flying", changed=lambda _: None)
    assert again.orders == ground.service.orders
    assert [(order.drone, order.action) for order in again.orders] == [(3, "land")]


async def test_a_disk_that_refuses_keeps_no_drone_in_the_air(
    ground: Ground, place: Place, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(_self: CommandLog, _command: object) -> bool:
        return False

    monkeypatch.setattr(CommandLog, "append", refuse)
    heard = await insist(place, "land", drones=(1,))
    assert "not on disk: forgotten if I die" in heard[0]
    assert [order.action for order in ground.service.orders] == ["land"]


async def test_without_a_ground_station_nothing_is_claimed(bus: Bus, place: Place) -> None:
    del bus  # only the router is there
    with pytest.raises(CommandError, match="no ground station answered within 1 s: as far as is known, nothing"):
        await insist(place, "land", patience_s=1.0)


async def test_without_a_mission_the_command_says_so(place: Place, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("deploy.command_client.CONNECT_S", 0.5)
    with pytest.raises(CommandError, match="does mission 'small' still fly"):
        await insist(place, "land")


def test_a_folder_that_holds_no_run_is_named(tmp_path: Path) -> None:
    with pytest.raises(CommandError, match=r"not the folder of a run \(No such file or directory\); name it: --run"):
        place_of(tmp_path)
