"""Where flights are flown: on this machine, or on a Ray cluster. The same flights come to the same on both."""

from __future__ import annotations

import shutil
from collections.abc import AsyncIterator, Sequence
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Protocol

from deploy.bench.flight import KEPT, flown_s, fly_in


class Executor(Protocol):
    @property
    def slots(self) -> int:
        """Flights at a time; known once it is ready."""

    def ready(self) -> AbstractAsyncContextManager[None]:
        """As long as it is to fly."""

    async def fly(self, name: str, mission_json: str) -> dict[str, bytes]:
        """One flight; the files to keep, by name. Cancelled, it ends the flight. Raises `ProcessError` if it fails."""

    def flown_s(self) -> dict[str, float]:
        """Mission time flown by each flight that flies, by name, as far as it is known."""


class LocalExecutor:
    """Processes of this machine, as many flights at once as ``slots``."""

    def __init__(self, slots: int, scratch: Path, kept: Sequence[str] = KEPT) -> None:
        """Flights are flown in folders of their own below ``scratch``, which is this executor's alone, and removed.

        Of each, the files ``kept`` are.
        """
        self.slots, self._kept = slots, kept
        self._scratch = scratch
        self._places: dict[str, Path] = {}

    @asynccontextmanager
    async def ready(self) -> AsyncIterator[None]:
        shutil.rmtree(self._scratch, ignore_errors=True)  # of a study that was killed
        self._scratch.mkdir(parents=True, exist_ok=True)
        try:
            yield
        finally:
            shutil.rmtree(self._scratch, ignore_errors=True)

    async def fly(self, name: str, mission_json: str) -> dict[str, bytes]:
        with TemporaryDirectory(prefix=f"{name}-", dir=self._scratch, ignore_cleanup_errors=True) as place:
            self._places[name] = Path(place)
            try:
                return await fly_in(Path(place), mission_json, self._kept)
            finally:
                del self._places[name]

    def flown_s(self) -> dict[str, float]:
        return {name: flown_s(place) for name, place in self._places.items()}
