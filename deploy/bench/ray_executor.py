"""Flights on a Ray cluster: each is a task of one core, flown by the same processes as on one machine.

Every machine of the cluster has the same release installed, for the Python that runs Ray, and sees a scene that is a
file under the same path. What a flight comes to is checked against the versions here (`deploy.bench.campaign`).
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from deploy.bench.flight import fly_in
from protocol.errors import ProcessError

CORES_PER_FLIGHT = 1
"""In lockstep one process of a flight waits for the other, so it keeps about one core busy."""


def fly_here(mission_json: str) -> dict[str, bytes]:
    """What a worker of the cluster does."""
    with TemporaryDirectory(prefix="covrecon-", ignore_cleanup_errors=True) as place:
        return asyncio.run(fly_in(Path(place), mission_json))


class RayExecutor:
    def __init__(self, address: str | None, slots: int | None) -> None:
        """``address`` of a cluster that runs; None starts one of this machine's cores. ``slots``: None for all cores.

        Raises `ProcessError` if Ray is not installed.
        """
        self._ray = load_ray()
        self._address, self._wished = address, slots
        self.slots = slots or 1

    @asynccontextmanager
    async def ready(self) -> AsyncIterator[None]:
        await asyncio.to_thread(self._connect)
        try:
            total = int(self._ray.cluster_resources().get("CPU", 1))
            self.slots = self._wished or max(1, total // CORES_PER_FLIGHT)
            yield
        finally:
            await asyncio.to_thread(self._ray.shutdown)

    def _connect(self) -> None:
        options = {"include_dashboard": False, "num_cpus": self._wished} if self._address is None else {}
        try:
            self._ray.init(address=self._address or "local", log_to_driver=False, logging_level="ERROR", **options)
        except (ConnectionError, RuntimeError, ValueError) as error:
            raise ProcessError(f"no Ray cluster at {self._address}: {error}") from error
        # A worker that dies must not fly again unseen: half a flight would count as none.
        self._task = self._ray.remote(num_cpus=CORES_PER_FLIGHT, max_retries=0)(fly_here)

    async def fly(self, name: str, mission_json: str) -> dict[str, bytes]:
        flight = self._task.options(name=name).remote(mission_json)
        try:
            files: dict[str, bytes] = await flight
        except asyncio.CancelledError:
            self._ray.cancel(flight, force=True)  # the worker's end is the flight's (`deploy.reaper`)
            raise
        except self._ray.exceptions.RayError as error:
            raise ProcessError(f"{error}") from error
        return files

    def flown_s(self) -> dict[str, float]:
        """Not known from here."""
        return {}


def load_ray() -> Any:
    """The module. Raises `ProcessError` without it."""
    try:
        import ray
    except ModuleNotFoundError as error:
        raise ProcessError("Ray is not installed: pip install 'coverage-recon[cluster]'") from error
    return ray
