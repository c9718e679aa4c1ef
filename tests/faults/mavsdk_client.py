"""MAVSDK as a test uses it: one connection to one autopilot, blocking, with every wait bounded."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from types import TracebackType
from typing import Any, Self

from mavsdk import Configuration, Mavsdk, log_subscribe
from mavsdk.plugins.action import Action
from mavsdk.plugins.gimbal import Gimbal
from mavsdk.plugins.mavlink_direct import MavlinkDirect, MavlinkMessage
from mavsdk.plugins.offboard import Offboard, VelocityNedYaw
from mavsdk.plugins.param import Param
from mavsdk.plugins.telemetry import FlightMode, Telemetry

GROUND_SYSTEM, GROUND_COMPONENT = 245, 190
DISCOVERY_S = 15.0
POLL_S = 0.02
DO_SET_MODE, SET_MESSAGE_INTERVAL = 176, 511
CUSTOM_MODE_ENABLED, OFFBOARD_MAIN_MODE = 1, 6


def wait(condition: Callable[[], object], patience_s: float, what: str) -> None:
    """Until ``condition`` holds; fails the test, naming ``what`` was waited for, after ``patience_s``."""
    deadline = time.monotonic() + patience_s
    while not condition():
        assert time.monotonic() < deadline, f"not within {patience_s:g} s: {what}"
        time.sleep(POLL_S)


def watch(seconds: float) -> None:
    """Let the vehicle do what it does for so long: that it does *not* do something shows only in time."""
    time.sleep(seconds)


class Client:
    """Connected to the first autopilot heard on ``url``. ``close`` ends all that it sends."""

    def __init__(self, url: str) -> None:
        log_subscribe(lambda *_: True)  # or it prints
        began = time.monotonic()
        self._sdk = Mavsdk(Configuration.create_manual(GROUND_SYSTEM, GROUND_COMPONENT, True))
        self._sdk.add_any_connection_with_handle(url)
        system = self._sdk.first_autopilot(DISCOVERY_S)
        assert system is not None, f"no autopilot on {url}"
        self.discovery_s = time.monotonic() - began
        self.system = system
        self.action, self.telemetry, self.offboard = Action(system), Telemetry(system), Offboard(system)
        self.gimbal, self.parameters, self._direct = Gimbal(system), Param(system), MavlinkDirect(system)
        self.texts: list[str] = []
        self.telemetry.subscribe_status_text(lambda text, _: self.texts.append(text.text))

    def close(self) -> None:
        self._sdk.destroy()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    @property
    def mode(self) -> FlightMode:
        return FlightMode(self.telemetry.flight_mode())

    def wait_for_mode(self, mode: FlightMode, patience_s: float) -> None:
        wait(lambda: self.mode is mode, patience_s, f"mode {mode.name}")

    @property
    def height_m(self) -> float:
        """Above the local origin."""
        return -float(self.telemetry.position_velocity_ned().position.down_m)

    def send_velocity(self, north: float, east: float, down: float, yaw_deg: float) -> None:
        """From now on, 20 times a second, until another one or `close`."""
        self.offboard.set_velocity_ned(VelocityNedYaw(north, east, down, yaw_deg))

    def command(self, number: int, *arguments: float) -> int:
        """One COMMAND_LONG; the result of its COMMAND_ACK (0: accepted)."""
        fields: dict[str, Any] = {
            "command": number,
            "target_system": self.system.get_system_id(),
            "target_component": 1,
            "confirmation": 0,
        }
        for index in range(7):
            fields[f"param{index + 1}"] = arguments[index] if index < len(arguments) else 0
        packet = MavlinkMessage(
            "COMMAND_LONG", GROUND_SYSTEM, GROUND_COMPONENT, self.system.get_system_id(), 1, json.dumps(fields)
        )
        return int(json.loads(self._direct.send_command(packet).fields_json)["result"])

    def command_offboard(self) -> int:
        """OFFBOARD without the setpoints that MAVSDK would insist on."""
        return self.command(DO_SET_MODE, CUSTOM_MODE_ENABLED, OFFBOARD_MAIN_MODE)

    def heard(self, part: str) -> bool:
        """Whether a status text with ``part`` in it has come."""
        return any(part.lower() in text.lower() for text in self.texts)
