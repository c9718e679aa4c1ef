"""The task around the logic, and what MAVSDK's errors become."""

from __future__ import annotations

import asyncio
import importlib
import inspect
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from enum import IntEnum
from typing import Any

import mavsdk
import pytest

from agents.vehicles.px4.authority import AuthorityLogic, Observation, Step
from agents.vehicles.px4.pilot import Pilot
from agents.vehicles.px4.refusals import refusals
from protocol.errors import VehicleError

GROUND = Observation("HOLD", 0.0, armed=False, on_ground=True, height_m=0.0, heard_s=0.0)


@dataclass
class NotedCockpit:
    """A vehicle that obeys at once, but for arming, which blocks until it is let."""

    seen: Observation = GROUND
    given: list[tuple[Step, str]] = field(default_factory=list)
    idled: int = 0
    watched: int = 0
    let: threading.Event = field(default_factory=threading.Event)

    def observe(self) -> Observation:
        return replace(self.seen, mode_at_s=time.monotonic(), heard_s=time.monotonic())

    def command(self, step: Step) -> None:
        self.given.append((step, threading.current_thread().name))
        if step == "arm":
            self.let.wait(10.0)
            raise VehicleError("arm: command denied")

    def idle(self) -> None:
        self.idled += 1

    def watch(self) -> None:
        self.watched += 1


async def until(condition: Callable[[], bool]) -> None:
    while not condition():  # noqa: ASYNC110  # what is waited for happens on other threads too
        await asyncio.sleep(0.01)


async def test_the_pilot_goes_on_watching_while_a_command_is_not_answered() -> None:
    cockpit, logic, events = NotedCockpit(), AuthorityLogic(1.5, 3.0), list[tuple[str, str]]()
    with ThreadPoolExecutor(1, thread_name_prefix="private") as private:
        pilot = Pilot(
            cockpit, logic, threading.Lock(), private, time.monotonic, lambda level, text: events.append((level, text))
        )
        logic.observe(cockpit.observe(), time.monotonic())
        logic.take_off(time.monotonic())
        task = asyncio.create_task(pilot.run())
        async with asyncio.timeout(10.0):
            await until(lambda: cockpit.watched >= 5)
            assert [step for step, _ in cockpit.given] == ["arm"]
            cockpit.let.set()
            await until(lambda: ("warning", "arm: command denied") in events)
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task

    assert cockpit.given[0][1].startswith("private"), "asyncio's own executor is everybody's"
    assert events[0] == ("info", "starting: arming")
    assert cockpit.idled > 0


def plugin_errors() -> Iterator[tuple[Any, type[IntEnum]]]:
    """Of the plugins that the vehicle imports."""
    importlib.import_module("agents.vehicles.px4.vehicle")
    for module in [module for name, module in sys.modules.items() if name.startswith("mavsdk.plugins.")]:
        members: dict[str, Any] = dict(inspect.getmembers(module, inspect.isclass))
        for name, kind in members.items():
            if issubclass(kind, mavsdk.MavsdkError) and kind is not mavsdk.MavsdkError:
                yield kind, members[name.removesuffix("Error") + "Result"]


def test_every_error_of_every_plugin_becomes_ours() -> None:
    walked = 0
    for kind, results in plugin_errors():
        for result in results:
            with pytest.raises(VehicleError, match=r"^taking off: ") as caught, refusals("taking off"):
                raise kind(result, "takeoff()")
            assert result.name.lower().replace("_", " ") in str(caught.value)
            assert isinstance(caught.value.__cause__, kind)
            walked += 1
    assert walked > 50


@pytest.mark.parametrize(
    "error",
    [
        mavsdk.MavsdkError("went wrong"),
        *[kind("went wrong") for kind in mavsdk.MavsdkError.__subclasses__() if kind.__module__ == "mavsdk.exceptions"],
        RuntimeError("Action has been destroyed"),
        ValueError("system handle is null"),
    ],
    ids=lambda error: type(error).__name__,
)
def test_errors_without_a_result_become_ours_too(error: Exception) -> None:
    with pytest.raises(VehicleError, match=f"connecting: {error}"), refusals("connecting"):
        raise error
