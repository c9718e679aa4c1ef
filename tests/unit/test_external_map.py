"""A process that makes the map may be late, dead or wrong: it is said once, nobody hangs, and the flight goes on."""

from __future__ import annotations

import asyncio
import re
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from faults.boxes import fly_over, mission
from faults.external_process import EPOCH, as_message
from ground_station.external_map import ExternalMap, fault_of
from ground_station.keyframe_log import KeyframeLog
from protocol.errors import MessageError
from protocol.external_map import Map, MapProcess
from protocol.messages import ExternalMesh, Keyframe, KeyframePage
from protocol.mission import Mission
from protocol.queries import parse_parameters
from protocol.wire import decode

FLIGHT = [as_message(replace(one, depth=None)) for one in fly_over()[:6]]
PATIENCE_S = 0.3
SOON_S = 10.0
"""Bound of what takes milliseconds."""


def mesh(taken: int, epoch: int = EPOCH, **change: Any) -> ExternalMesh:
    """A triangle in the target."""
    arrays = {
        "vertices": np.array([[0, 0, 0.1], [0.1, 0, 0.1], [0, 0.1, 0.1]], np.float32),
        "faces": np.array([[0, 1, 2]], np.int32),
        "colours": np.full((3, 3), 9, np.uint8),
    }
    return ExternalMesh(epoch=epoch, taken=taken, **(arrays | change))


class Station:
    """The ground station's side; ``lives`` is whether the process does."""

    def __init__(self, folder: Path, *, lockstep: bool = True, patience_s: float = PATIENCE_S) -> None:
        own = mission("external")
        settings = own.reconstruction.model_copy(update={"external_patience_s": patience_s})
        self.mission: Mission = own.model_copy(update={"reconstruction": settings})
        self.log = KeyframeLog(folder / "keyframes")
        self.map = ExternalMap(self.mission, self.log, EPOCH, lockstep=lockstep)
        self.lives = True
        self.looked = 0
        """How often somebody wanted to know."""
        self.said: list[tuple[str, str]] = []

        def lives() -> bool:
            self.looked += 1
            return self.lives

        async def join() -> None:
            self.map.join(lambda level, _, text: self.said.append((level, text)), lives)

        asyncio.run(join())

    def take(self, *keyframes: Keyframe) -> int:
        for keyframe in keyframes:
            self.log.append(keyframe)
        return self.map.grow()

    def ask(self, question: str) -> Any:
        return asyncio.run(self.map.answer(parse_parameters(question)))


@pytest.fixture
def station(tmp_path: Path) -> Iterator[Station]:
    made = Station(tmp_path)
    yield made
    made.log.close()


def soon(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + SOON_S
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.001)


def test_a_process_is_given_every_keyframe_once_and_in_order(station: Station) -> None:
    station.take(*FLIGHT[:4])
    page = station.ask("epoch=0;from=0")
    assert [decode(Keyframe, content) for content in page.keyframes] == FLIGHT[:4]
    assert not page.wanted
    station.take(*FLIGHT[4:])
    following = station.ask(f"epoch={EPOCH};from={page.next}")
    assert following.first == page.next
    assert [decode(Keyframe, content) for content in following.keyframes] == FLIGHT[4:]


