"""All vehicles of a mission on one thread, in real time: it wakes for every step and every datagram."""

from __future__ import annotations

import selectors
import threading
import time
from pathlib import Path
from types import TracebackType
from typing import Self

from protocol.mission import Mission
from sim_bridge.px4_endpoint.truth import Truth
from sim_bridge.px4_endpoint.vehicle import Vehicle

STEP_S = 0.01
"""Of the simulation; streams are sent on it too."""
BEHIND_MAX_S = 0.2
"""A thread that is later than this (stopped, or starved) leaves out what it missed instead of hurrying after it."""


class Endpoint:
    """``with Endpoint(mission) as endpoint: endpoint.vehicles[1].silent = True``.

    Raises:
        MissionError: a vehicle's connection is not ``udpin://``.
    """

    def __init__(self, mission: Mission) -> None:
        self.vehicles = {drone.id: Vehicle(mission, drone) for drone in mission.drones}
        self.truth = Truth(list(self.vehicles.values()))
        self.late_s = 0.0
        """Largest delay of a step so far."""
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="px4-endpoint", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def stop(self) -> None:
        """End the thread and close the sockets; may be called twice."""
        self._stopping.set()
        if self._thread.is_alive():
            self._thread.join()
        for vehicle in self.vehicles.values():
            vehicle.close()

    @property
    def running(self) -> bool:
        """False after a fault ended the thread."""
        return self._thread.is_alive()

    def write(self, folder: Path) -> None:
        """The truth so far, into the run folder."""
        self.truth.write(folder)

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()

    def _run(self) -> None:
        with selectors.DefaultSelector() as selector:
            for vehicle in self.vehicles.values():
                selector.register(vehicle.link.socket, selectors.EVENT_READ, vehicle)
            self._simulate(selector)

    def _simulate(self, selector: selectors.BaseSelector) -> None:
        due_s = time.monotonic()
        while not self._stopping.is_set():
            for key, _ in selector.select(max(due_s - time.monotonic(), 0.0)):
                key.data.read(time.monotonic())
            now_s = time.monotonic()
            if now_s < due_s:
                continue
            self.late_s = max(self.late_s, now_s - due_s)
            if now_s - due_s > BEHIND_MAX_S:
                due_s = now_s
            for vehicle in self.vehicles.values():
                vehicle.step(due_s, STEP_S)
            self.truth.watch(due_s)
            due_s += STEP_S
