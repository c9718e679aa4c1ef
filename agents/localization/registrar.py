"""The process that registers scans. KISS-ICP holds Python's global lock for as long as a registration takes, some tens
of milliseconds and more on a busy computer: a thread of it would stand in the way of control loop and watchdog.

It ends with the process that started it, of whatever that dies.
"""

from __future__ import annotations

import multiprocessing
import os
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from agents.localization.registration import Registration, ScanRegistration, load_kiss_icp
from protocol.geometry import Floats
from protocol.localization_settings import Lidar

MILLIMETRE = 1e-3
CLOSE_S = 2.0
"""How long the process may take to end by itself."""
NICENESS = 5
"""Of it: flying comes first where the cores do not suffice."""


@dataclass(frozen=True, slots=True)
class Job:
    kept: Floats | None
    """(4,) where the scan before was taken, if that is to enter the map."""
    points: NDArray[np.int16]
    """(n, 3) mm, levelled, as seen from the sensor."""
    guess: Floats
    """(4,) where this one was taken."""


class Registrar(Protocol):
    def start(self) -> None:
        """Raises `VehicleError` where something is missing."""
        ...

    def submit(self, job: Job) -> Future[Registration]:
        """One at a time. Its exception is an ``OSError`` or an ``EOFError`` when the process is gone."""
        ...

    def close(self) -> None: ...


class RegistrarProcess:
    def __init__(self, lidar: Lidar) -> None:
        self._lidar = lidar
        self._waiter = ThreadPoolExecutor(1, thread_name_prefix="registrar")
        self._process: Any = None
        self._connection: Connection | None = None

    def start(self) -> None:
        load_kiss_icp()  # its absence is told here, where somebody listens
        context = multiprocessing.get_context("spawn")
        self._connection, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(theirs, self._lidar), name="registrar", daemon=True)
        self._process.start()
        theirs.close()

    def submit(self, job: Job) -> Future[Registration]:
        return self._waiter.submit(self._ask, job)

    def _ask(self, job: Job) -> Registration:
        if self._connection is None:
            raise EOFError("the registrar has not been started")
        self._connection.send(job)
        answer: Registration = self._connection.recv()
        return answer

    def close(self) -> None:
        """Also while it is at work."""
        if self._process is not None:
            self._process.terminate()
            self._process.join(CLOSE_S)
        self._waiter.shutdown()
        if self._connection is not None:
            self._connection.close()
        self._process = self._connection = None


def _serve(connection: Connection, lidar: Lidar) -> None:
    """The process: one job after another, until the pipe is closed at its other end."""
    with suppress(OSError):
        os.nice(NICENESS)
    scans = ScanRegistration(lidar)
    with suppress(EOFError, KeyboardInterrupt, ConnectionError):
        while True:
            job: Job = connection.recv()
            connection.send(answer(scans, job))


def answer(scans: ScanRegistration, job: Job) -> Registration:
    if job.kept is not None:
        scans.keep(job.kept)
    return scans.register(job.points.astype(np.float64) * MILLIMETRE, job.guess)