def test_pages_are_cut_between_keyframes(station: Station, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ground_station.external_map.PAGE_BYTES", 3000)
    end = station.take(*FLIGHT)
    place, given = 0, 0
    while place < end:
        page = station.ask(f"epoch={EPOCH};from={place}")
        assert page.keyframes
        place, given = page.next, given + len(page.keyframes)
    assert (place, given) == (end, len(FLIGHT))


@pytest.mark.parametrize("question", ["epoch=1;from=3", f"epoch={EPOCH};from=99999999", f"epoch={EPOCH};from=-1", ""])
def test_a_process_that_knows_another_list_begins_anew(station: Station, question: str) -> None:
    station.take(*FLIGHT)
    page = station.ask(question)
    assert (page.epoch, page.first, len(page.keyframes)) == (EPOCH, 0, len(FLIGHT))


def test_a_question_that_is_none_is_refused(station: Station) -> None:
    with pytest.raises(MessageError, match="must be numbers"):
        station.ask("from=first")


def test_in_lockstep_the_map_of_all_keyframes_is_waited_for(station: Station) -> None:
    end = station.take(*FLIGHT)
    answers: list[int] = []
    thread = threading.Thread(target=lambda: answers.append(station.map.mesh_of(end)[1]))
    thread.start()
    soon(lambda: station.ask(f"epoch={EPOCH};from={end}").wanted)
    station.map.hear(mesh(end - 1))
    assert not answers
    station.map.hear(mesh(end))
    thread.join(SOON_S)
    assert answers == [end]
    assert station.said == []


def test_a_process_that_is_late_is_waited_for_once_until_it_answers(station: Station) -> None:
    end = station.take(*FLIGHT[:3])
    began = time.monotonic()
    for _ in range(50):
        assert station.map.mesh_of(end)[1] == 0
    assert time.monotonic() - began < 10 * PATIENCE_S
    assert [level for level, _ in station.said] == ["warning"]
    assert "was late in 0.3 s: no map updates until it answers, and this run cannot be repeated" in str(station.said)
    station.map.hear(mesh(end))
    assert station.said[1:] == [("info", "the external map's process answers")]
    assert station.map.mesh_of(end)[1] == end


def test_a_process_that_dies_is_not_waited_for(tmp_path: Path) -> None:
    station = Station(tmp_path, patience_s=60.0)
    first = station.take(*FLIGHT[:3])
    station.map.hear(mesh(first))
    end = station.take(*FLIGHT[3:])
    thread = threading.Thread(target=lambda: station.map.mesh_of(end))
    thread.start()
    soon(lambda: station.ask(f"epoch={EPOCH};from={end}").wanted)
    soon(lambda: station.looked > 1)
    station.lives = False
    thread.join(SOON_S)
    assert not thread.is_alive()
    assert "is gone: no map updates" in str(station.said)
    assert station.map.newest[1] == first, "the map stays as it was"
    station.log.close()


def test_in_real_time_nobody_waits(tmp_path: Path) -> None:
    station = Station(tmp_path, lockstep=False, patience_s=60.0)
    end = station.take(*FLIGHT)
    assert station.map.mesh_of(end)[1] == 0
    assert station.said == []
    station.lives = False
    station.map.mesh_of(end)
    station.map.mesh_of(end)
    assert station.said == [
        ("warning", "the external map's process is away: no map updates until it is there"),
    ]
    station.map.hear(mesh(end))
    assert station.map.mesh_of(end)[1] == end
    station.log.close()


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"vertices": np.zeros((3, 3))}, "vertices are float64"),
        ({"vertices": np.zeros((3, 2), np.float32)}, r"vertices are float32 \(3, 2\)"),
        ({"vertices": np.zeros(9, np.float32)}, r"vertices are float32 \(9,\)"),
        ({"faces": np.zeros((1, 3), np.float32)}, "faces are float32"),
        ({"faces": np.array([[0, 1, 3]], np.int32)}, "faces name vertices from 0 to 3, there are 3"),
        ({"faces": np.array([[-1, 1, 2]], np.int32)}, "faces name vertices from -1"),
        ({"colours": np.zeros((2, 3), np.uint8)}, "2 colours of 3 vertices"),
        ({"colours": np.zeros((3, 4), np.uint8)}, "colours are uint8"),
        ({"vertices": np.full((3, 3), 900, np.float32)}, "another unit than metres"),
        ({"fault": "out of memory"}, "out of memory"),
    ],
)
def test_a_mesh_that_is_none_is_refused_and_the_map_stays(
    station: Station, change: dict[str, Any], complaint: str
) -> None:
    first = station.take(*FLIGHT[:3])
    station.map.hear(mesh(first))
    end = station.take(*FLIGHT[3:])
    wrong = mesh(end, **change)
    station.map.hear(wrong)
    station.map.hear(wrong)
    assert station.map.newest[1] == first
    assert station.map.refused == 2
    ((level, text),) = station.said
    assert level == "warning"
    assert re.search(complaint, text)


def test_a_mesh_of_another_list_is_passed_over(station: Station) -> None:
    station.take(*FLIGHT)
    station.map.hear(mesh(5, epoch=EPOCH + 1))
    assert station.map.newest[1] == 0


def test_numbers_that_are_not_finite_do_not_even_travel() -> None:
    with pytest.raises(ValueError, match="not finite"):
        mesh(1, vertices=np.full((3, 3), np.nan, np.float32))


def test_an_empty_map_is_one() -> None:
    nothing = mesh(
        1,
        vertices=np.zeros((0, 3), np.float32),
        faces=np.zeros((0, 3), np.int32),
        colours=np.zeros((0, 3), np.uint8),
    )
    assert fault_of(nothing, mission().target) == ""


class Maker:
    """Counts, and fails where it is told to."""

    made = 0

    def __init__(self, mesh: Map | None = None, fails: bool = False) -> None:
        type(self).made += 1
        self.taken: list[int] = []
        self._mesh, self._fails = mesh, fails

    def add(self, keyframe: Keyframe) -> None:
        if self._fails:
            raise RuntimeError("no such layer")
        self.taken.append(keyframe.sequence)

    def mesh(self) -> Map:
        if self._mesh is None:
            raise RuntimeError("no such layer")
        return self._mesh


def test_what_a_users_program_raises_is_told_instead_of_a_map(station: Station) -> None:
    end = station.take(*FLIGHT)
    process = MapProcess(lambda: Maker(fails=True))
    page = station.ask(process.question).model_copy(update={"wanted": True})
    answer = process.take(page)
    assert answer is not None
    assert (answer.taken, answer.fault) == (end, "RuntimeError: no such layer")


def test_a_map_that_no_message_can_carry_is_told(station: Station) -> None:
    huge = np.zeros((1_500_000, 3), np.float32)
    process = MapProcess(lambda: Maker(Map(huge, np.zeros((0, 3), np.int32), np.zeros((1_500_000, 3), np.uint8))))
    station.take(*FLIGHT)
    answer = process.take(station.ask(process.question).model_copy(update={"wanted": True}))
    assert answer is not None
    assert "exceed the limit" in answer.fault


def test_a_program_begins_anew_with_another_list() -> None:
    Maker.made = 0
    process = MapProcess(Maker)
    process.take(KeyframePage(epoch=1, first=0, next=9, keyframes=(), wanted=False))
    assert Maker.made == 1
    process.take(KeyframePage(epoch=1, first=9, next=12, keyframes=(), wanted=False))
    assert Maker.made == 1
    process.take(KeyframePage(epoch=2, first=0, next=4, keyframes=(), wanted=False))
    assert Maker.made == 2
    assert process.question == "epoch=2;from=4"
